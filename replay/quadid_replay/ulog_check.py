"""Walks through the records of a PX4 ULog and hands pyulog only whole ones, of the topics that are wanted.

pyulog says a file is not corrupt when it simply ends inside a record (26 of 30 random cuts), and loops for ever on some
damaged definitions.
"""

from __future__ import annotations

import mmap
import re
import struct
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from quadid.errors import LogError
from quadid.sanitise import plain

_KNOWN = frozenset(b"BFIMPQARDLCSO")
_DEFINITIONS = frozenset(b"FP")
_SYNC = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
_HEADER = 16
_NEAR = 65536
"""How far behind a damaged place records are looked for byte by byte; further on only sync marks are."""
_CHAIN = 3
"""So many plausible records in a row are believed to be records."""


@dataclass
class UlogRecords:
    """What a walk found.

    Attributes:
        clean: header and whole records of definitions, parameters, and data of the wanted topics.
        skipped: bytes that belong to no record.
        cut: whether the file ends inside a record.
        described_anew: a message that the file describes twice, differently; what follows is not read. Empty for none.
    """

    clean: BytesIO
    skipped: int = 0
    cut: bool = False
    described_anew: str = ""
    formats: dict[str, str] = field(default_factory=dict)
    topics: dict[tuple[str, int], str] = field(default_factory=dict)
    """Message by topic without its version and instance."""
    wanted: set[int] = field(default_factory=set)
    lengths: dict[int, int] = field(default_factory=dict)
    boundaries: list[int] = field(default_factory=list)
    sync: int = 0
    """Where the next sync mark begins, as far as it was looked for; the end of the file when there is none."""


def collect_records(path: Path, topics: frozenset[str]) -> UlogRecords:
    """Walks through all records and keeps those that matter for `topics`.

    Raises:
        LogError: an encrypted or future log, or a file without any record.
    """
    if path.stat().st_size <= _HEADER:
        raise LogError(f"{path.name}: holds a header and nothing else", "a complete ULog", "copy it again")
    with path.open("rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    found = UlogRecords(BytesIO())
    found.clean.write(data[:_HEADER])
    offset, size = _HEADER, len(data)
    while offset + 3 <= size:
        length, kind = data[offset] | data[offset + 1] << 8, data[offset + 2]
        end = offset + 3 + length
        appended = next((b for b in found.boundaries if offset < b < end), None)
        if appended is not None:  # the logger stopped here and went on at the boundary
            offset = appended
        elif kind not in _KNOWN or length == 0 or (end > size and found.skipped):
            following = _next_record(data, offset + 1, found)
            found.skipped += following - offset
            offset = following
        elif end > size:
            found.cut = True
            break
        else:
            _take(found, path.name, kind, data[offset + 3 : end], topics)
            offset = size if found.described_anew else end
    found.cut |= not found.cut and offset < size
    found.clean.seek(0)
    return found


def _take(found: UlogRecords, name: str, kind: int, body: bytes, topics: frozenset[str]) -> None:
    if kind == ord("B"):
        _note_flags(found, name, body)
        return
    if kind == ord("F"):
        name, _, fields = body.decode("utf-8", "replace").partition(":")
        if found.formats.setdefault(name, fields) != fields:
            found.described_anew = plain(name, 40)
            return
    elif kind == ord("A"):
        message = body[3:].decode("utf-8", "replace")
        if unversioned(message) not in topics or len(body) < 4:
            return
        if (unversioned(message), body[0]) in found.topics:  # the first one of a topic's instance is read
            return
        found.topics[unversioned(message), body[0]] = message
        found.wanted.add(body[1] | body[2] << 8)
    elif kind == ord("D") and len(body) > 2:
        number = body[0] | body[1] << 8
        found.lengths.setdefault(number, len(body))
        if number not in found.wanted:
            return
    elif kind not in _DEFINITIONS:
        return
    found.clean.write(struct.pack("<HB", len(body), kind) + body)


def unversioned(topic: str) -> str:
    """Name of a topic without the version that newer PX4 appends (`vehicle_status_v1`)."""
    return re.sub(r"_v\d{1,3}$", "", topic)


def _next_record(data: mmap.mmap, offset: int, found: UlogRecords) -> int:
    """Returns where records go on: after the next sync mark, or nearby where several plausible ones follow."""
    if found.sync < offset:
        sync = data.find(_SYNC, offset)
        found.sync = len(data) if sync < 0 else sync
    after = min(found.sync + len(_SYNC), len(data))
    for place in range(offset, min(offset + _NEAR, after)):
        if data[place + 2 : place + 3] == b"D" and _plausible(data, place, found):
            return place
    return after


def _plausible(data: mmap.mmap, offset: int, found: UlogRecords) -> bool:
    for _ in range(_CHAIN):
        if offset + 5 > len(data):
            return False
        length, kind = data[offset] | data[offset + 1] << 8, data[offset + 2]
        if kind not in _KNOWN or not 0 < length <= 10000:
            return False
        if kind == ord("D") and found.lengths.get(data[offset + 3] | data[offset + 4] << 8) != length:
            return False
        offset += 3 + length
    return True


def _note_flags(found: UlogRecords, name: str, body: bytes) -> None:
    if len(body) < 40:
        return
    if body[8] & ~1 or any(body[9:16]):
        raise LogError(f"{name}: flags that this version cannot read", "ULog version 1", "update quadid")
    if body[8] & 1:
        found.boundaries = [b for b in struct.unpack("<3Q", body[16:40]) if b]
