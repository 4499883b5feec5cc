"""What a flight can tell about each parameter, what limits it, and what to fly next."""

from __future__ import annotations

import math
from typing import Any

from quadid.identify.excitation import Excitation
from quadid_report.parts import rows_of
from quadid_report.verdict import MOTION, percent

SHARP = 0.02
"""Relative standard deviation below which more flying gains nothing that anybody needs."""
COUPLED = 5.0
"""From this ratio on, it is the coupling with other parameters that limits, not the motion."""
_HEAD = ("Parameter", "Best achievable σ", "If all others were known", "Manoeuvre needed")


def excitation_part(found: Excitation, seconds: float) -> dict[str, Any]:
    """The section of the page as plain data.

    Args:
        found: bounds from the flight.
        seconds: length of the flight that they were computed from.
    """
    rows = []
    for name, bound, alone in zip(found.names, found.bound.tolist(), found.alone.tolist(), strict=True):
        rows.append((name, _sigma(bound), _sigma(alone), _advice(name, bound, alone, seconds)))
    sharp = all(b <= SHARP for b in found.bound.tolist())
    intro = (
        f"Smallest possible standard deviation from these {seconds:.0f} s, whatever the method, were the model right "
        "(Cramér–Rao bound): with all parameters unknown, and with all others known. If they differ much, the flight "
        "couples parameters."
    )
    return {
        "intro": intro,
        "table": rows_of(_HEAD, rows, classes=("", "number", "number", "")),
        "done": "Nothing more needs to be flown for these." if sharp else "",
    }


def _sigma(bound: float) -> str:
    if not math.isfinite(bound) or bound > 10.0:
        return "not at all"
    return percent(bound).replace(" ", "\u00a0")


def _advice(name: str, bound: float, alone: float, seconds: float) -> str:
    if bound <= SHARP:
        return "nothing more"
    motion = MOTION.get(name, "more motion")
    if not math.isfinite(bound) or bound > 10.0:
        return f"{motion}: this flight does not show it"
    if bound > COUPLED * alone:
        return f"{motion}, so that it moves apart from the others"
    # A deviation falls with the square root of the time flown.
    need = seconds * (bound / SHARP) ** 2
    return f"{motion}; flown like this, {percent(SHARP)} would take {need:.0f} s"
