"""rosbag2 beside MCAP: SQLite databases (.db3), and the folder that `ros2 bag record` makes, of either kind.

Databases written before ROS 2 Iron hold no message definitions; those of `quadid_replay.schemas` stand in, and a type
that is not there is named.  Compressed databases are refused with the command that unpacks them.

Read with sqlite3: the library rosbags takes folders only, and sorts whole payloads in SQLite, shared pages included.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import NamedTuple, Protocol

from quadid.errors import LogError
from quadid.sanitise import plain
from quadid_replay.bag_folder import bag_files
from quadid_replay.bag_topics import Topic, usable_definition
from quadid_replay.mcap_order import Message, Part, in_log_time
from quadid_replay.mcap_records import McapFile

SQLITE_MAGIC = b"SQLite format 3\x00"
_MOST_TOPICS = 5000
_SHORTEST = 1 << 12
_DAMAGE = (sqlite3.Error, UnicodeDecodeError)
"""The second comes where SQLite's message quotes bytes that are no text."""


class Bag(Protocol):
    """Topics by number and their messages in order of log time: an MCAP, a database, or a folder of them."""

    @property
    def topics(self) -> Mapping[int, Topic]:
        """Topics by number."""

    def messages(self, wanted: Set[int]) -> Iterator[Message]:
        """Number, log time [ns] and payload of the messages on the wanted topics."""

    def damage(self) -> list[str]:
        """Sentences about what could not be read."""


class Database:
    """A rosbag2 database, opened read-only.

    Raises:
        LogError: damaged, or no rosbag2.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
            self._connection.execute("PRAGMA trusted_schema=OFF")
            self._connection.execute("PRAGMA temp_store=MEMORY")
            self._size = path.stat().st_size
            # No value is larger than the file that holds it; what an expression makes would be.
            self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(self._size, _SHORTEST))
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
        payload, left = "SELECT data FROM messages WHERE rowid = ?", self._size
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
        """SQLite tells damage when it is met; it is an error then."""
        return []

    def _read_topics(self) -> dict[int, Topic]:
        stored = "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0"
        tables = {name for (name,) in self._connection.execute(stored)}
        if not {"topics", "messages"} <= tables:
            raise LogError(f"{self._path.name}: an SQLite database, but no rosbag2", "tables topics and messages")
        for table in {"topics", "messages", "message_definitions"} & tables:
            if any(hidden for *_, hidden in self._connection.execute(f"PRAGMA table_xinfo({table})")):
                raise LogError(f"{self._path.name}: columns of {table} are computed", "what ros2 bag record writes")
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {str(k): (str(e), str(t)) for k, e, t in self._connection.execute(f"{query} LIMIT 10000")}
        rows = self._connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchmany(
            _MOST_TOPICS
        )
        out = {}
        for number, name, kind, encoding in rows:
            if not isinstance(number, int):
                continue
            text = usable_definition(str(kind), *definitions.get(str(kind), ("", "")))
            shown = plain(str(kind)) if text else ""
            out[number] = Topic(plain(str(name)), shown, text, plain(str(encoding)))
        return out

    def _damaged(self, error: Exception) -> LogError:
        why = plain(str(error), 80) or "sizes that cannot be"
        return LogError(
            f"{self._path.name}: a damaged SQLite database ({why})", "a whole rosbag2 database",
            "sqlite3 FILE .recover, or copy it again after the recorder has stopped",
        )  # fmt: skip


class _Member(NamedTuple):
    """A file of a folder, and the folder's number of each of its topics."""

    bag: Bag
    numbers: dict[int, int]


class Folder:
    """The files of one recording, joined; a topic that is in several files is one topic.

    Raises:
        LogError: no file of a recording in it, or a compressed one.
    """

    def __init__(self, path: Path) -> None:
        self.topics: dict[int, Topic] = {}
        known: dict[tuple[str, str], int] = {}
        self._members: list[_Member] = []
        for file in bag_files(path):
            bag = open_bag(file)
            numbers = {}
            for number, topic in bag.topics.items():
                numbers[number] = known.setdefault((topic.name, topic.type), len(known))
                self.topics.setdefault(numbers[number], topic)
            self._members.append(_Member(bag, numbers))

    def messages(self, wanted: Set[int]) -> Iterator[Message]:
        """Number, log time [ns] and payload over all files, in order of log time."""
        parts: list[Part] = []
        for member in self._members:
            messages = self._renumbered(member, wanted)
            first = next(messages, None)
            if first is not None:
                parts.append((first[1], _chain(first, messages)))
        yield from in_log_time(sorted(parts, key=lambda part: part[0]))

    def damage(self) -> list[str]:
        """What could not be read, of all files."""
        return [note for member in self._members for note in member.bag.damage()]

    @staticmethod
    def _renumbered(member: _Member, wanted: Set[int]) -> Iterator[Message]:
        inside = {own for own, number in member.numbers.items() if number in wanted}
        if inside:
            for number, stamp, data in member.bag.messages(inside):
                yield member.numbers[number], stamp, data


def _chain(first: Message, rest: Iterator[Message]) -> Iterator[Message]:
    yield first
    yield from rest


def open_bag(path: Path) -> Bag:
    """Opens an MCAP file, a database or a folder of them."""
    if path.is_dir():
        return Folder(path)
    with path.open("rb") as file:
        database = file.read(len(SQLITE_MAGIC)) == SQLITE_MAGIC
    return Database(path) if database else McapFile(path)
