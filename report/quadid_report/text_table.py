"""Tables as text that fits a width: columns that matter less go, more columns stand below, values are never cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal, NamedTuple

from quadid.types import JsonDict
from quadid_report.parts import rows_of

Tone = Literal["", "good", "fair", "poor", "title", "head", "dim"]
"""What a piece of text is, for whoever has colours."""
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
        right: numbers stand at the right.
        rank: 0 always stays; of the others the highest goes first where the width does not hold all.
    """

    heading: str
    right: bool = False
    rank: int = 0


@dataclass(frozen=True)
class TextTable:
    """A titled table; `rows` have one text or `Cell` a column."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str | Cell, ...], ...]

    def lines(self, width: int) -> list[tuple[Cell, ...]]:
        """Lines of pieces with their tones, for a terminal of `width` columns."""
        out: list[tuple[Cell, ...]] = [(Cell(line, "title"),) for line in _folded(self.title, width)]
        for n, kept in enumerate(self._blocks(width)):
            out += [(Cell(""),)] * (n > 0)
            widths = [self._width(i) for i in kept]
            shown = [self.columns[i] for i in kept]
            out.append(tuple(Cell(_put(c.heading, w, c.right), "head") for c, w in zip(shown, widths, strict=True)))
            for row in self.rows:
                cells = [_cell(row[i]) for i in kept]
                put = zip(cells, shown, widths, strict=True)
                out.append(tuple(Cell(_put(cell.text, w, c.right), cell.tone) for cell, c, w in put))
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
        return rows_of([c.heading for c in self.columns], [[_cell(value).text for value in row] for row in self.rows])

    def _blocks(self, width: int) -> list[list[int]]:
        """Columns that stand beside each other: those kept, below each other where the width does not hold them.

        The first column, which names the rows, begins every block.
        """
        kept = self._fitting(width)
        blocks = [kept[:1]]
        for i in kept[1:]:
            if len(blocks[-1]) > 1 and self._wide([*blocks[-1], i]) > width:
                blocks.append(kept[:1])
            blocks[-1] = [*blocks[-1], i]
        return blocks

    def _fitting(self, width: int) -> list[int]:
        """Indices of the columns that fit `width`, those of rank 0 in any case."""
        kept = list(range(len(self.columns)))
        going = sorted((i for i in kept if self.columns[i].rank > 0), key=lambda i: (-self.columns[i].rank, -i))
        while going and self._wide(kept) > width:
            kept.remove(going.pop(0))
        return kept

    def _wide(self, columns: Sequence[int]) -> int:
        return sum(self._width(i) for i in columns) + len(SPACE) * (len(columns) - 1)

    def _width(self, i: int) -> int:
        return max(len(self.columns[i].heading), *(len(_cell(row[i]).text) for row in self.rows), 0)


def _cell(value: str | Cell) -> Cell:
    return value if isinstance(value, Cell) else Cell(value)


def _put(text: str, width: int, right: bool) -> str:
    return text.rjust(width) if right else text.ljust(width)


def _folded(text: str, width: int) -> Sequence[str]:
    import textwrap

    return textwrap.wrap(text, max(width, 20)) or [""]
