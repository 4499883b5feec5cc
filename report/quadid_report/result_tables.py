"""Results as tables for people: the same on a terminal, in a notebook and in a text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from quadid.types import Json
from quadid_report.text_table import Cell, Column, TextTable, Tone
from quadid_report.verdict import digits, percent, relative_halfwidth
from quadid_report.words import parameter_name, status_words

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
    from quadid.identify.open_loop import QUANTITIES

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
