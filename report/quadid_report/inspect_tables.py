"""An inspection as tables for people."""

from __future__ import annotations

from quadid.inspection import Inspection
from quadid.sanitise import LONGEST_LINE, plain
from quadid_report.result_tables import number
from quadid_report.text_table import Cell, Column, TextTable, Tone
from quadid_report.words import parameter_name

_TONES: dict[str, Tone] = {"ok": "good", "warning": "fair", "error": "poor", "unknown": "dim"}


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
    rows = tuple((_spaced(c.name), Cell(c.verdict.value, _TONES[c.verdict.value])) for c in found.checks)
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
    """What the checks found, what is missing, and whether the log can be used, a sentence each."""
    out = []
    for check in found.checks:
        fix = f". Fix: {_clean(check.fix)}" if check.fix else ""
        out.append(Cell(f"{_spaced(check.name)}: {_clean(check.message)}{fix}", _TONES[check.verdict]))
    out += [Cell(f"missing: {m.channel}: {_clean(m.why)}. To get it: {_clean(m.how)}", "fair") for m in found.missing]
    usable = "usable for identification" if found.usable else "not usable for identification as it is"
    return [*out, Cell(usable, "good" if found.usable else "poor")]


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
