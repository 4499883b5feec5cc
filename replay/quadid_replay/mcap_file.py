"""Records of MCAP files, through damage and within limits."""

import io
import struct
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Set
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Header, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary

from quadid.files import read_regular
from quadid.sanitise import plain
from quadid_replay.schemas import has_definition, schema_text

# --- Topics of a ROS 2 log and the definitions of their messages


class Topic(NamedTuple):
    """One channel of the file; all but the definition is fit to be shown.

    The definition is empty where none can be used; `unread` says of which kind it is then, if there is one.
    """

    name: str
    type: str
    definition: str
    encoding: str
    unread: str = ""


def described_topic(name: str, kind: str, encoding: str, form: str = "", text: str = "") -> Topic:
    """The topic that a file describes; its definition is the one held, else that of `quadid_replay.schemas`.

    Args:
        name: of the topic, kind of its messages, and their encoding, as the file has them.
        form: of the definition held, ``ros2msg`` or ``ros2idl``; empty where there is none.
        text: the definition held.
    """
    known = "/" in kind and has_definition(kind)
    definition = text if form == "ros2msg" and text else schema_text(kind) if known else ""
    unread = f"{plain(kind, 60)} is described in IDL" if form == "ros2idl" else ""
    return Topic(plain(name), plain(kind), definition, plain(encoding), unread)


# --- Metadata records at the beginning of an MCAP file, as `TopicWriter` puts them there


MAGIC = b"\x89MCAP0\r\n"
LARGEST = 1 << 22
"""Metadata beyond this are not ours [bytes]."""
_RECORD = struct.Struct("<BQ")
_DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, RuntimeError, EOFError)


def read_metadata(path: Path) -> dict[str, dict[str, str]]:
    """Metadata records before the first message, by name; empty for a file without any, damaged or no MCAP at all.

    They are sought in the first `LARGEST` bytes, and in this process.
    """
    found: dict[str, dict[str, str]] = {}
    try:
        beginning = BytesIO(read_regular(path, LARGEST))
        for record in StreamReader(beginning, emit_chunks=True, record_size_limit=LARGEST).records:  # none is unpacked
            if isinstance(record, Metadata):
                found[record.name] = record.metadata
            elif not isinstance(record, Header):
                break
    except (OSError, *_DAMAGE):
        pass
    return found


# --- Messages of an MCAP file in order of their log time, whatever order its chunks are in


Message = tuple[int, int, bytes]
"""Channel id, log time [ns], payload."""
Part = tuple[int, Iterator[Message]]
"""Log time [ns] before which there is none, and messages."""
_FEWEST = 1000


def in_log_time(parts: Iterable[Part]) -> Iterator[Message]:
    """Merges parts whose starts rise; no message of a part comes before its start.

    What is ready is handed out whenever as much again has come as was left the last time, so that the work stays
    proportional to the number of messages even where every part overlaps every other.
    """
    waiting: list[Message] = []
    enough = _FEWEST
    for start, messages in parts:
        if len(waiting) >= enough:
            waiting.sort(key=_log_time)  # stable, and quick where it is nearly in order
            ready = bisect_left(waiting, start, key=_log_time)
            yield from waiting[:ready]
            waiting = waiting[ready:]
            enough = 2 * len(waiting) + _FEWEST
        waiting.extend(messages)
    waiting.sort(key=_log_time)
    yield from waiting


def _log_time(message: Message) -> int:
    return message[1]


# --- Records of an MCAP file, through damage: which topics there are, and their messages in order of log time
#
# The library `mcap` reads the summary, chunks and definitions.  Walking from record to record is ours, because its
# readers stop at the first damage; so is the check of the summary's CRC, which it leaves out.  Every place of the file
# is read once and never backwards, whatever stands in an index.


_MESSAGE = struct.Struct("<HIQQ")
_FOOTER = struct.Struct("<BQQQI")


