"""Tables of results as text that fits a width."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal, NamedTuple

from quadid.checks import Inspection
from quadid.identification.predict import QUANTITIES
from quadid.report.figures import rows_of
from quadid.report.verdict import digits, parameter_name, percent, relative_halfwidth, status_words
from quadid.sanitise import LONGEST_LINE, plain
from quadid.types import Json, JsonDict

# --- Tables as text that fits a width: columns that matter less go, more columns stand below, values are never cut


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

    return textwrap.wrap(text, max(width, 20)) or [""]


# --- Results as tables for people: the same on a terminal, in a notebook and in a text


_TONES: dict[str, Tone] = {"identified": "good", "ratio_only": "fair", "prior_dominated": "poor", "unreliable": "poor"}
_RATES = ("p", "q", "r", "a_z")


def number(value: float | None, digits: int = 4) -> str:
    """A number with `digits` that matter, or a dash."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def parameter_table(parameters: Sequence[Json], truth: Mapping[str, float] | None = None) -> TextTable:
    """Current and fitted values with intervals and status; the truth where a simulation knows it.

    Args:
        parameters: entries of ``quadid.identify/1``.
        truth: true values by name.
    """
    columns = [
        Column("parameter"), Column("fitted", right=True), Column("±", right=True, rank=2), Column("unit"),
        Column("status"), Column("current", right=True, rank=3), Column("95 % interval", right=True, rank=4),
    ]  # fmt: skip
    if truth:
        columns.insert(2, Column("truth", right=True, rank=1))
    rows = []
    for p in parameters:
        n = digits(p)
        low, high = p["ci95"]
        row: list[str | Cell] = [
            parameter_name(p["name"]), number(p["value"], n), percent(relative_halfwidth(p)), p["unit"] or "1",
            Cell(status_words(p), _TONES[p["status"]]), number(p["initial"]), f"{number(low, n)} .. {number(high, n)}",
        ]  # fmt: skip
        if truth:
            row.insert(2, number(truth.get(p["name"])))
        rows.append(tuple(row))
    return TextTable("Parameters (± and interval: 95 %)", tuple(columns), tuple(rows))


def set_table(sets: Sequence[Json]) -> TextTable:
    """How well the simulation follows each log, with current and with fitted parameters."""
    columns = (
        Column("log"), Column("role"), Column("current", right=True), Column("fitted", right=True),
        *(Column(f"fit {n}", right=True, rank=1) for n in _RATES),
    )  # fmt: skip
    rows = []
    for s in sets:
        fits = [s["fit_percent"].get(n) for n in _RATES]
        rows.append(
            (
                s["log"],
                s["role"],
                number(s["mse"]["initial"], 3),
                number(s["mse"]["fitted"], 3),
                *("-" if v is None or not math.isfinite(v) else f"{max(v, -999.0):.0f} %" for v in fits),
            )
        )
    return TextTable("Error over 1 s of simulation, in noise variances (1 = noise floor)", columns, tuple(rows))


def horizon_table(result: Json) -> TextTable:
    """Open-loop prediction errors, pooled and for each file.

    Args:
        result: of the form ``quadid.score/1``.
    """
    many = len(result["files"]) > 1
    columns = (
        Column("log"), Column("after", right=True),
        *(
            Column(f"{name} [{unit}]", right=True, rank=max(2 - i, 0))
            for i, (name, unit) in enumerate(QUANTITIES.items())
        ),
    )  # fmt: skip
    rows = []
    for entry in [*(result["files"] if many else []), result]:
        label = entry.get("log", "all" if many else result["files"][0]["log"])
        for horizon, errors in entry["horizons"].items():
            rows.append((label, str(horizon), *(_error(errors[n]) for n in QUANTITIES)))
            label = ""
        total = entry["sum"]
        rows.append(("", f"sum 1..{total['to']}", *(_error(total[n]) for n in QUANTITIES)))
    last = list(result["horizons"])[-1]
    for label, key in (("noise floor", "noise_floor"), ("no change predicted", "no_change")):
        rows.append((label, last, *(number(result[key][last][n]) for n in QUANTITIES)))
    title = f"Open-loop prediction error of '{result['vehicle']}' after n samples, mean of {result['samples']} runs"
    return TextTable(title, columns, tuple(rows))


def coverage_table(result: Json) -> TextTable:
    """Shares of outcomes inside the predicted bands of 50, 80 and 95 %.

    Args:
        result: of the form ``quadid.score/1``.
    """
    bands = ("50", "80", "95")
    columns = (Column("after", right=True), Column("of"), *(Column(f"{band} % band", right=True) for band in bands))
    rows = []
    for horizon, quantities in result["coverage"].items():
        for name, shares in (quantities or {"": None}).items():
            told = ["–"] * len(bands) if shares is None else [f"{100.0 * shares[band]:.0f} %" for band in bands]
            rows.append((horizon, name, *told))
    return TextTable("Outcomes inside the predicted bands, n samples after a filtered state", columns, tuple(rows))


def _error(value: float | None) -> str:
    return "ran away" if value == math.inf else number(value)


def finding_table(findings: Sequence[Json]) -> TextTable:
    """Every named cause with its numbers, what it gains on unseen data, and the closest rejected alternative."""
    columns = (
        Column("cause"), Column("value"), Column("without", right=True), Column("with", right=True),
        Column("95 % interval", rank=2), Column("rejected alternative", rank=1),
    )  # fmt: skip
    rows = [row for finding in findings for row in _finding_rows(finding)]
    runs = ", ".join(dict.fromkeys(f"{f['gain']['seconds']:g} s" for f in findings))
    title = f"What the simulation gets wrong (error of {runs} runs in noise variances, 1 = noise floor)"
    return TextTable(title, columns, tuple(rows))


