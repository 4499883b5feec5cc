"""ROS 2 logs: MCAP files, SQLite databases, and folders of `ros2 bag record`."""

import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import replace
from functools import lru_cache
from heapq import merge
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from mcap_ros2._dynamic import generate_dynamic

from quadid.data.window import Recording, fresh_rows
from quadid.errors import LogError
from quadid.sanitise import plain
from quadid.types import FloatArray
from quadid_replay.columns import RawChannel, assemble, fastest_first
from quadid_replay.mcap_file import McapFile, Message, Topic, described_topic
from quadid_replay.motors import active_outputs, no_multirotor
from quadid_replay.ros_messages import (
    AUTO,
    SIGNALS,
    TYPES,
    MessageReader,
    TopicSource,
    decode_messages,
    preset_rank,
    type_name,
)

# --- Folders that `ros2 bag record` makes: which files of them are read, in which order


def is_bag_folder(path: Path) -> bool:
    """Tells whether a folder holds a recording of rosbag2, by its metadata."""
    return (path / "metadata.yaml").is_file()


def bag_files(folder: Path) -> list[Path]:
    """The files of a recording, in the order of their numbers; raises LogError where there is none to read."""
    files = [p for end in ("mcap", "db3") for p in folder.glob(f"*.{end}") if p.is_file()]
    packed = sorted(p.name for p in folder.glob("*.zstd"))
    if packed:
        raise LogError(
            f"{folder.name}: {packed[0]} is compressed", "files that are not", f"unpack it: zstd -d {packed[0]}"
        )
    if not files:
        raise LogError(f"{folder.name}: neither .mcap nor .db3 in it", "a folder of ros2 bag record", "check the path")
    parts = {p: re.split(r"(\d+)", p.name) for p in files}  # every second one is a number
    return sorted(files, key=lambda p: [int(part) if k % 2 else part for k, part in enumerate(parts[p])])


# --- Rosbag2 beside MCAP: SQLite databases (.db3), and the folder that `ros2 bag record` makes, of either kind
#
# Databases written before ROS 2 Iron hold no message definitions; those of `quadid_replay.schemas` stand in, and a type
# that is not there is named.  Compressed databases are refused with the command that unpacks them.
#
# Read with sqlite3: the library rosbags takes folders only, and sorts whole payloads in SQLite, shared pages included.


SQLITE_MAGIC = b"SQLite format 3\x00"
_DAMAGE = (sqlite3.Error, UnicodeDecodeError)
"""The second comes where SQLite's message quotes bytes that are no text."""


