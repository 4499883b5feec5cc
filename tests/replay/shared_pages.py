"""SQLite files whose rows share one chain of overflow pages: small, and without end for who reads them all."""

import sqlite3
import struct
from contextlib import closing
from pathlib import Path


def share_first_row(path: Path, table: str, rows: int) -> None:
    """Makes a table of so many rows of its only one, which is larger than a page; only their numbers differ."""
    with closing(sqlite3.connect(path)) as db:
        (root,) = db.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
    data = bytearray(path.read_bytes())
    page = struct.unpack(">H", data[16:18])[0]
    leaf = data[(root - 1) * page : root * page]
    cell = bytes(leaf[struct.unpack(">H", leaf[8:10])[0] :])  # the only one ends with its page
    per, number = (page - 8) // (len(cell) + 6), len(data) // page + 1
    pages: list[bytes] = []
    level: list[tuple[int, int]] = []
    for first in range(1, rows + 1, per):
        numbers = range(first, min(first + per, rows + 1))
        pages.append(_leaf([_with_row(cell, row) for row in numbers], page))
        level.append((number, numbers[-1]))
        number += 1
    while len(level) > 40:
        above = []
        for a in range(0, len(level), 40):
            pages.append(_interior(level[a : a + 40], page))
            above.append((number, level[a : a + 40][-1][1]))
            number += 1
        level = above
    data[(root - 1) * page : root * page] = _interior(level, page)
    data += b"".join(pages)
    data[28:32], data[92:96] = struct.pack(">I", len(data) // page), data[24:28]
    path.write_bytes(data)


def _varint(value: int) -> bytes:
    parts = [value & 0x7F]
    while value := value >> 7:
        parts.append(value & 0x7F | 0x80)
    return bytes(reversed(parts))


def _skip_varint(data: bytes, at: int) -> int:
    while data[at] & 0x80:
        at += 1
    return at + 1


def _with_row(cell: bytes, row: int) -> bytes:
    size = _skip_varint(cell, 0)
    return cell[:size] + _varint(row) + cell[_skip_varint(cell, size) :]


def _leaf(cells: list[bytes], page: int) -> bytes:
    out, at, places = bytearray(page), page, []
    for cell in cells:
        at -= len(cell)
        out[at : at + len(cell)] = cell
        places.append(at)
    out[0], out[3:5], out[5:7] = 13, struct.pack(">H", len(cells)), struct.pack(">H", at)
    out[8 : 8 + 2 * len(places)] = struct.pack(f">{len(places)}H", *places)
    return bytes(out)


def _interior(children: list[tuple[int, int]], page: int) -> bytes:
    out, at, places = bytearray(page), page, []
    for number, key in children[:-1]:
        cell = struct.pack(">I", number) + _varint(key)
        at -= len(cell)
        out[at : at + len(cell)] = cell
        places.append(at)
    out[0], out[3:5], out[5:7], out[8:12] = (
        5,
        struct.pack(">H", len(places)),
        struct.pack(">H", at),
        struct.pack(">I", children[-1][0]),
    )
    out[12 : 12 + 2 * len(places)] = struct.pack(f">{len(places)}H", *places)
    return bytes(out)