class McapFile:
    """An MCAP file opened for reading.

    Attributes:
        has_summary: whether definitions and index at its end are whole.
        bad_chunks: chunks and definitions refused for their CRC, size or content.
        lost_bytes: bytes that belong to no record.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = path.stat().st_size
        with path.open("rb") as file:
            summary = _summary(file, self._size)
            self.has_summary = summary is not None
            self._schemas: dict[int, Schema] = dict(summary.schemas) if summary else {}
            self._channels: dict[int, Channel] = dict(summary.channels) if summary else {}
            self.bad_chunks, self.lost_bytes = 0, 0
            self._places = sorted(self._located(file, summary))
        if summary is None:
            for _ in self.messages(frozenset()):
                pass

    @property
    def topics(self) -> dict[int, Topic]:
        """Topics by channel id."""
        out = {}
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            told = (schema.encoding, schema.data.decode("utf-8", "replace")) if schema else ("", "")
            out[number] = described_topic(channel.topic, schema.name if schema else "", channel.message_encoding, *told)
        return out

    def messages(self, wanted: Set[int]) -> Iterator[Message]:
        """Yields channel id, log time [ns] and payload of the messages on the wanted channels, in order of log time.

        Chunks are read in the order of their first message; what is later than the first message of the next chunk
        waits.  A recorder writes nearly in order, so little waits.
        """
        self.bad_chunks = 0
        with self._path.open("rb") as file:
            yield from in_log_time(self._parts(file, wanted))

    def damage(self) -> list[str]:
        """Says in sentences what could not be read."""
        notes = []
        if self.bad_chunks:
            notes.append(f"{self.bad_chunks} damaged chunks or definitions refused")
        if self.lost_bytes:
            share = self.lost_bytes / self._size
            notes.append(f"the file is cut or damaged: {self.lost_bytes} bytes of it ({share:.1%}) are not readable")
        elif not self.has_summary:
            notes.append("the file has no valid summary (recording was not closed): all that was readable is used")
        return notes

    def _located(self, file: BinaryIO, summary: Summary | None) -> Iterator[tuple[int, int, int, int]]:
        """Yields log time [ns], place of the body, opcode and length of the records that matter.

        From where there is no record it goes on at the next chunk of the index.
        """
        offset, resume = len(MAGIC), sorted({c.chunk_start_offset for c in summary.chunk_indexes} if summary else ())
        while offset + _RECORD.size <= self._size:
            file.seek(offset)
            opcode, length = _RECORD.unpack(file.read(_RECORD.size))
            begin = offset + _RECORD.size
            if begin + length > self._size or not (0 < opcode <= Opcode.DATA_END or opcode >= 0x80):
                following = bisect_right(resume, offset)
                after = min(resume[following], self._size) if following < len(resume) else self._size
                self.lost_bytes += after - offset
                offset = after
                continue
            offset = begin + length
            if opcode == Opcode.FOOTER:
                self.lost_bytes += max(self._size - offset - len(MAGIC), 0)
                return
            if opcode == Opcode.CHUNK:
                yield int.from_bytes(file.read(8), "little"), begin, opcode, length
            elif opcode == Opcode.MESSAGE:
                yield int.from_bytes(file.read(14)[6:], "little"), begin, opcode, length
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield 0, begin, opcode, length
        self.lost_bytes += self._size - offset

    def _parts(self, file: BinaryIO, wanted: Set[int]) -> Iterator[Part]:
        """Messages of each chunk, and those outside chunks, behind the time before which there is none."""
        for start, offset, opcode, length in self._places:
            file.seek(offset)
            body = file.read(length)
            if opcode == Opcode.CHUNK:
                try:
                    stream, size = get_chunk_data_stream(Chunk.read(_stream(body)), validate_crc=True)
                    body = stream.read(size)
                except (*_DAMAGE, MemoryError):  # the latter for a size that cannot be
                    self.bad_chunks += 1
                    continue
                yield start, self._of_records(body, wanted)
            else:
                yield start, self._of_records(_RECORD.pack(opcode, length) + body, wanted)

    def _of_records(self, data: bytes, wanted: Set[int]) -> Iterator[Message]:
        """Messages on the wanted channels among these records; definitions are noted."""
        offset = 0
        try:
            while offset + _RECORD.size <= len(data):
                kind, length = _RECORD.unpack_from(data, offset)
                begin = offset + _RECORD.size
                offset = begin + length
                if offset > len(data) or kind == 0:
                    raise EOFError
                if kind == Opcode.MESSAGE:
                    channel, _, log_time, _ = _MESSAGE.unpack(data[begin : begin + min(length, _MESSAGE.size)])
                    if channel in wanted:
                        yield channel, log_time, data[begin + _MESSAGE.size : offset]
                elif kind == Opcode.SCHEMA:
                    schema = Schema.read(_stream(data[begin:offset]))
                    self._schemas.setdefault(schema.id, schema)
                elif kind == Opcode.CHANNEL:
                    described = Channel.read(_stream(data[begin:offset]))
                    self._channels.setdefault(described.id, described)
        except _DAMAGE:
            self.bad_chunks += 1


def _summary(file: BinaryIO, size: int) -> Summary | None:
    """Definitions and index at the end of a file; None where they are absent or damaged."""
    tail = _FOOTER.size + len(MAGIC)
    try:
        file.seek(max(size - tail, 0))
        _, _, start, _, crc = _FOOTER.unpack(file.read(_FOOTER.size))
        file.seek(start)
        if crc and zlib.crc32(file.read(max(size - start - len(MAGIC) - 4, 0))) != crc:
            return None
        file.seek(0)
        summary = SeekingReader(file).get_summary()
    except (*_DAMAGE, OSError, MemoryError):
        return None
    return summary if summary and summary.channels else None


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))
