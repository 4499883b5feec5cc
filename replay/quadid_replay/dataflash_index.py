"""Finds the records of an ArduPilot DataFlash log and reads their columns.

The format descriptions are pymavlink's (`DFFormat`); finding and reading are ours, because pymavlink makes one Python
object a record, stops at the first unknown record and raises on a damaged description.  Here a damaged place is skipped
and counted.
"""

from __future__ import annotations

import mmap
import struct
from array import array
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pymavlink.DFReader import FORMAT_TO_STRUCT, DFFormat, null_term

from quadid.types import FloatArray, IntArray

_HEAD = b"\xa3\x95"
_FMT_TYPE, _FMT_LENGTH = 0x80, 89
_PADDING = 528
"""Block-based logs end with up to this many bytes of padding, which is not damage."""
_ROWS = 65536


@dataclass
class DataflashIndex:
    """Where the records of a log are.

    Attributes:
        data: the file's bytes, mapped.
        formats: description by message name.
        offsets: byte offsets of the records, by message name.
        skipped: bytes that belong to no record (padding at the end not counted).
        damaged: names of messages whose description is damaged.
        redefined: names of messages that are described anew within the log; what follows the change is not used.
        cut: whether the file ends inside a record.
    """

    data: mmap.mmap
    formats: dict[str, DFFormat] = field(default_factory=dict)
    offsets: dict[str, array[int]] = field(default_factory=dict)
    skipped: int = 0
    damaged: list[str] = field(default_factory=list)
    redefined: list[str] = field(default_factory=list)
    cut: bool = False

    def count(self, name: str) -> int:
        """Returns the number of records called `name`."""
        return len(self.offsets.get(name, ()))

    def has(self, name: str, *columns: str) -> bool:
        """Tells whether there are records called `name` with all these columns."""
        return self.count(name) > 0 and all(c in self.formats[name].columns for c in columns)

    def rows(self, name: str) -> IntArray:
        """Returns the byte offsets of the records, shape (n,): their order in the file."""
        return np.array(self.offsets.get(name, ()), dtype=np.int64)

    def column(self, name: str, column: str) -> FloatArray:
        """Returns one numeric column, scaled as its format says, shape (n,)."""
        description = self.formats[name]
        place, kind = _place(description, description.columns.index(column))
        scale = FORMAT_TO_STRUCT[description.format[description.columns.index(column)]][1]
        code = FORMAT_TO_STRUCT[description.format[description.columns.index(column)]][0]
        raw = self._bytes(name, place, struct.calcsize("<" + code))
        with np.errstate(invalid="ignore"):  # damaged records hold signalling NaN
            values = np.asarray(raw.view(kind)[:, 0], dtype=np.float64)
        return values if scale is None else values * scale

    def text(self, name: str, column: str) -> list[str]:
        """Returns one text column."""
        description = self.formats[name]
        position = description.columns.index(column)
        width = struct.calcsize("<" + FORMAT_TO_STRUCT[description.format[position]][0])
        raw = self._bytes(name, _place(description, position)[0], width)
        return [bytes(row).split(b"\x00")[0].decode("ascii", "replace") for row in raw]

    def _bytes(self, name: str, place: int, width: int) -> NDArray[np.uint8]:
        buffer = np.frombuffer(self.data, dtype=np.uint8)
        starts = self.rows(name) + place
        out = np.empty((len(starts), width), dtype=np.uint8)
        for begin in range(0, len(starts), _ROWS):
            part = starts[begin : begin + _ROWS]
            out[begin : begin + _ROWS] = buffer[part[:, None] + np.arange(width)]
        return out


def _place(description: DFFormat, position: int) -> tuple[int, str]:
    codes = [FORMAT_TO_STRUCT[c][0] for c in description.format]
    offset = 3 + struct.calcsize("<" + "".join(codes[:position]))
    code = codes[position]
    return offset, "<f2" if code == "e" else f"<{code}" if len(code) == 1 else "u1"


def index_dataflash(path: Path) -> DataflashIndex:
    """Walks through a log once and notes where its records are; damaged stretches are skipped and counted."""
    with path.open("rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    index = DataflashIndex(data)
    names: dict[int, str] = {}
    lengths = [0] * 256
    lengths[_FMT_TYPE] = _FMT_LENGTH
    offset, size = 0, len(data)
    in_step = True  # the record before this one was whole
    while offset + 3 <= size:
        length = lengths[data[offset + 2]] if data[offset : offset + 2] == _HEAD else 0
        end = offset + length
        if (
            length == 0
            or (end > size and not in_step)
            or not (in_step or end + 2 > size or data[end : end + 2] == _HEAD)
        ):
            in_step = False
            following = data.find(_HEAD, offset + 1)
            following = size if following < 0 else following
            index.skipped += following - offset if size - following > 0 or following - offset > _PADDING else 0
            offset = following
            continue
        if end > size:
            index.cut = True
            break
        kind = data[offset + 2]
        in_step = True
        if kind == _FMT_TYPE:
            _note_format(index, data[offset + 3 : end], names, lengths)
        elif names[kind]:
            index.offsets[names[kind]].append(offset)
        offset = end
    return index


def _note_format(index: DataflashIndex, body: bytes, names: dict[int, str], lengths: list[int]) -> None:
    kind, length, raw_name, raw_format, raw_columns = struct.unpack("<BB4s16s64s", body)
    if kind == _FMT_TYPE:
        return
    if not set(raw_format.split(b"\x00")[0].decode("latin-1")) <= set(FORMAT_TO_STRUCT):
        index.damaged.append(f"type {kind}")  # pymavlink would print this
        return
    try:
        name = null_term(raw_name.decode("ascii"))
        description = DFFormat(
            kind, name, length, null_term(raw_format.decode("ascii")), null_term(raw_columns.decode("ascii"))
        )
        size = 3 + struct.calcsize("<" + "".join(FORMAT_TO_STRUCT[c][0] for c in description.format))
        fits = size == length and len(description.format) == len(description.columns) and name.isalnum()
    except Exception as error:  # noqa: BLE001 - pymavlink raises bare Exception and more on damaged text; it is reported
        index.damaged.append(f"type {kind} ({type(error).__name__})")
        return
    if not fits:
        index.damaged.append(f"type {kind}")
        return
    closed = names.get(kind) == ""
    known = None if closed else index.formats.get(names.get(kind, name))
    same = known is not None and _meaning(known) == _meaning(description)
    if same and kind in names:
        return
    if closed or known is not None:  # rows of two meanings make no column: what follows is left out
        index.redefined += [] if known is None else [known.name]
        names[kind], lengths[kind] = "", length
        return
    names[kind], lengths[kind] = name, length
    index.formats[name] = description
    index.offsets.setdefault(name, array("Q"))


def _meaning(description: DFFormat) -> tuple[str, str, list[str]]:
    return description.name, description.format, list(description.columns)
