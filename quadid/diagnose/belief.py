"""Numbers that no vehicle has: what carries them fits, but stands for something else.

A fit takes whatever lowers its cost.  Air that pushes, drag that acts a foot above the vehicle, an accelerometer off by
half of gravity may all be near enough to something that the catalogue lacks; they are not what their names say.
"""

from __future__ import annotations

from collections.abc import Iterator

from quadid.diagnose.handover import sensor_errors
from quadid.diagnose.models import Model
from quadid.identify.covariance import Z95
from quadid.identify.shooting import Shooting
from quadid.model.layout import Entry

LIKELY_SENSOR = 10.0
"""Typical sizes beyond which an error of a sensor is not believed."""
WRONG_SIGN = 0.1
"""Share of its typical size by which a number that cannot be negative may be, for what a fit lays beside the truth."""
AT_BOUND = 1e-6
"""Share of the width of the bounds within which a number rests on one of them."""


def beyond_belief(shooting: Shooting, model: Model) -> list[str]:
    """Sentences about numbers of `model` that its causes cannot have."""
    sizes = [
        f"{_told(e, model)} is more than a sensor that works can have ({LIKELY_SENSOR * e.typical:.3g} {e.unit})"
        for e in sensor_errors(shooting, model, LIKELY_SENSOR)
    ]
    signs = [f"{_told(e, model)} cannot be negative" for e in _of_wrong_sign(model)]
    bounds = [f"{_told(e, model)} rests on its bound ({_bound(e, model):.3g} {e.unit})" for e in _at_bounds(model)]
    return [f"{s}: it stands for something else, and no finding is confident" for s in (*sizes, *signs, *bounds)]


def _told(entry: Entry, model: Model) -> str:
    return f"{entry.name} = {float(model.theta[entry.index]):.3g} {entry.unit}".rstrip()


def _entries(model: Model) -> Iterator[Entry]:
    names = {n for c in model.causes for n in c.names}
    return (e for e in model.free.entries if e.name in names)


def _of_wrong_sign(model: Model) -> Iterator[Entry]:
    sigma = dict(zip(model.free.names, model.sigma, strict=True))
    for e in _entries(model):
        highest = (float(model.theta[e.index]) - e.neutral) / e.typical + Z95 * sigma[e.name]
        if e.sign > 0 and highest < -WRONG_SIGN:
            yield e


def _at_bounds(model: Model) -> Iterator[Entry]:
    return (e for e in _entries(model) if _bound(e, model) is not None)


def _bound(entry: Entry, model: Model) -> float | None:
    """The bound, other than neutral, that a number rests on."""
    value, near = float(model.theta[entry.index]), AT_BOUND * (entry.upper - entry.lower)
    return next((b for b in (entry.lower, entry.upper) if b != entry.neutral and abs(value - b) <= near), None)
