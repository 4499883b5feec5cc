"""Fast reading and writing of messages whose numbers stand in the same places each time.

The library (`mcap_ros2`) decodes or encodes the first message of a topic; where its runs of doubles stand is found by
looking for them in the bytes.  As long as nothing else in the message but stamp and numbers changes, later messages are
read and written at those places; any other message goes the library's way.  No layout is assumed that the library did
not show.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadid.types import FloatArray, IntArray

Blocks = list[Sequence[float]]
_LITTLE_ENDIAN = b"\x00\x01"
_STAMP = struct.Struct("<iI")
_STAMP_AT, _AFTER_STAMP = 4, 12


class Read(NamedTuple):
    """A message: stamp of its header as seconds and nanoseconds, its runs of numbers, and what else was noted of it."""

    seconds: int
    nanoseconds: int
    blocks: Blocks
    extra: Any


class ReadMany(NamedTuple):
    """Messages: stamps (n,) as seconds and nanoseconds, runs of numbers (n, size), and what else was noted of all."""

    seconds: IntArray
    nanoseconds: IntArray
    blocks: list[FloatArray]
    extra: Any


class BlockReader:
    """Reads the messages of one topic.

    Args:
        decode: the library's decoder: bytes to message.
        blocks: runs of doubles of a decoded message, in the order in which they stand.
        extra: what else to note of a message (constant while nothing but numbers changes).
    """

    def __init__(
        self,
        decode: Callable[[bytes], Any],
        blocks: Callable[[Any], Blocks],
        extra: Callable[[Any], Any] = lambda message: None,
    ) -> None:
        self._decode, self._blocks, self._extra = decode, blocks, extra
        self._places: list[tuple[struct.Struct, int, int]] | None = None
        self._frame: list[tuple[int, int | None, bytes]] = []
        self._many: np.dtype[np.void] = np.dtype([])
        self._noted: Any = None
        self._size = 0

    def read(self, data: bytes) -> Read:
        """Reads one message; raises what the library raises on damaged data."""
        if self._places is not None and all(data[a:b] == same for a, b, same in self._frame):
            seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_AT)
            return Read(seconds, nanoseconds, [s.unpack_from(data, at) for s, at, _ in self._places], self._noted)
        message = self._decode(data)
        blocks = self._blocks(message)
        extra = self._extra(message)
        self._learn(data, blocks, extra)
        stamp = message.header.stamp
        return Read(stamp.sec, stamp.nanosec, blocks, extra)

    def read_many(self, messages: Sequence[bytes]) -> ReadMany | None:
        """Reads messages as `read` does one after the other; None when not all of them have the layout last learnt."""
        if self._places is None or {*map(len, messages)} != {self._size}:
            return None
        data = b"".join(messages)
        rows = np.frombuffer(data, dtype=np.uint8).reshape(len(messages), self._size)
        for begin, end, same in self._frame:
            if same and rows[:, begin:end].tobytes() != same * len(messages):
                return None
        read = np.frombuffer(data, dtype=self._many)
        blocks = [read[f"block {k}"].astype(np.float64) for k in range(len(self._places))]
        return ReadMany(
            read["seconds"].astype(np.int64), read["nanoseconds"].astype(np.int64), blocks, self._noted
        )  # fmt: skip

    def _learn(self, data: bytes, blocks: Blocks, extra: Any) -> None:
        self._places, self._frame = None, []
        if data[:2] != _LITTLE_ENDIAN:
            return
        places, begin = [], _AFTER_STAMP
        frame: list[tuple[int, int | None, bytes]] = []
        for block in blocks:
            packed = struct.pack(f"<{len(block)}d", *block)
            at = data.find(packed, begin)
            if at < 0:
                return
            places.append((struct.Struct(f"<{len(block)}d"), at, at + len(packed)))
            frame.append((begin, at, data[begin:at]))
            begin = at + len(packed)
        self._frame = [*frame, (begin, None, data[begin:])]
        self._places, self._noted, self._size = places, extra, len(data)
        self._many = np.dtype({
            "names": ["seconds", "nanoseconds", *(f"block {k}" for k in range(len(places)))],
            "formats": ["<i4", "<u4", *(("<f8", ((b - a) // 8,)) for _, a, b in places)],
            "offsets": [_STAMP_AT, _STAMP_AT + 4, *(a for _, a, _ in places)],
            "itemsize": len(data),
        })  # fmt: skip


class BlockWriter:
    """Writes messages of one topic that differ in stamp and numbers only.

    Args:
        encode: the library's encoder: message to bytes.
        build: makes a message of runs of doubles; its stamp does not matter.
        sizes: lengths of the runs.
    """

    def __init__(
        self, encode: Callable[[Any], bytes], build: Callable[[list[list[float]]], Any], sizes: Sequence[int]
    ) -> None:
        marks = [[1.0 + 0.001 * (100 * i + k) for k in range(n)] for i, n in enumerate(sizes)]
        self._bytes = bytearray(encode(build(marks)))
        self._places = []
        begin = _AFTER_STAMP
        for block in marks:
            packed = struct.pack(f"<{len(block)}d", *block)
            at = self._bytes.find(packed, begin)
            if at < 0:
                raise ValueError("the numbers do not stand together in this message")
            self._places.append((struct.Struct(f"<{len(block)}d"), at))
            begin = at + len(packed)

    def write(self, nanoseconds: int, *blocks: Sequence[float]) -> bytes:
        """Returns the message with this stamp [ns] and these numbers."""
        _STAMP.pack_into(self._bytes, _STAMP_AT, nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)
        for (layout, at), block in zip(self._places, blocks, strict=True):
            layout.pack_into(self._bytes, at, *block)
        return bytes(self._bytes)
