"""Walks through a Crazyflie µSD log: declared event types, then records of them, then a CRC-32 of all that.

The layout is in the file: byte 0xBC, version (uint16), number of event types (uint16); per type its id (uint16), its
name and its variables, zero-ended names with the type of the number in brackets, such as ``gyro.x(f)``.  Each record is
id (uint16), time (uint64, µs) and the values, little-endian without padding.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from quadid.errors import LogError
from quadid.sanitise import plain
from quadid.types import IntArray

MOST_TYPES, MOST_VARIABLES, LONGEST_NAME = 256, 512, 128
_NUMBERS = dict(zip("bBhHiIqQfd", ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"), strict=True))
_STAMP = [("id", "<u2"), ("t", "<u8")]
_CRC = 4
_FIRST_LOOK = 16


@dataclass
class UsdRecords:
    """What a walk found.

    Attributes:
        tables: records by event type's name: structured arrays with ``t`` [µs] and the variables by their full name.
        places: where in the file each of these records stands.
        notes: what is wrong with the file, in sentences.
    """

    tables: dict[str, NDArray[np.void]] = field(default_factory=dict)
    places: dict[str, IntArray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class _Declared:
    """An event type: its name and the layout of its records."""

    def __init__(self, name: str, layout: np.dtype[np.void]) -> None:
        self.name, self.layout = name, layout
        self.parts: list[NDArray[np.void]] = []
        self.places: list[IntArray] = []


def collect_usd_records(data: bytes, name: str) -> UsdRecords:
    """Reads all whole records.

    Args:
        data: the whole file.
        name: file name, for errors.

    Raises:
        LogError: declarations that are damaged: without them no record can be read.
    """
    types, at = _declarations(data, name)
    found = UsdRecords()
    end = len(data)
    if end - at >= _CRC and zlib.crc32(data[:-_CRC]) == int.from_bytes(data[-_CRC:], "little"):
        end -= _CRC
    else:
        found.notes.append("checksum does not match: the log was cut off or damaged")
    while at + 2 <= end:
        declared = types.get(int.from_bytes(data[at : at + 2], "little"))
        if declared is None:
            break
        run = _run(data, at, end, declared)
        if len(run) == 0:
            break
        declared.parts.append(run)
        declared.places.append(at + declared.layout.itemsize * np.arange(len(run), dtype=np.int64))
        at += len(run) * declared.layout.itemsize
    if at < end:
        found.notes.append(f"{end - at} bytes at the end belong to no record")
    found.tables = {d.name: np.concatenate(d.parts) for d in types.values() if d.parts}
    found.places = {d.name: np.concatenate(d.places) for d in types.values() if d.parts}
    return found


def _run(data: bytes, at: int, end: int, declared: _Declared) -> NDArray[np.void]:
    """The records of one type that follow each other from `at` on, without one of another between them.

    It is looked for in stretches that double, so that the work is that of its own length, however much follows.
    """
    layout = declared.layout
    rows = np.frombuffer(data, layout, max((end - at) // layout.itemsize, 0), at)
    known, looked = 0, _FIRST_LOOK
    while known < len(rows):
        other = np.flatnonzero(rows["id"][known:looked] != rows["id"][0])
        if len(other):
            return rows[: known + other[0]]
        known, looked = looked, 2 * looked
    return rows


def _declarations(data: bytes, name: str) -> tuple[dict[int, _Declared], int]:
    """The event types by id, and where the records begin."""
    at, types = 5, {}
    try:
        (count,) = struct.unpack_from("<H", data, 3)
        if not 0 < count <= MOST_TYPES:
            raise ValueError(f"{count} event types")
        for _ in range(count):
            (number,) = struct.unpack_from("<H", data, at)
            title, at = _text(data, at + 2)
            (width,) = struct.unpack_from("<H", data, at)
            if width > MOST_VARIABLES:
                raise ValueError(f"{width} variables in '{plain(title)}'")
            at += 2
            fields = list(_STAMP)
            for _ in range(width):
                variable, at = _text(data, at)
                fields.append(_field(variable))
            if number in types:
                raise ValueError(f"event type {number} twice")
            types[number] = _Declared(title, np.dtype(fields))
    except (struct.error, ValueError) as error:
        raise LogError(
            f"{name}: damaged list of variables ({error})", "a Crazyflie µSD log, version 2", "copy the file again"
        ) from error
    return types, at


def _text(data: bytes, at: int) -> tuple[str, int]:
    """A zero-ended name and where the next thing begins."""
    end = data.find(b"\0", at, at + LONGEST_NAME)
    if end < 0:
        raise ValueError("a name without end")
    return data[at:end].decode("ascii"), end + 1


def _field(variable: str) -> tuple[str, str]:
    """Name and layout of a variable such as ``gyro.x(f)``."""
    if len(variable) < 4 or variable[-3] != "(" or variable[-1] != ")" or variable[-2] not in _NUMBERS:
        raise ValueError(f"variable '{plain(variable)}' of unknown type")
    return variable[:-3], "<" + _NUMBERS[variable[-2]]