class Database:
    """A rosbag2 database, opened read-only.

    Raises:
        LogError: damaged, or no rosbag2.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
            self.topics: dict[int, Topic] = self._read_topics()
        except (*_DAMAGE, MemoryError) as error:  # the latter for a row that claims to be larger than memory
            raise self._damaged(error) from error

    def messages(self, wanted: Set[int]) -> Iterator[Message]:
        """Number, log time [ns] and payload, in order of log time.

        Rows are put in order before any payload is read.  Together the payloads cannot be larger than the file: in one
        where they are, they share pages.
        """
        marks = ",".join(str(int(number)) for number in sorted(wanted))
        rows = f"SELECT timestamp, rowid, topic_id FROM messages WHERE topic_id IN ({marks})"
        payload, left = "SELECT data FROM messages WHERE rowid = ?", self._path.stat().st_size
        try:
            found = [row for row in self._connection.execute(rows) if isinstance(row[0], int)]
            for stamp, row, number in sorted(found):
                (data,) = self._connection.execute(payload, (row,)).fetchone() or (None,)
                if isinstance(data, bytes):
                    left -= len(data)
                    if left < 0:
                        raise sqlite3.DatabaseError("its messages share pages")
                    yield number, stamp, data
        except _DAMAGE as error:
            raise self._damaged(error) from error

    def damage(self) -> list[str]:
        """SQLite reports damage when it meets it; it is an error then."""
        return []

    def _read_topics(self) -> dict[int, Topic]:
        tables = {name for (name,) in self._connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise LogError(f"{self._path.name}: an SQLite database, but no rosbag2", "tables topics and messages")
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {str(k): (str(e), str(t)) for k, e, t in self._connection.execute(query)}
        rows = self._connection.execute("SELECT id, name, type, serialization_format FROM topics")
        return {
            number: described_topic(str(name), str(kind), str(encoding), *definitions.get(str(kind), ()))
            for number, name, kind, encoding in rows
            if isinstance(number, int)
        }

    def _damaged(self, error: Exception) -> LogError:
        why = plain(str(error), 80) or "sizes that cannot be"
        return LogError(
            f"{self._path.name}: a damaged SQLite database ({why})",
            "a whole rosbag2 database",
            "sqlite3 FILE .recover, or copy it again after the recorder has stopped",
        )


class Folder:
    """The files of one recording, joined; a topic that is in several files is one topic.

    Raises:
        LogError: no file of a recording in it, or a compressed one.
    """

    def __init__(self, path: Path) -> None:
        self.topics: dict[int, Topic] = {}
        known: dict[tuple[str, str], int] = {}
        self._members: list[tuple[Bag, dict[int, int]]] = []
        """Each file with the folder's number of each of its topics."""
        for file in bag_files(path):
            bag = open_bag(file)
            numbers = {}
            for number, topic in bag.topics.items():
                numbers[number] = known.setdefault((topic.name, topic.type), len(known))
                self.topics.setdefault(numbers[number], topic)
            self._members.append((bag, numbers))

    def messages(self, wanted: Set[int]) -> Iterator[Message]:
        """Number, log time [ns] and payload over all files, in order of log time."""

        def of(bag: Bag, numbers: dict[int, int]) -> Iterator[Message]:
            inside = {own for own, number in numbers.items() if number in wanted}
            for number, stamp, data in bag.messages(inside) if inside else ():
                yield numbers[number], stamp, data

        yield from merge(*(of(*member) for member in self._members), key=lambda message: message[1])

    def damage(self) -> list[str]:
        """Unread parts of all files."""
        return [note for bag, _ in self._members for note in bag.damage()]


Bag: TypeAlias = "McapFile | Database | Folder"
"""Topics by number, messages in order of log time, and what could not be read."""


def open_bag(path: Path) -> Bag:
    """Opens an MCAP file, a database or a folder of them."""
    if path.is_dir():
        return Folder(path)
    with path.open("rb") as file:
        database = file.read(len(SQLITE_MAGIC)) == SQLITE_MAGIC
    return Database(path) if database else McapFile(path)


# --- ROS 2 logs: picks the topics, decodes them, and brings their stamps onto one clock


def read_mcap(path: Path, preset: str = AUTO) -> Recording:
    """Reads a ROS 2 log, whole or damaged: an MCAP file, a rosbag2 database or a rosbag2 folder.

    Args:
        preset: key of `quadid_replay.ros_messages.TOPICS`, or ``auto``.

    Raises:
        LogError: no topic of a known type, or unknown preset.
    """
    bag = open_bag(path)
    notes: list[str] = []
    sources = _sources(bag, preset, notes)
    if not sources:
        raise _no_topic(path, bag, preset, notes)
    columns, clock, epoch, failed = decode_messages(bag.messages(sources.keys()), sources)
    notes = [*bag.damage(), *notes]
    if failed:
        notes.append(f"{failed} messages could not be decoded and were dropped")
    if epoch:
        notes.append(f"times count from UNIX time {epoch} s")
    raw = _channels(columns, sources, preset)
    kinds = [entry for entry in raw if entry.name == "vehicle_kind"]
    other = no_multirotor({}, int(kinds[0].values[-1, 0])) if kinds else ""
    raw = [entry for entry in raw if entry.name != "vehicle_kind"]
    recording = assemble(path.name, "mcap", raw, clock, notes, other=other)
    return replace(recording, epoch=float(epoch) if epoch else None)


