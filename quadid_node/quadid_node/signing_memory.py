"""Time stamps of signatures over a restart, as the MAVLink specification asks: what was sent before it is a replay."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

SAVED_EVERY = 1.0
"""[s]"""
UNITS = 100_000
"""Units of a signature's time stamp in a second."""
_MOST_STREAMS = 256


def memory_path(folder: Path, key: bytes) -> Path:
    """The file that remembers the streams signed with a key."""
    return folder / f"signing-{hashlib.sha256(key).hexdigest()[:16]}.json"


class SigningMemory:
    """Keeps the newest time stamps of one key in a file.

    Attributes:
        problem: why they are not kept, or empty.
    """

    def __init__(self, path: Path, signing: Any, clock: Callable[[], float] = time.monotonic) -> None:
        """Reads what was kept into pymavlink's `signing`.

        What came after the last save is not in the file: it is refused too, being at most `SAVED_EVERY` newer.
        """
        self._path, self._signing, self._clock = path, signing, clock
        self._saved_at = -1e9
        self._saved: dict[Any, int] = {}
        self.problem = ""
        try:
            kept = json.loads(path.read_text(encoding="ascii"))
            streams = {tuple(int(n) for n in name.split(".")): int(stamp) for name, stamp in kept["streams"].items()}
            newest = int(kept["newest"])
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            self.problem = f"time stamps of signatures in {path} cannot be read ({error}): only this clock guards now"
            return
        unsaved = round(SAVED_EVERY * UNITS)
        signing.stream_timestamps.update({stream: stamp + unsaved for stream, stamp in streams.items()})
        signing.timestamp = max(signing.timestamp, newest + unsaved)

    def keep(self, at_once: bool = False) -> None:
        """Saves what has changed, once a second."""
        now, streams = self._clock(), self._signing.stream_timestamps
        if not (at_once or now - self._saved_at >= SAVED_EVERY) or streams == self._saved:
            return
        self._saved_at = now
        last = sorted(streams.items(), key=lambda entry: -entry[1])[:_MOST_STREAMS]
        kept = {"newest": last[0][1], "streams": {".".join(map(str, stream)): stamp for stream, stamp in last}}
        aside = self._path.with_suffix(".new")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with aside.open("w", encoding="ascii") as file:
                json.dump(kept, file)
                file.flush()
                os.fsync(file.fileno())
            aside.replace(self._path)
        except OSError as error:
            self.problem = f"time stamps of signatures cannot be kept in {self._path} ({error.strerror})"
            return
        self._saved, self.problem = dict(streams), ""
