"""Tables of results: text that fits a terminal, HTML for notebooks, and parts of a page."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal, NamedTuple

from quadid.report.page import raised, rows_of
from quadid.report.verdict import digits, parameter_name, percent, relative_halfwidth, status_words
from quadid.types import Json, JsonDict

# --- Tables as text that fits a width: columns that matter less go, more columns stand below, values are never cut


Tone = Literal["", "good", "fair", "poor", "title", "head", "dim"]
"""Role of a piece of text, which decides its colour."""
SPACE = "  "


class Cell(NamedTuple):
    """A value with its tone."""

    text: str
    tone: Tone = ""


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        heading: its heading, with the unit where all values share one.
        rank: 0 always stays; of the others the highest goes first where the width does not hold all.
    """

    heading: str
    right: bool = False
    rank: int = 0


def heads(line: str) -> tuple[Column, ...]:
    """Columns by the line of their headings: ``log | error > | unit <2``, ``>`` to the right, then the rank."""
    found = (re.fullmatch(r"(.+?)(?: ([<>])(\d?))?", head) for head in line.split(" | "))
    return tuple(Column(m[1], m[2] == ">", int(m[3] or 0)) for m in found if m)


@dataclass(frozen=True)
class TextTable:
    """A titled table; `rows` have one text or `Cell` a column."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str | Cell, ...], ...]

    def lines(self, width: int) -> list[tuple[Cell, ...]]:
        """Lines of pieces with their tones, for a terminal of `width` columns."""
        heading = tuple(Cell(column.heading, "head") for column in self.columns)
        table = [heading, *(tuple(map(_cell, row)) for row in self.rows)]
        widths = [max(len(cell.text) for cell in column) for column in zip(*table, strict=True)]
        aligned = [str.rjust if column.right else str.ljust for column in self.columns]

        def wide(columns: Sequence[int]) -> int:
            return sum(widths[i] for i in columns) + len(SPACE) * (len(columns) - 1)

        # Columns that fit, those of rank 0 in any case; the highest rank goes first.
        kept = list(range(len(self.columns)))
        going = sorted((i for i in kept if self.columns[i].rank > 0), key=lambda i: (-self.columns[i].rank, -i))
        while going and wide(kept) > width:
            kept.remove(going.pop(0))
        # What the width does not hold beside each other stands below, beside the first column, which names the rows.
        blocks = [kept[:1]]
        for i in kept[1:]:
            if len(blocks[-1]) > 1 and wide([*blocks[-1], i]) > width:
                blocks.append(kept[:1])
            blocks[-1] = [*blocks[-1], i]
        out: list[tuple[Cell, ...]] = [
            (Cell(line, "title"),) for line in textwrap.wrap(self.title, max(width, 20)) or [""]
        ]
        for n, block in enumerate(blocks):
            out += [(Cell(""),)] * (n > 0)
            for row in table:
                out.append(tuple(Cell(aligned[i](row[i].text, widths[i]), row[i].tone) for i in block))
        return out

    def text(self, width: int = 80) -> str:
        """The table as plain text."""
        return "\n".join(SPACE.join(cell.text for cell in line).rstrip() for line in self.lines(width))

    def html(self) -> str:
        """The table as HTML, all columns."""
        head = "".join(f"<th>{escape(c.heading)}</th>" for c in self.columns)
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(_cell(value).text)}</td>" for value in row) + "</tr>" for row in self.rows
        )
        return f"<table><caption>{escape(self.title)}</caption><tr>{head}</tr>{body}</table>"

    def part(self) -> JsonDict:
        """The table as part of a page, without its title."""
        rows = [[raised(_cell(value).text) for value in row] for row in self.rows]
        return rows_of([raised(c.heading) for c in self.columns], rows)


def _cell(value: str | Cell) -> Cell:
    return value if isinstance(value, Cell) else Cell(value)


# --- Results as tables for people: the same on a terminal, in a notebook and in a text


_TONES: dict[str, Tone] = {"identified": "good", "ratio_only": "fair", "prior_dominated": "poor", "unreliable": "poor"}


def number(value: float | None, digits: int = 4) -> str:
    """A number with `digits` that matter, or a dash."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def parameter_table(parameters: Sequence[Json], truth: Mapping[str, float] | None = None) -> TextTable:
    """Current and fitted values with intervals and status, and the truth of a simulation.

    Args:
        parameters: entries of ``quadid.identify/1``.
        truth: true values by name.
    """
    columns = list(heads("parameter | fitted > | ± >2 | unit | status | current >3 | 95 % interval >4"))
    if truth:
        columns.insert(2, Column("truth", right=True, rank=1))
    rows = []
    for p in parameters:
        n = digits(p)
        low, high = p["ci95"]
        row: list[str | Cell] = [
            parameter_name(p["name"]),
            number(p["value"], n),
            percent(relative_halfwidth(p)),
            p["unit"] or "1",
            Cell(status_words(p), _TONES[p["status"]]),
            number(p["initial"]),
            f"{number(low, n)} .. {number(high, n)}",
        ]
        if truth:
            row.insert(2, number(truth.get(p["name"])))
        rows.append(tuple(row))
    return TextTable("Parameters (± and interval: 95 %)", tuple(columns), tuple(rows))