def _finding_rows(finding: Json) -> list[tuple[str | Cell, ...]]:
    rival = min(finding["alternatives"], key=lambda a: a["mse_after"], default=None)
    gain = finding["gain"]
    first: list[str | Cell] = [
        Cell(finding["effect"].replace("_", " "), "" if finding["confident"] else "fair"),
        number(gain["mse_before"], 3),
        number(gain["mse_after"], 3),
        f"{rival['effect'].replace('_', ' ')} ({number(rival['mse_after'], 3)})" if rival else "",
    ]  # fmt: skip
    rows: list[tuple[str | Cell, ...]] = []
    for p in finding["parameters"]:
        name, before, after, other = first if not rows else ["", "", "", ""]
        rows.append((name, *_finding_value(p, before, after), other))
    return rows


def _finding_value(p: Json, before: str | Cell, after: str | Cell) -> tuple[str | Cell, ...]:
    low, high = p["ci95"] or (None, None)
    if p["name"] == "rotor":
        return f"rotor {p['value']:.0f}", before, after, ""
    value = f"{p['name']} = {number(p['value'], digits(p))} {p['unit']}".rstrip()
    return value, before, after, f"{number(low, digits(p))} .. {number(high, digits(p))}"


# --- An inspection as tables for people


_INSPECT_TABLES_TONES: dict[str, Tone] = {"ok": "good", "warning": "fair", "error": "poor", "unknown": "dim"}


def inspect_tables(found: Inspection) -> list[TextTable]:
    """Channels, checks and parameters."""
    return [channel_table(found), check_table(found), parameter_outlook_table(found)]


def channel_table(found: Inspection) -> TextTable:
    """One row a channel."""
    columns = (
        Column("channel"), Column("rate (Hz)", right=True), Column("samples", right=True, rank=4),
        Column("from-to (s)", right=True, rank=3), Column("gaps", right=True),
        Column("longest (s)", right=True, rank=5), Column("dropped", right=True, rank=2), Column("source", rank=1),
    )  # fmt: skip
    rows = tuple(
        (
            f.name,
            number(f.rate),
            str(f.count),
            _from_to(f.first, f.last, found),
            str(f.gaps),
            f"{f.longest_gap:.3g}" if f.gaps else "",
            str(sum(f.dropped.values()) or ""),
            _clean(f.source),
        )
        for f in found.channels
    )
    return TextTable("Channels", columns, rows)


def check_table(found: Inspection) -> TextTable:
    """Verdict of every check; what was found and what to do follow as sentences."""
    columns = (Column("check"), Column("verdict"))
    rows = tuple((_spaced(c.name), Cell(c.verdict.value, _INSPECT_TABLES_TONES[c.verdict.value])) for c in found.checks)
    return TextTable("Checks", columns, rows)


def parameter_outlook_table(found: Inspection) -> TextTable:
    """Which parameters the log can show, and how sharply; motion says nothing where a channel lacks or is too slow."""
    expected = {str(row["name"]): float(row["relative_sigma"]) for row in found.excitation}
    columns = [Column("parameter"), Column("possible")]
    if expected:
        columns.append(Column("expected 1-sigma", right=True))
    columns.append(Column("why", rank=1))
    rows = []
    for outlook in found.parameters:
        cells = [parameter_name(outlook.parameter), "yes" if outlook.possible else "no"]
        if expected:
            sigma = expected.get(outlook.parameter, float("nan"))
            excited = f"{100.0 * sigma:.2g} %" if sigma < 10.0 else "not excited"
            cells.append(excited if outlook.possible else "")
        rows.append((*cells, _clean(outlook.reason)))
    return TextTable("What can be identified", tuple(columns), tuple(rows))


def sentences(found: Inspection) -> list[Cell]:
    """What the checks found and what is missing, a sentence each, what is wrong first."""
    out = []
    for check in found.checks:
        fix = f". Fix: {_clean(check.fix)}" if check.fix else ""
        out.append(Cell(f"{_spaced(check.name)}: {_clean(check.message)}{fix}", _INSPECT_TABLES_TONES[check.verdict]))
    out += [Cell(f"missing: {m.channel}: {_clean(m.why)}. To get it: {_clean(m.how)}", "fair") for m in found.missing]
    return out


def usability(found: Inspection) -> Cell:
    """The verdict of an inspection, with the first reason against the log."""
    wrong = [c for c in found.checks if c.verdict == "error"]
    if found.usable:
        return Cell("usable for identification", "good")
    why = f": {_spaced(wrong[0].name)}, {_clean(wrong[0].message)}" if wrong else ""
    return Cell(f"not usable for identification as it is{why}", "poor")


def heading(found: Inspection) -> str:
    """Name, format, length, and when it flies."""
    flying = ", ".join(_from_to(a, b, found) for a, b in found.flying) or "none found"
    return f"{_clean(found.name)}: {found.format}, {found.seconds:.1f} s, flying from-to (s): {flying}"


def _from_to(first: float, last: float, found: Inspection) -> str:
    """In the time of ``LOG@from:to``; a channel may begin before the IMU."""
    return f"{first - found.zero:z.1f}-{last - found.zero:z.1f}"


def _spaced(name: str) -> str:
    return name.replace("_", " ")


def _clean(text: str) -> str:
    return plain(text, LONGEST_LINE)