def _sources(bag: Bag, preset: str, notes: list[str]) -> dict[int, TopicSource]:
    """Picks the topics whose type is known and whose name the preset lists for one of its channels."""
    sources = {}
    for number, topic in bag.topics.items():
        if not topic.definition and topic.unread:
            notes.append(f"{topic.name}: {topic.unread}: not read; record it with a ros2msg definition")
        kind = TYPES.get(type_name(topic.type)) if topic.definition else None
        if kind is None or topic.encoding != "cdr":
            continue
        listed = [preset_rank(preset, channel, topic.name) for channel in {c for c, _ in SIGNALS.values()}]
        if all(rank is None for rank in listed):
            continue
        try:
            decode = decoder(topic.type, topic.definition)
        except Exception as error:  # noqa: BLE001 - the parser of untrusted definitions raises anything; it is reported
            notes.append(f"{topic.name}: its message definition is damaged ({type(error).__name__}): not used")
            continue
        sources[number] = TopicSource(topic, kind, MessageReader(kind, decode))
    return sources


@lru_cache(maxsize=64)
def decoder(kind: str, definition: str) -> Callable[[bytes], Any]:
    """The library's decoder of a type; making one costs more than decoding a hundred messages.

    Without comments, in which the library looks for units for as long as their length squared.
    """
    stated = "\n".join(line.partition("#")[0] for line in definition.splitlines())
    decode: Callable[[bytes], Any] = generate_dynamic(kind, stated)[kind]
    return decode


def _channels(
    columns: Mapping[tuple[int, str], tuple[FloatArray, FloatArray]], sources: dict[int, TopicSource], preset: str
) -> list[RawChannel]:
    """Makes channels of the columns; of several topics for one channel the best comes first."""
    ranked: dict[str, list[tuple[int, RawChannel]]] = {}
    for (number, signal), (t, values) in columns.items():
        channel, convert = SIGNALS[signal]
        topic = sources[number].topic
        rank = preset_rank(preset, channel, topic.name)
        if signal in ("outputs", "actuator_motors"):  # of messages with room for more, the columns that are motors
            values = values[:, active_outputs(values) if signal == "outputs" else np.isfinite(values).any(axis=0)]
        if rank is None or len(t) == 0 or values.shape[1] == 0 or _unused(signal, topic, values):
            continue
        source = f"{topic.name} ({type_name(topic.type)})"
        rank += 5 if signal == "pose_attitude" else 0
        with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers are dropped further on
            converted = convert(values)
        ranked.setdefault(channel, []).append((rank, RawChannel(channel, t, converted, source)))
    out = []
    for entries in ranked.values():
        ordered = [entry for _, entry in sorted(entries, key=lambda pair: pair[0])]
        if ordered[0].name in ("gyro", "accel"):
            # A topic that repeats readings goes last, as MAVROS' imu/data repeats the acceleration.
            ordered.sort(key=lambda entry: len(fresh_rows(entry.values)) < 0.9 * len(entry.values))
        out += ordered if preset != AUTO else fastest_first(ordered, 1.5)
    return out


def _unused(signal: str, topic: Topic, values: FloatArray) -> bool:
    """Fields that a driver left alone: a constant identity attitude, efforts that are no commands, body twists."""
    if signal in ("attitude", "pose_attitude"):
        return bool(np.all(values == values[0]) and np.isin(values[0], (0.0, 1.0)).all())
    if signal == "motor_command" and type_name(topic.type) == "sensor_msgs/JointState":
        return bool(np.nanmin(values) < -0.05 or not np.any(values))
    return signal == "velocity" and "body" in topic.name


def _no_topic(path: Path, bag: Bag, preset: str, notes: list[str]) -> LogError:
    found = ", ".join(
        f"{t.name} [{type_name(t.type) if t.definition else t.unread or f'{type_name(t.type)}, no definition held'}]"
        for t in list(bag.topics.values())[:5]
    )
    damage = plain("; ".join([*bag.damage(), *notes[:4]]), 600)
    reason = f" ({damage})" if damage else ""
    if damage and not bag.topics:
        fix = "copy it again; `mcap recover` may save a part of an MCAP file"
        return LogError(f"{path.name}: nothing in it can be read{reason}", "a whole log", fix)
    return LogError(
        f"{path.name}: no topic to read with preset '{preset}' among: {found or 'none'}{reason}",
        "topics of types " + ", ".join(list(TYPES)[:6]) + " …",
        "choose another preset, or record the topics of docs/logs.md",
    )
