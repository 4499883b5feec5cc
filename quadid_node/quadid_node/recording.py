"""Recordings of what a node takes in, and logs as the streams that they once were.

Other recorders hear a stream of their own: DDS may lose a message on the way to them and not on the way here, and their
order of arrival is another.  The `Recorder` writes the messages that the session was given, in that order, and in front
of them what the session began with, so that a replay repeats the run bit for bit.
"""

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from quadid_replay import TopicWriter
from quadid_replay.mcap_file import McapFile, read_metadata
from quadid_replay.ros_messages import type_name
from quadid_replay.rosbag import decoder
from quadid_replay.schemas import has_definition, whole_text
from quadid_replay.writers import in_time_order

from quadid.condition.trim import flight_from_dict, flight_to_dict
from quadid.data.window import Block, Recording
from quadid.errors import LogError
from quadid.online import GateSettings, OnlineSet, SessionSettings
from quadid.vehicle import Vehicle
from quadid_node.history import MASS, NUMBER, UNREADABLE, Restored, why_none
from quadid_node.inputs import Decoder, Input, SourceSelector, best_ranks, seconds, source
from quadid_node.messages import Output, set_from_dict, set_to_dict
from quadid_node.service import Service

RECORD = "quadid.session"
CHUNK_BYTES = 1 << 16
"""A small chunk is compressed in half a millisecond; a usual one would hold up the node for ten."""


@dataclass(frozen=True)
class Beginning:
    """Start of a session: vehicle, settings, preset of its topics, and what an earlier run had left."""

    vehicle: Vehicle
    settings: SessionSettings
    source: str
    restored: Restored


class Recorder(TopicWriter):
    """An MCAP file of what arrives."""

    def __init__(self, path: Path, beginning: Beginning, inputs: Sequence[Input]) -> None:
        """Begins a recording of `inputs`; raises LogError when it cannot be written or a type has no definition."""
        left = beginning.restored
        record = {
            "vehicle": beginning.vehicle.to_yaml(),
            "settings": beginning.settings.model_dump_json(),
            "source": beginning.source,
            "restored": json.dumps(
                {
                    **vars(left),
                    "item": left.item and set_to_dict(left.item),
                    "baseline": left.baseline and set_to_dict(left.baseline),
                    "healthy": list(map(flight_to_dict, left.healthy)),
                }
            ),
        }
        super().__init__(path, {RECORD: record}, CHUNK_BYTES)
        self._last = 0
        for entry in inputs:
            kind = entry.type.replace("/", "/msg/")
            if not has_definition(kind):
                self.define(kind, whole_text(kind, installed_definition))

    def take(self, topic: str, kind: str, data: bytes) -> None:
        """Writes a message; its log time never runs back, so that every reader keeps the order of arrival."""
        self._last = max(time.time_ns(), self._last + 1)
        self.write_cdr(topic, kind, data, self._last)


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
    """Start of the session of a recording; None for a file that no `Recorder` wrote.

    Raises:
        LogError: its record is damaged.
    """
    found = read_metadata(path).get(RECORD)
    if found is None:
        return None
    try:
        left = json.loads(found["restored"])
        vehicle = Vehicle.from_yaml(found["vehicle"], path.name)
        settings = SessionSettings.model_validate_json(found["settings"])
        for name in ("item", "baseline"):
            left[name] = _set(left[name], settings.gate, vehicle)
        for name, kind in (("next_sequence", NUMBER), ("mass", MASS), ("approval", str), ("decided", str)):
            left[name] = msgspec.convert(left[name], kind)
        left["healthy"] = tuple(map(flight_from_dict, left["healthy"]))
        return Beginning(vehicle, settings, found["source"], Restored(**left))
    except UNREADABLE as error:
        raise LogError(f"{path.name}: what its session began with cannot be read ({error})") from error


def _set(data: object, gate: GateSettings, vehicle: Vehicle) -> OnlineSet | None:
    """A set that an earlier run may have left; raises one of `UNREADABLE` for what no fit makes."""
    if not isinstance(data, Mapping):
        return None
    found = set_from_dict(data)
    if why := why_none(found, msgspec.convert(found.sequence, NUMBER), gate, vehicle):
        raise ValueError(why)
    return found


# --- Logs as streams, with the stamps a live service would have seen: in general in time order, a recording of the node
# itself in the order in which the messages came


def stream(recording: Recording) -> Iterator[Block]:
    """Yields all rows in time order, at equal times by channel; absolute where the log's times are.

    Times are brought back to whole nanoseconds, as they came in headers, so that a replayed log gives the numbers of
    the live run bit for bit.
    """
    base, channels = int(recording.epoch or 0.0) * 10**9, list(recording.channels.values())
    whole = [Block(seconds(np.rint(c.t * 1e9).astype(np.int64) + base), ((c.name, c.values),)) for c in channels]
    for which, row in in_time_order([c.t for c in channels]):
        yield whole[which].part(row, row + 1)


def arrivals(path: Path, preset: str, rotors: int) -> Iterator[Block]:
    """Yields the messages of a node's recording as the node's session got them: the same numbers in the same order.

    Raises:
        LogError: a message definition that cannot be used.
    """
    file, inputs = McapFile(path), source(preset).inputs
    chooser = SourceSelector(best_ranks(inputs))
    decoders = {}
    for number, topic in file.topics.items():
        entry = next((e for e in inputs if e.topic == topic.name and e.type == type_name(topic.type)), None)
        if entry is None:
            continue
        try:
            decode = decoder(topic.type, topic.definition)
        except Exception as error:
            raise LogError(
                f"{path.name}: the definition of {topic.type} is damaged ({type(error).__name__})"
            ) from error
        decoders[number] = Decoder(entry, chooser, rotors, decode)
    for number, _, data in file.messages(decoders.keys()):
        yield from decoders[number].take([data])


BATCH = 200
"""Rows between two looks at the session."""


def play(
    service: Service, blocks: Iterable[Block], pace: float = 0.0, told: Callable[[int], None] = lambda rows: None
) -> list[Output]:
    """Plays a stream into a service with an inline worker; returns everything that it put out, in order.

    Args:
        pace: factor of real time; 0 for as fast as possible.
        told: called with the number of rows played, now and then.
    """
    outputs: list[Output] = []
    begin, first, count, due = time.monotonic(), math.nan, 0, 0

    def work() -> None:
        """Steps until the session needs more."""
        outputs.extend(service.step())
        while service.session.running is not None:
            outputs.extend(service.step())
        told(count)

    for block in blocks:
        if pace > 0.0:
            first = float(block.t[0]) if count == 0 else first
            time.sleep(max(begin + (float(block.t[-1]) - first) / pace - time.monotonic(), 0.0))
        service.push(block)
        count += len(block.t)
        if count >= due or pace > 0.0:
            due = count + BATCH
            work()
    work()
    return outputs
