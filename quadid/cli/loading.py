"""A word on the terminal until a command has something of its own to print."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any, TextIO


class Loading:
    """Seconds of loading in one line of stderr, on a terminal only; the first text that anything prints ends it."""

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._terminal = sys.stderr
        self._line = threading.Thread(target=self._count, daemon=True)
        self._streams = [_First(stream, self.end) for stream in (sys.stdout, sys.stderr) if stream is not None]
        if len(self._streams) == 2 and self._terminal.isatty():
            sys.stdout, sys.stderr = self._streams
            self._line.start()

    def _count(self) -> None:
        begin = time.monotonic()
        while not self._ended.wait(0.25):  # nothing is said where that is enough
            print(f"\rquadid: loading, {time.monotonic() - begin:.0f} s", end="", file=self._terminal, flush=True)

    def end(self) -> None:
        """Erases the line, if there is one, for good."""
        if self._line.is_alive() and not self._ended.is_set():
            self._ended.set()
            self._line.join()
            print("\r\x1b[2K", end="", file=self._terminal, flush=True)


class _First:
    """A stream that calls `begun` before it is written to."""

    def __init__(self, stream: TextIO, begun: Any) -> None:
        self._stream, self._begun = stream, begun

    def write(self, text: str) -> int:
        self._begun()
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
