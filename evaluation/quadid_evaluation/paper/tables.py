"""Tables 1 and 2 in the paper's form, beside the paper's numbers, and the tables it lacks; plain rows of text."""

from __future__ import annotations

import math
from collections.abc import Sequence

from quadid.parameters import NOMINAL_NAMES, NOMINAL_UNITS
from quadid.report.tables import Column, TextTable
from quadid.types import Json

PAPER_MSE: dict[str, tuple[float, float, float]] = {
    "initial": (14.64, 16.81, 18.93),
    "quasi_newton": (7.67, 8.79, 8.71),
    "pso": (6.388, 6.694, 7.309),
}
"""Table 1 of the paper: MSE of sets 1, 2, 3."""
PAPER_GAIN: dict[str, tuple[float, float, float]] = {
    "initial": (0.5637, 0.6018, 0.6139),
    "quasi_newton": (0.1672, 0.2384, 0.1608),
}
"""Its gains of PSO over the others, as printed."""
PAPER_PARAMETERS: dict[str, float] = {
    "b": 2.33e-5, "d": 4.96e-7, "J_xx": 1.00e-2, "J_yy": 1.36e-2, "J_zz": 2.92e-2, "J_r": 5.00e-5,
}  # fmt: skip
"""Table 2 of the paper."""
COLUMN_NAMES = {
    "initial": "initial guess", "quasi_newton": "quasi-Newton", "pso": "PSO", "pso_polish": "PSO + polish",
    "identified": "quadid, nominal", "extended": "quadid, extended", "true_nominal": "true parameters",
    "perfect": "flown vehicle", "cva": "CVA", "moesp": "MOESP",
}  # fmt: skip
"""Models by name, for people."""


def text(value: float | None, digits: int = 4) -> str:
    """A number with `digits` that matter, or a dash."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def percent(value: float) -> str:
    """A share in per cent with two decimals, as the paper prints it."""
    return f"{100.0 * value:.2f} %"


def set_name(i: int) -> str:
    """Name of set `i`, from 0, with its role."""
    return f"set {i + 1} ({'training' if i == 0 else 'validation'})"


def table_1(result: Json) -> TextTable:
    """The paper's Table 1 with our numbers beside it."""
    mse = result["mse_paper"]
    head = ["set (paper, here)", *(COLUMN_NAMES[n] for n in PAPER_MSE)]
    head += [f"gain over {COLUMN_NAMES[n]}" for n in PAPER_GAIN]
    rows = []
    for i in range(3):
        row = [set_name(i)]
        for name, printed in PAPER_MSE.items():
            row.append(f"{text(printed[i])}, {text(mse[name][i])}")
        for name, gains in PAPER_GAIN.items():
            row.append(f"{percent(gains[i])}, {percent(1.0 - mse['pso'][i] / mse[name][i])}")
        rows.append(row)
    return _table("Table 1: mean squared error of the closed-loop simulation", head, rows)


def table_1_more(result: Json) -> TextTable:
    """The same error of models the paper does not have."""
    names = ("quasi_newton", "pso", "pso_polish", "identified", "true_nominal", "extended", "perfect")
    rows = [[set_name(i), *(text(result["mse_paper"][n][i]) for n in names)] for i in range(3)]
    return _table("Remaining error", ["set", *(COLUMN_NAMES[n] for n in names)], rows)


def table_segments(result: Json) -> TextTable:
    """Prediction over 1 s in units of the noise, subspace models too."""
    names = (
        "initial", "quasi_newton", "pso", "pso_polish", "identified", "cva", "moesp", "extended", "perfect",
    )  # fmt: skip
    rows = [[set_name(i), *(text(result["mse"][n][i]) for n in names)] for i in range(3)]
    return _table("Prediction over 1 s (1 = noise floor)", ["set", *(COLUMN_NAMES[n] for n in names)], rows)


def table_2(result: Json) -> TextTable:
    """The paper's Table 2, with what it lacks: the truth, intervals, status, spread over seeds."""
    head = [
        "parameter", "unit", "paper", "true here", "initial", "quasi-Newton", "PSO: median (range) of seeds",
        "quadid, nominal [95 % interval], status", "quadid, extended [95 % interval]",
    ]  # fmt: skip
    rows = []
    for name in NOMINAL_NAMES:
        p = result["parameters"][name]
        swarm = f"{text(p['pso'])} ({text(min(p['pso_seeds']))} … {text(max(p['pso_seeds']))})"
        nominal = f"{text(p['identified'])} [{_interval(p['ci95'])}], {p['status']}"
        extended = f"{text(p['extended'])} [{_interval(p['extended_ci95'])}]"
        rows.append([
            name, NOMINAL_UNITS[name], text(PAPER_PARAMETERS[name]), text(p["truth"]), text(p["initial"]),
            text(p["quasi_newton"]), swarm, nominal, extended,
        ])  # fmt: skip
    return _table("Table 2: parameters", head, rows)


def _interval(pair: Sequence[float]) -> str:
    return f"{text(pair[0])} … {text(pair[1])}"


def table_correlations(result: Json) -> TextTable:
    """Correlation of the estimates: what the data can only tell together."""
    rows = [
        [name, *(f"{value:+.2f}" for value in row)]
        for name, row in zip(NOMINAL_NAMES, result["correlations"], strict=True)
    ]
    return _table("Correlation of the estimates (nominal model, set 1)", ["", *NOMINAL_NAMES], rows)


def table_findings(result: Json) -> TextTable:
    """What the diagnosis found, beside what was flown."""
    rows = []
    for finding in result["findings"]:
        flown = result["flight"]["effects"].get(finding["effect"], {})
        for p in finding["parameters"]:
            rows.append([
                f"{finding['effect']}.{p['name']}", p["unit"], text(flown.get(p["name"])), text(p["value"]),
                _interval(p["ci95"]), f"{text(finding['gain']['mse_before'])} → {text(finding['gain']['mse_after'])}",
            ])  # fmt: skip
    head = ["cause", "unit", "flown", "found", "95 % interval", "error without → with"]
    return _table("What the nominal model lacks (error on sets 2 and 3, 1 = noise floor)", head, rows)


def all_tables(result: Json) -> list[TextTable]:
    """Every table in the order of the page."""
    makers = (table_1, table_1_more, table_segments, table_2, table_findings, table_correlations)
    return [maker(result) for maker in makers]


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> TextTable:
    """Rows of text; the first cell of a row names it."""
    return TextTable(title, tuple(Column(h, right=i > 0) for i, h in enumerate(head)), tuple(map(tuple, rows)))


def markdown(table: TextTable) -> str:
    """A table as Markdown."""
    lines = [f"| {' | '.join(c.heading for c in table.columns)} |", f"|{'---|' * len(table.columns)}"]
    lines += [f"| {' | '.join(map(str, row))} |" for row in table.rows]
    return "\n".join(lines)
