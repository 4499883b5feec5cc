"""Records what the node takes in, so that a replay repeats the run bit for bit.

Other recorders hear a stream of their own: DDS may lose a message on the way to them and not on the way here, and their
order of arrival is another.  This one writes the messages that the session was given, in that order, and in front of
them what the session began with.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from quadid_replay import TopicWriter
from quadid_replay.mcap_file import read_metadata
from quadid_replay.schemas import has_definition, whole_text

from quadid.condition.trim import flight_from_dict, flight_to_dict
from quadid.errors import LogError
from quadid.online import OnlineSet, SessionSettings
from quadid.vehicle import Vehicle
from quadid_node.codec import set_from_dict, set_to_dict
from quadid_node.history import UNREADABLE, Restored
from quadid_node.inputs import Input

RECORD = "quadid.session"
WRITTEN = 32
"""Messages that are written in about a millisecond."""
CHUNK_BYTES = 1 << 16
"""A small chunk is compressed in half a millisecond; a usual one would hold up the node for ten."""


@dataclass(frozen=True)
class Beginning:
    """What a session began with: vehicle, settings, preset of its topics, and what an earlier run had left."""

    vehicle: Vehicle
    settings: SessionSettings
    source: str
    restored: Restored


class Recorder:
    """An MCAP file of what arrives."""

    def __init__(self, path: Path, beginning: Beginning, inputs: Sequence[Input]) -> None:
        """Begins a recording of `inputs`; raises LogError when it cannot be written or a type has no definition."""
        self._writer = TopicWriter(path, {RECORD: _to_strings(beginning)}, CHUNK_BYTES)
        self._last = 0
        self._waiting: list[tuple[str, str, bytes, int]] = []
        for entry in inputs:
            kind = entry.type.replace("/", "/msg/")
            if not has_definition(kind):
                self._writer.define(kind, whole_text(kind, installed_definition))

    def take(self, topic: str, kind: str, data: bytes) -> None:
        """Takes a message; its log time never runs back, so that every reader keeps the order of arrival."""
        self._last = max(time.time_ns(), self._last + 1)
        self._waiting.append((topic, kind, data, self._last))

    def write(self, most: int | None = None) -> bool:
        """Writes what waits, `most` messages at most; returns whether some are left."""
        most = len(self._waiting) if most is None else most
        now, self._waiting = self._waiting[:most], self._waiting[most:]
        for message in now:
            self._writer.write_cdr(*message)
        return bool(self._waiting)

    def close(self) -> None:
        """Writes what waits and the end of the file."""
        self.write()
        self._writer.close()


def installed_definition(package: str, kind: str) -> str:
    """Text of a message definition of an installed ROS package; raises LogError when there is none."""
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        text = (Path(get_package_share_directory(package)) / "msg" / f"{kind}.msg").read_text(encoding="utf-8")
    except (PackageNotFoundError, OSError, UnicodeDecodeError) as error:
        fix = f"install the package {package} with its .msg files"
        raise LogError(f"no definition of {package}/{kind} to record", fix=fix) from error
    return text if text.endswith("\n") else text + "\n"


def read_beginning(path: Path) -> Beginning | None:
    """What the session of a recording began with; None for a file that no `Recorder` wrote.

    Raises:
        LogError: its record is damaged.
    """
    found = read_metadata(path).get(RECORD)
    if found is None:
        return None
    try:
        left = json.loads(found["restored"])
        restored = Restored(
            _set(left["item"]), int(left["next_sequence"]), _set(left["baseline"]), str(left.get("approval", "")),
            tuple(map(flight_from_dict, left.get("healthy", ()))), str(left.get("decided", Restored.decided)),
        )  # fmt: skip
        settings = SessionSettings.model_validate_json(found["settings"])
        return Beginning(Vehicle.from_yaml(found["vehicle"], path.name), settings, found["source"], restored)
    except UNREADABLE as error:
        raise LogError(f"{path.name}: what its session began with cannot be read ({error})") from error


def _to_strings(beginning: Beginning) -> Mapping[str, str]:
    left = beginning.restored
    restored = {
        "item": set_to_dict(left.item) if left.item is not None else None,
        "next_sequence": left.next_sequence,
        "approval": left.approval,
        "baseline": set_to_dict(left.baseline) if left.baseline is not None else None,
        "healthy": list(map(flight_to_dict, left.healthy)),
        "decided": left.decided,
    }
    return {
        "vehicle": beginning.vehicle.to_yaml(),
        "settings": beginning.settings.model_dump_json(),
        "source": beginning.source,
        "restored": json.dumps(restored),
    }


def _set(data: object) -> OnlineSet | None:
    return set_from_dict(data) if isinstance(data, Mapping) else None
