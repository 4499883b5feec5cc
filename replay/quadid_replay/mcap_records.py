"""Records of an MCAP file, through damage and within limits: which topics there are, and their messages.

With an intact summary (its CRC is checked) chunks are found by their index, so that one damaged chunk costs only
itself.  Without it, as in a file that was cut, records are walked from the start to the damage.  Every chunk's CRC is
checked.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Set
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

from quadid.errors import LogError
from quadid.sanitise import plain
from quadid_replay.bag_topics import Topic, usable_definition
from quadid_replay.mcap_order import Message, Part, in_log_time

MAGIC = b"\x89MCAP0\r\n"
RATIO, FLOOR, CEILING = 50, 16 << 20, 4 << 30
"""A file may inflate to 50 times its size, at least to 16 MiB (lz4 takes twice that meanwhile), and beyond 4 GiB only
to 3 times its size."""
MESSAGE_BYTES = 128
"""Counted for every message beside its content: what it takes of memory while it waits for its turn (measured: 111)."""
LARGEST_CHUNK = 128 << 20
MOST_DEFINITIONS = 5000
"""Channels, and schemas, of one file; a large robot has hundreds."""
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_FOOTER_SIZE = 9 + 20 + len(MAGIC)


class _DamagedError(Exception):
    """A record that is not what it says; carries the reason."""


class McapFile:
    """An MCAP file opened for reading.

    Attributes:
        topics: by channel id.
        bad_chunks: chunks refused for their CRC, size or content.
        lost_seconds: flight time inside them [s].
        lost_bytes: bytes behind the place where walking had to stop.

    Raises:
        LogError: a file that would inflate beyond the limits.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = path.stat().st_size
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self.bad_chunks, self.lost_seconds, self.lost_bytes = 0, 0.0, 0
        self._budget = 0
        with path.open("rb") as file:
            self.has_summary = self._read_summary(file)
        if not self.has_summary:
            for _ in self.messages(frozenset()):
                pass

    @property
    def topics(self) -> dict[int, Topic]:
        """Topics by channel id; those without a readable definition have an empty type."""
        out = {}
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            held = schema.data.decode("utf-8", "replace") if schema else ""
            text = usable_definition(schema.name, schema.encoding, held) if schema else ""
            kind = schema.name if schema and text else ""
            idl = f"{plain(schema.name, 60)} is described in IDL" if schema and schema.encoding == "ros2idl" else ""
            out[number] = Topic(plain(channel.topic), plain(kind), text, plain(channel.message_encoding), idl)
        return out

    def messages(self, wanted: Set[int]) -> Iterator[Message]:
        """Yields channel id, log time [ns] and payload of the messages on the wanted channels, in order of log time.

        Chunks are read in the order of their first message; what is later than the first message of the next chunk
        waits.  A recorder writes nearly in order, so little waits; a file in any order is held as a whole, within the
        limit of what it may inflate to.
        """
        self.bad_chunks, self.lost_seconds, self.lost_bytes = 0, 0.0, 0
        self._budget = max(FLOOR, min(RATIO * self._size, max(CEILING, 3 * self._size)))
        with self._path.open("rb") as file:
            parts = self._indexed(file, wanted) if self.has_summary and self._chunks else self._walk(file, wanted)
            yield from in_log_time(parts)

    def damage(self) -> list[str]:
        """Says in sentences what could not be read."""
        notes = []
        if self.bad_chunks:
            notes.append(f"{self.bad_chunks} damaged chunks or definitions refused ({self.lost_seconds:.2f} s of log)")
        if self.lost_bytes:
            share = self.lost_bytes / self._size
            notes.append(f"the file is cut or damaged: its last {self.lost_bytes} bytes ({share:.1%}) are not readable")
        elif not self.has_summary:
            notes.append("the file has no valid summary (recording was not closed): all that was readable is used")
        return notes

    def _read_summary(self, file: BinaryIO) -> bool:
        """Reads schemas, channels and chunk index from the end of the file; False when it is absent or damaged."""
        if self._size < len(MAGIC) + _FOOTER_SIZE:
            return False
        file.seek(self._size - _FOOTER_SIZE)
        tail = file.read(_FOOTER_SIZE)
        opcode, length, start, _, crc = struct.unpack("<BQQQI", tail[:29])
        if opcode != Opcode.FOOTER or length != 20 or tail[29:] != MAGIC:
            return False
        if not len(MAGIC) <= start <= self._size - _FOOTER_SIZE:
            return False
        file.seek(start)
        body = file.read(self._size - _FOOTER_SIZE - start)
        if crc and zlib.crc32(tail[:25], zlib.crc32(body)) != crc:
            return False
        try:
            for kind, begin, end in _split_records(body):
                self._note_definition(kind, body[begin:end])
                if kind == Opcode.CHUNK_INDEX:
                    self._chunks.append(ChunkIndex.read(_stream(body[begin:end])))
        except (_DamagedError, McapError, struct.error, ValueError):
            return False
        return bool(self._channels)

    def _indexed(self, file: BinaryIO, wanted: Set[int]) -> Iterator[Part]:
        for index in sorted(self._chunks, key=lambda c: (c.message_start_time, c.chunk_start_offset)):
            if index.message_index_offsets and wanted.isdisjoint(index.message_index_offsets):
                continue
            head = b""
            if index.chunk_start_offset < self._size:
                file.seek(index.chunk_start_offset)
                head = file.read(_RECORD.size)
            try:
                if len(head) < _RECORD.size:
                    raise _DamagedError("chunk outside the file")
                opcode, length = _RECORD.unpack(head)
                if opcode != Opcode.CHUNK or length > self._size:
                    raise _DamagedError("no chunk where the index says")
                data = self._inflate(file.read(length))
            except _DamagedError:
                self.bad_chunks += 1
                self.lost_seconds += max(0, index.message_end_time - index.message_start_time) * 1e-9
                continue
            yield index.message_start_time, self._chunk_messages(data, wanted)

    def _walk(self, file: BinaryIO, wanted: Set[int]) -> Iterator[Part]:
        for start, offset, opcode, length in sorted(self._located(file)):
            file.seek(offset)
            body = file.read(length)
            try:
                if opcode == Opcode.CHUNK:
                    yield start, self._chunk_messages(self._inflate(body), wanted)
                elif opcode == Opcode.MESSAGE:
                    yield start, _one_message(body, wanted)
                else:
                    self._note_safely(opcode, body)
            except _DamagedError:
                self.bad_chunks += 1

    def _located(self, file: BinaryIO) -> Iterator[tuple[int, int, int, int]]:
        """Yields log time [ns], place of the body, opcode and length of the records that matter, up to the damage."""
        offset = len(MAGIC)
        while offset + _RECORD.size <= self._size:
            file.seek(offset)
            opcode, length = _RECORD.unpack(file.read(_RECORD.size))
            begin = offset + _RECORD.size
            offset = begin + length
            if offset > self._size or not (0 < opcode <= Opcode.DATA_END or opcode >= 0x80):
                self.lost_bytes = self._size - begin + _RECORD.size
                return
            if opcode == Opcode.CHUNK and length >= 8:
                yield int.from_bytes(file.read(8), "little"), begin, opcode, length
            elif opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
                yield _MESSAGE.unpack(file.read(_MESSAGE.size))[2], begin, opcode, length
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield 0, begin, opcode, length
            elif opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                self.bad_chunks += 1
            elif opcode == Opcode.FOOTER:
                self.lost_bytes = max(self._size - offset - len(MAGIC), 0)
                return
        self.lost_bytes = self._size - offset

    def _inflate(self, body: bytes) -> bytes:
        """Checks sizes before anything is inflated, then inflates and checks the CRC; raises _DamagedError."""
        if len(body) < _CHUNK.size:
            raise _DamagedError("chunk without a header")
        _, _, declared, crc, name_length = _CHUNK.unpack_from(body)
        name = body[_CHUNK.size : _CHUNK.size + name_length]
        data = memoryview(body)[_CHUNK.size + name_length + 8 :]
        self._spend(declared)
        if declared > LARGEST_CHUNK:
            raise self._bomb()
        inflated = _decompress(name, data, declared)
        if len(inflated) != declared or (crc and zlib.crc32(inflated) != crc):
            raise _DamagedError("content does not match its checksum")
        return inflated

    def _spend(self, size: int) -> None:
        self._budget -= size
        if self._budget < 0:
            raise self._bomb()

    def _bomb(self) -> LogError:
        return LogError(
            f"{self._path.name}: {self._size} bytes that would inflate to more than {RATIO} times as much",
            f"chunks up to {LARGEST_CHUNK >> 20} MiB and {RATIO} times the file's size in all",
            "this looks like a decompression bomb: do not trust the file",
        )  # fmt: skip

    def _chunk_messages(self, data: bytes, wanted: Set[int]) -> Iterator[Message]:
        try:
            for kind, begin, end in _split_records(data):
                if kind == Opcode.MESSAGE:
                    if end - begin < _MESSAGE.size:
                        raise _DamagedError("message without a header")
                    channel = data[begin] | data[begin + 1] << 8
                    if channel in wanted:
                        self._spend(MESSAGE_BYTES)
                        yield channel, _MESSAGE.unpack_from(data, begin)[2], data[begin + _MESSAGE.size : end]
                elif kind in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._note_safely(kind, data[begin:end])
        except _DamagedError:
            self.bad_chunks += 1

    def _note_safely(self, kind: int, body: bytes) -> None:
        try:
            self._note_definition(kind, body)
        except (McapError, struct.error, ValueError) as error:
            raise _DamagedError("definition") from error

    def _note_definition(self, kind: int, body: bytes) -> None:
        if kind == Opcode.SCHEMA:
            schema = Schema.read(_stream(body))
            self._schemas.setdefault(schema.id, schema)
        elif kind == Opcode.CHANNEL:
            channel = Channel.read(_stream(body))
            self._channels.setdefault(channel.id, channel)
        if max(len(self._schemas), len(self._channels)) > MOST_DEFINITIONS:
            raise LogError(
                f"{self._path.name}: more than {MOST_DEFINITIONS} channels or message definitions",
                "those of one robot", "record fewer topics; or this file was made to harm: do not trust it",
            )  # fmt: skip


def _one_message(body: bytes, wanted: Set[int]) -> Iterator[Message]:
    if len(body) >= _MESSAGE.size:
        channel, _, log_time, _ = _MESSAGE.unpack_from(body)
        if channel in wanted:
            yield channel, log_time, body[_MESSAGE.size :]


def _split_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields opcode, begin and end of each record; raises _DamagedError where there is no whole one."""
    offset, size = 0, len(data)
    while offset + _RECORD.size <= size:
        kind, length = _RECORD.unpack_from(data, offset)
        begin = offset + _RECORD.size
        offset = begin + length
        if offset > size or kind == 0:
            raise _DamagedError("no record, or longer than its chunk")
        yield kind, begin, offset


def _decompress(name: bytes, data: memoryview, declared: int) -> bytes:
    """Inflates to at most `declared` bytes, whatever the compressed data say of themselves."""
    try:
        if name == b"zstd":
            with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data) as reader:
                return bytes(reader.read(declared)) if declared else b""
        if name == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=declared))
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise _DamagedError("cannot be inflated") from error
    if name:
        raise _DamagedError(f"compression {name!r}")
    return bytes(data)


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
