"""The page of `make foreign`: tables over all sets; `section` is what the command prints of each."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadid.identification.predict import QUANTITIES
from quadid_evaluation.studies.foreign.numbers import Number, of_set, table
from quadid_evaluation.studies.foreign.sets import SETS, FlightSet

AHEAD = 0.5
COMMAND = "make foreign"
SHOWN = 6
"""Residual terms that are printed."""
_LEARNT = ("ridge", "random features")


@dataclass(frozen=True)
class Row:
    """What one set gave.

    Attributes:
        identified, diagnosed: JSON results; None with the reason in `failed`.
        prediction: half-second errors as shares of no change by what predicts them, each of the four quantities.
        seconds: wall time.
        terms: formulas of the residual terms.
        soon: error of the rate after 0.1 s by the same predictors, as a share of no change.
        velocity: scale of the logged velocity against the change of position, and the position error it makes.
        date: of the measurement.
    """

    identified: dict[str, Any] | None
    diagnosed: dict[str, Any] | None
    prediction: dict[str, list[float]]
    seconds: float
    failed: str = ""
    terms: tuple[str, ...] = ()
    soon: dict[str, float] = field(default_factory=dict)
    velocity: tuple[float, float] = (float("nan"), float("nan"))
    date: str = field(default_factory=lambda: datetime.date.today().isoformat())


def page(rows: Mapping[str, Row], notes: str = "", others: Sequence[Number] = ()) -> str:
    """Markdown of all sets measured so far, `notes` last; what else each gave stands in `foreign.json`.

    `others` are numbers with truth of data beside the sets.
    """
    head = (
        f"# Vehicles of others\n\n`{COMMAND}`, {max(row.date for row in rows.values())}; parameters, intervals, sizes "
        "of causes and terms of every set are in `foreign.json`."
    )
    return (
        "\n\n".join(p.strip() for p in (head, _ahead(rows), _numbers(rows, others), _answers(rows), notes) if p) + "\n"
    )


def _answers(rows: Mapping[str, Row]) -> str:
    """Verdict, error and causes of every set."""
    lines = ["| data | verdict | error on held-out data [noise variances] | causes (brackets: not confident) |",
             "|---|---|---|---|"]  # fmt: skip
    for name, row in rows.items():
        if row.diagnosed is None:
            lines.append(f"| {name} | refused | | {row.failed.partition('; fix')[0].partition(': ')[2]} |")
            continue
        error = row.diagnosed["validation"]
        found = [f["effect"] if f["confident"] else f"({f['effect']})" for f in row.diagnosed["findings"]]
        lines.append(
            f"| {name} | {row.diagnosed['verdict']} | {error['mse_nominal']:.3g} → "
            f"{error['mse_extended']:.3g} | {', '.join(found)} |"
        )
    return "\n".join(lines)


def _ahead(rows: Mapping[str, Row]) -> str:
    """Half-second errors of all sets beside each other."""
    lines = [
        f"Errors {AHEAD:g} s ahead on unseen flights, relative to predicting no change: {', '.join(QUANTITIES)}; "
        "bold: better than ridge and random features. Iris: the other half of the same flight. A benchmark, no goal: "
        "rotor speeds were logged in closed loop, so they already answer the disturbances to come, and a model that "
        "takes torque for less than it is predicts better. The file is physics "
        "that may fly; bands of its predictions: `quadid score`.", "",
        "| data | file | ridge | random features | position error, scale of its velocity |",
        "|---|---|---|---|---|",
    ]  # fmt: skip
    for name, row in rows.items():
        if "ridge" not in row.prediction or row.diagnosed is None:
            continue
        ours = row.prediction["physical file"]
        rivals = np.min([row.prediction[who] for who in _LEARNT], axis=0)
        best = [f"**{_share(a)}**" if a < b else _share(a) for a, b in zip(ours, rivals, strict=True)]
        cells = [", ".join(best), *(", ".join(_share(s) for s in row.prediction[who]) for who in _LEARNT)]
        cells.append(f"{_share(row.velocity[1])}, {_share(row.velocity[0])}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) if len(lines) > 4 else ""


def _share(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.2f}"


def _numbers(rows: Mapping[str, Row], others: Sequence[Number]) -> str:
    """Every number whose truth is known, beside it."""
    own = [
        n for name, row in rows.items()
        for n in of_set(name, SETS[name], {"identify": row.identified, "diagnose": row.diagnosed})
    ]  # fmt: skip
    return table([*own, *others])


def section(name: str, one: FlightSet, row: Row) -> str:
    """Markdown of one set."""
    lines = [f"## {name}", "", f"`{COMMAND}` ({row.seconds:.0f} s), trained on {', '.join(one.train)}.", ""]
    if row.identified is None or row.diagnosed is None:
        return "\n".join([*lines, f"Refused: {row.failed}"])
    lines += ["| parameter | truth | identify | status | diagnose | status |", "|---|---|---|---|---|---|"]
    after = {p["name"]: p for p in row.diagnosed.get("parameters", [])}
    for p in row.identified["parameters"]:
        low, high = one.truth.get(p["name"], (np.nan, np.nan))
        truth = "" if np.isnan(low) else f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        cells = [_cell(p), p["status"], *((_cell(q), q["status"]) if (q := after.get(p["name"])) else ("", ""))]
        lines.append(f"| {p['name']} | {truth} | {' | '.join(cells)} |")
    lines += [
        "",
        f"Verdict `{row.diagnosed['verdict']}`, error on data not fitted "
        f"{row.diagnosed['validation']['mse_nominal']:.3g} → {row.diagnosed['validation']['mse_extended']:.3g} "
        "noise variances. Found: " + (", ".join(_finding(f) for f in row.diagnosed["findings"]) or "nothing") + ".",
    ]
    if row.prediction:
        lines += ["", f"Error {AHEAD:g} s ahead on {', '.join(one.unseen)}, as a share of no change:", "",
                  "| | " + " | ".join(QUANTITIES) + " |", "|---|---|---|---|---|"]  # fmt: skip
        lines += [f"| {who} | " + " | ".join(f"{s:.2f}" for s in s4) + " |" for who, s4 in row.prediction.items()]
    if row.soon:
        lines += ["", "Rate after 0.1 s: " + ", ".join(f"{who} {share:.2f}" for who, share in row.soon.items()) + "."]
    if row.terms:
        shown = "; ".join(f"`{t}`" for t in row.terms[:SHOWN])
        lines += ["", f"Beyond the catalogue {len(row.terms)} terms, first {shown}."]
    return "\n".join([*lines, "", f"Measured {row.date}."])


def _cell(p: dict[str, Any]) -> str:
    low, high = p["ci95"]
    return f"{p['value']:.3g} [{low:.3g}, {high:.3g}]"


def _finding(f: dict[str, Any]) -> str:
    numbers = ", ".join(f"{p['name']} {p['value']:.3g} {p['unit']}".strip() for p in f["parameters"])
    return f"{f['effect']} ({numbers}{'' if f['confident'] else '; not confident'})"
