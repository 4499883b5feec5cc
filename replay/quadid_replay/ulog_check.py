"""Walks through the records of a PX4 ULog before pyulog does: damage it would not report, and bombs it would inflate.

pyulog says a file is not corrupt when it simply ends inside a record, and it expands nested message formats without
limit.
"""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import NamedTuple

from quadid.errors import LogError

_KNOWN = frozenset(b"BFIMPQARDLCSO")
_SYNC = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
_HEADER = 16
MOST_FIELDS = 5000
"""Most numbers one message may hold once its nested types are expanded."""
_BASIC = frozenset(f"{sign}int{bits}_t" for sign in ("", "u") for bits in (8, 16, 32, 64)) | {
    "float", "double", "bool", "char",
}  # fmt: skip


class UlogDamage(NamedTuple):
    """Bytes that belong to no record, and whether the file ends inside one."""

    skipped: int
    cut: bool


def check_ulog(path: Path) -> UlogDamage:
    """Walks through all records.

    Raises:
        LogError: a message format that expands beyond `MOST_FIELDS`, or a file without any record.
    """
    with path.open("rb") as file:
        if path.stat().st_size <= _HEADER:
            raise LogError(f"{path.name}: holds a header and nothing else", "a complete ULog", "copy it again")
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    formats: dict[str, list[tuple[str, int]]] = {}
    skipped, offset, size = 0, _HEADER, len(data)
    while offset + 3 <= size:
        length, kind = data[offset] | data[offset + 1] << 8, data[offset + 2]
        if kind not in _KNOWN or length == 0:
            following = data.find(_SYNC, offset + 1)
            following = size if following < 0 else following + len(_SYNC)
            skipped += following - offset
            offset = following
            continue
        if offset + 3 + length > size:
            return UlogDamage(skipped, True)
        if kind == ord("F"):
            _note_format(data[offset + 3 : offset + 3 + length], formats)
        offset += 3 + length
    for name in formats:
        if _expanded(name, formats, {}, 0) > MOST_FIELDS:
            raise LogError(
                f"{path.name}: message '{name}' expands to more than {MOST_FIELDS} numbers",
                "messages as PX4 writes them", "this file is damaged or was made to harm: do not trust it",
            )  # fmt: skip
    return UlogDamage(skipped, offset < size)


def _note_format(body: bytes, formats: dict[str, list[tuple[str, int]]]) -> None:
    name, _, fields = body.decode("utf-8", "replace").partition(":")
    parsed = []
    for entry in fields.split(";"):
        kind, bracket, count = entry.partition(" ")[0].partition("[")
        if kind:
            digits = count.rstrip("]")
            parsed.append((kind, int(digits) if bracket and digits.isdecimal() else 1))
    formats[name] = parsed


def _expanded(name: str, formats: dict[str, list[tuple[str, int]]], known: dict[str, int], depth: int) -> int:
    """Counts the numbers of a message; a type that holds itself counts as endless."""
    if depth > 32:
        return MOST_FIELDS + 1
    if name not in known:
        known[name] = MOST_FIELDS + 1  # while being counted: met again means it holds itself
        total = 0
        for kind, count in formats.get(name, []):
            total += count if kind in _BASIC else count * _expanded(kind, formats, known, depth + 1)
        known[name] = total
    return known[name]
