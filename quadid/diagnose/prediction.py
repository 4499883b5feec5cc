"""Parameters that predict, for a flight that the catalogue does not explain.

Where much stays unexplained, the most likely parameters of the findings are those of the fastest motion, which the
model follows best, and a simulation half a second ahead may be worse than none.  Who needs a prediction all the same is
better served by effects of the catalogue as stand-ins for what is not known, fitted to miss by as little as possible up
to half a second ahead (`identify.multistep_fit`).  Such numbers are no physics, and no findings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.extended_vehicle import Fitted
from quadid.diagnose.hypotheses import Candidate
from quadid.diagnose.model import Model
from quadid.effects import EFFECTS
from quadid.identify.multistep_fit import STAGES, fit_ahead
from quadid.identify.noise_estimation import FLEXIBLE_DRAG
from quadid.identify.open_loop import mean_errors
from quadid.identify.parameterization import Free
from quadid.identify.shooting import Shooting
from quadid.jsonable import jsonable
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid.window import Window

FloatArray = NDArray[np.float64]

POOR = 2.0
"""Deviance per row above which an unexplained flight is predicted poorly enough to refit."""
AHEAD = STAGES[-1][-1]
"""How far ahead [s] predictions are judged."""
BETTER = 0.9
"""The refitted parameters are kept when their error is below this share of that of the findings' own."""
FREER = 20.0
"""Factor each way that nominal parameters may lie from their guess, where the vehicle file gives no bounds."""


@dataclass(frozen=True)
class Foresight:
    """Model refitted to predict.

    Attributes:
        fitted: what was refitted to predict, stand-ins included.
        stand_ins: effects in it that are not findings.
        on: ``validation logs`` or ``training logs``, where the errors were taken.
        diagnosed: mean error after `AHEAD` of the findings' own parameters, by quantity.
        refitted: likewise of the refitted ones.
    """

    fitted: Fitted
    stand_ins: tuple[str, ...]
    on: str
    diagnosed: dict[str, float]
    refitted: dict[str, float]

    @property
    def sentence(self) -> str:
        """What a user of the file must know."""
        return (
            f"the extended vehicle file is refitted to predict {AHEAD:g} s ahead (rate error "
            f"{self.diagnosed['rate']:.3g} -> {self.refitted['rate']:.3g} rad/s on {self.on}), with "
            f"{', '.join(self.stand_ins) or 'its own effects'} as stand-ins for what is not known: its numbers are no "
            "physics"
        )

    def to_dict(self) -> dict[str, object]:
        """Plain data for JSON; errors that the logs lack are None."""
        return {
            "seconds_ahead": AHEAD, "on": self.on, "stand_ins": list(self.stand_ins),
            "diagnosed": jsonable(self.diagnosed), "refitted": jsonable(self.refitted),
        }  # fmt: skip


def refit_to_predict(
    windows: Sequence[Window], vehicle: Vehicle, decisive: Shooting, found: Model, listed: Sequence[Candidate],
    validation: Sequence[Window],
) -> Foresight | None:  # fmt: skip
    """Refits nominal parameters and stand-ins for prediction; None where that predicts no better.

    Whether it does is decided on `windows`; `validation` only measures.

    Args:
        windows: training flights.
        vehicle: nominal vehicle.
        decisive: problem on which `found` was fitted.
        found: the findings' model.
        listed: the catalogue.
        validation: unseen flights, or none; `windows` measure where no run fits into them.

    Raises:
        NotIdentifiableError: no run of that length fits into any training flight, or all run away.
    """
    flown = any(w.velocity is not None for w in windows)
    causes = _causes(found, listed, flown)
    free = _free(vehicle, decisive, causes, flown)
    ahead = fit_ahead(windows, vehicle, free, [found.theta, _start(vehicle, decisive, found, free)])
    diagnosed, refitted = (_errors(windows, vehicle, theta) for theta in (found.theta, ahead.theta))
    if _relative(refitted, diagnosed) > np.log(BETTER):
        return None
    on = "training logs"
    unseen = _errors(validation, vehicle, ahead.theta)
    if any(np.isfinite(e) for e in unseen.values()):
        diagnosed, refitted, on = _errors(validation, vehicle, found.theta), unseen, "validation logs"
    stand_ins = tuple(dict.fromkeys(c.effect for c in causes if c not in found.causes))
    return Foresight(Fitted(ahead.theta, {}, causes), stand_ins, on, diagnosed, refitted)


def _causes(found: Model, listed: Sequence[Candidate], flown: bool) -> tuple[Candidate, ...]:
    """Findings, and the stand-ins that are none."""
    present = {c.label for c in found.causes}
    others = [c for c in listed if EFFECTS[c.effect].stand_in and c.label not in present and not c.split]
    return (*found.causes, *(c for c in others if _refitted(c, flown)))


def _refitted(cause: Candidate, flown: bool) -> bool:
    """Whether a cause acts on the motion, all the time, the same in every flight, and shows where it was measured."""
    effect = EFFECTS[cause.effect]
    moves = effect.acts != "sensor" and cause.timed is None and not effect.per_log
    return moves and (flown or (effect.acts != "air" and effect.name != "thrust_curve"))


def _free(vehicle: Vehicle, decisive: Shooting, causes: Sequence[Candidate], flown: bool) -> Free:
    """What is refitted; nominal parameters whose bounds are mere defaults may leave them: they stand in too.

    Without a measured velocity the runs tell ratios to thrust only, so b stays as found.
    """
    nominal = [n for n in NOMINAL_NAMES if flown or n != "b"]
    free = decisive.free([*nominal, *(n for c in causes if _refitted(c, flown) for n in c.names)])
    guessed = {n: p.initial for n, p in vehicle.parameters.items() if p.bounds is None and p.sigma is None}
    if vehicle.stand_thrust is not None:
        guessed.pop("b", None)
    return Free(tuple(
        replace(e, lower=guessed[e.name] / FREER, upper=guessed[e.name] * FREER) if e.name in guessed else e
        for e in free.entries
    ))  # fmt: skip


def _start(vehicle: Vehicle, decisive: Shooting, found: Model, free: Free) -> FloatArray:
    """What is refitted as in the vehicle file, with some drag: the findings may lie in the wrong basin."""
    out = found.theta.copy()
    out[free.index] = decisive.layout.initial(vehicle)[free.index]
    out[[e.index for e in free.entries if e.name in ("rotor_drag.k_x", "rotor_drag.k_y")]] = FLEXIBLE_DRAG
    return out


def _errors(windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray) -> dict[str, float]:
    """Mean error over all starts after `AHEAD`, by quantity; NaN for what the flights lack."""
    steps = max(round(AHEAD / windows[0].dt), 1) if windows else 1
    return mean_errors(windows, vehicle, theta, steps)


def _relative(errors: dict[str, float], before: dict[str, float]) -> float:
    """Mean logarithm of the ratio; infinite when a prediction ran away, minus infinite when only the one before did."""
    known = [(errors[q], e) for q, e in before.items() if not np.isnan(e)]
    if not all(np.isfinite(e) for e, _ in known):
        return np.inf
    return float(np.mean([np.log(e / b) if np.isfinite(b) else -np.inf for e, b in known]))
