"""MAVLink messages of one kind to columns, and their checksums, all at once, from the dialect's own descriptions.

Fields, their order, padding, text and checksum are pymavlink's, message by message; a test compares both.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadid.types import BoolArray, IntArray
from quadid_replay.mavlink_frames import Bytes, Frames

_TYPES = {"float": "<f4", "double": "<f8", "char": "u1"}
_BLOCK = 4096
"""Frames that are looked at together: what they need stays in the processor's cache."""


class Messages:
    """Messages of one kind; its fields are attributes: shape (n,), of an array a list of those, of text strings."""

    def __init__(self, kind: Any, payloads: Bytes) -> None:
        """Takes a message class of the dialect and payloads padded with zeros, shape (n, size)."""
        self._rows = payloads.view(_layout(kind))[:, 0]
        self._texts = {f for f, t in zip(kind.fieldnames, kind.fieldtypes, strict=True) if t == "char"}

    def __getattr__(self, name: str) -> Any:
        """The field of this name, whole numbers of up to 32 bits as int64, others as float64 or uint64."""
        if name not in (self._rows.dtype.names or ()):
            raise AttributeError(name)
        values = self._rows[name]
        if name in self._texts:
            return [row.tobytes().split(b"\0", 1)[0].decode("ascii", "replace") for row in values]
        if values.dtype != np.uint64:
            with np.errstate(invalid="ignore"):  # a signalling NaN
                values = values.astype(np.float64 if values.dtype.kind == "f" else np.int64)
        return values if values.ndim == 1 else list(values.T)


def decode(frames: Frames, kind: Any, which: IntArray) -> Messages:
    """Decodes the frames `which`, all of one kind of message, a class of the dialect."""
    size = kind.unpacker.size
    payloads = np.empty((len(which), size), dtype=np.uint8)
    columns = np.arange(size)
    for a in range(0, len(which), _BLOCK):
        some = which[a : a + _BLOCK]
        begin = frames.start[some] + frames.head[some]
        block = frames.data.take(begin[:, None] + columns, mode="clip")
        payloads[a : a + _BLOCK] = np.where(columns < (frames.end[some] - begin)[:, None], block, 0)
    return Messages(kind, payloads)


def intact(frames: Frames, which: IntArray, seeds: IntArray) -> BoolArray:
    """Tells which of these frames have the right checksum; `seeds` are their messages' (`crc_extra`), shape (n,)."""
    out = np.empty(len(which), dtype=np.bool_)
    for a in range(0, len(which), _BLOCK):
        some = which[a : a + _BLOCK]
        end = frames.end[some]
        told = frames.data[end].astype(np.uint16) | frames.data[end + 1].astype(np.uint16) << 8
        out[a : a + _BLOCK] = told == _checksums(frames.data, frames.start[some] + 1, end, seeds[a : a + _BLOCK])
    return out


def _checksums(data: Bytes, begin: IntArray, end: IntArray, seeds: IntArray) -> NDArray[np.uint16]:
    """CRC-16/MCRF4XX of these bytes and of a seed behind each, two bytes at a time, the longest first."""
    order = np.argsort(begin - end)
    begin, length = begin[order], (end - begin)[order]
    by_byte, by_two = _tables()
    crc = np.full(len(begin), 0xFFFF, dtype=np.uint16)
    for k in range(int(length.max()) // 2):
        active = int(np.searchsorted(-length, -2 * (k + 1), side="right"))
        at = begin[:active] + 2 * k
        two = data.take(at).astype(np.uint16) | data.take(at + 1).astype(np.uint16) << 8
        crc[:active] = by_two.take(crc[:active] ^ two)
    odd = length % 2 == 1
    crc[odd] = by_byte.take((crc[odd] ^ data.take((begin + length - 1)[odd])) & 0xFF) ^ crc[odd] >> 8
    out = np.empty_like(crc)
    out[order] = by_byte.take((crc ^ seeds[order].astype(np.uint16)) & 0xFF) ^ crc >> 8
    return out


@cache
def _tables() -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """What a byte, and what two, make of a checksum: shapes (256,) and (65536,)."""
    bits = np.arange(256)
    for _ in range(8):
        bits = np.where(bits & 1, bits >> 1 ^ 0x8408, bits >> 1)
    one, every = bits.astype(np.uint16), np.arange(65536, dtype=np.uint16)
    first = one[every & 0xFF] ^ every >> 8
    return one, one[first & 0xFF] ^ first >> 8


@cache
def _layout(kind: Any) -> np.dtype[np.void]:
    """The fields of a payload in the order of the wire."""
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    return np.dtype([
        (name, _TYPES.get(types[name]) or _whole(types[name]), (length,) if length else ())
        for name, length in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True)
    ])  # fmt: skip


def _whole(kind: str) -> str:
    """A whole number's type, of C in NumPy's words: ``uint16_t`` is ``<u2``."""
    return f"<{'u' if kind.startswith('u') else 'i'}{int(kind.strip('uint_')) // 8}"
