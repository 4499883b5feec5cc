"""Numbers that no vehicle has: what carries them fits, but stands for something else.

A fit takes whatever lowers its cost.  Air that pushes, drag that acts a foot above the vehicle, an accelerometer off by
half of gravity may all be near enough to something that the catalogue lacks; their names are then wrong.  The
selection prefers causes whose numbers are possible; where none is, the finding is listed without confidence.
"""

from __future__ import annotations

from collections.abc import Sequence

from quadid.chi_square import Z95
from quadid.diagnosis.attribution import UNTIDY, untidy_sized
from quadid.diagnosis.candidates import Candidate
from quadid.diagnosis.model import Model
from quadid.effects import EFFECTS
from quadid.parameters import Parameter, Status, at_bound

LIKELY_SENSOR = 10.0
"""Typical sizes beyond which an error of a sensor is not believed."""
WRONG_SIGN = 0.1
"""Share of its typical size by which a number that cannot be negative may be, for what a fit lays beside the truth."""


def impossible_causes(model: Model) -> dict[str, str]:
    """Causes of `model` with a number that no vehicle has, and which, by label."""
    reasons = {c.label: impossible(model, c) for c in model.causes}
    return {label: reason for label, reason in reasons.items() if reason}


def late_unknown(model: Model, parameters: Sequence[Parameter]) -> dict[str, str]:
    """Lags and delays of `model` that rotation shows beside moments of inertia which are not to be used, by label.

    What is late in rotation is weaker too: a lag beside one inertia is a delay beside another.
    """
    turning = [p for p in parameters if p.name in ("J_xx", "J_yy")]
    if not all(p.status is Status.UNRELIABLE for p in turning):
        return {}
    reason = f"{' and '.join(p.name for p in turning)}, beside which rotation shows it, are not to be used"
    return {c.label: reason for c in model.causes if c.family == "late" and EFFECTS[c.effect].turns}


def slight_causes(model: Model) -> dict[str, str]:
    """Causes of `model` that something on any vehicle passes for while they are small, by label, and what.

    Air gets thinner in a climb, rotors carry otherwise in it, and motors warm up: from one part of a flight to the next
    thrust differs, and a step at the border takes that up.  A tilted vertical of the attitude pushes as a wind does.
    """
    step = f"parts of a flight differ by as much on any vehicle, {UNTIDY:g} of what it typically is"
    push = "in still air, a vertical of the attitude that is off by a degree does the same"
    small = [c for c in model.causes if untidy_sized(model, c)]
    return {c.label: push if c.timed is None else step for c in small if c.timed is not None or c.effect == "wind"}


def impossible(model: Model, cause: Candidate) -> str:
    """Which number of `cause` no vehicle has; empty when all are possible."""
    sigma = dict(zip(model.free.names, model.uncertainty.sigma, strict=True))
    for e in model.numbers(cause).entries:
        value = float(model.theta[e.index])
        size, shown = (value - e.neutral) / e.typical, f"{e.name} = {value:.3g} {e.unit}".rstrip()
        if EFFECTS[cause.effect].sized and abs(size) > LIKELY_SENSOR:
            return f"{shown} is more than a sensor that works can have ({LIKELY_SENSOR * e.typical:.3g} {e.unit})"
        if e.sign > 0 and size + Z95 * sigma[e.name] < -WRONG_SIGN:
            return f"{shown} cannot be negative"
        bound = e.lower if value - e.lower <= e.upper - value else e.upper
        if at_bound(value, e.lower, e.upper) and bound != e.neutral:
            return f"{shown} rests on its bound ({bound:.3g} {e.unit})"
    return ""
