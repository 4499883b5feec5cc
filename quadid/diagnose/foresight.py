"""Parameters that predict, for a flight that the catalogue does not explain.

Where much stays unexplained, the most likely parameters of the findings are those of the fastest motion, which the
model follows best, and a simulation half a second ahead may be worse than none.  Who needs a prediction all the same is
better served by effects of the catalogue as stand-ins for what is not known, fitted to miss by as little as possible up
to half a second ahead (`identify.ahead`).  Such numbers are no physics, and no findings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.candidates import Candidate
from quadid.diagnose.models import Model
from quadid.diagnose.vehicle_file import Fitted
from quadid.effects import EFFECTS
from quadid.errors import NotIdentifiableError
from quadid.identify.ahead import fit_ahead
from quadid.identify.floor import FLEXIBLE_DRAG
from quadid.identify.free import Free
from quadid.identify.horizon import horizon_scores
from quadid.identify.shooting import Shooting
from quadid.jsonable import jsonable
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid.window import Window

FloatArray = NDArray[np.float64]

STAND_INS = (
    "rotor_drag", "rotor_drag_moment", "axial_inflow", "rate_damping", "cg_offset", "motor_lag", "rotor_spin_up",
)  # fmt: skip
"""Effects that may stand for forces and moments nobody has named."""
POOR = 2.0
"""Deviance per row above which an unexplained flight is predicted poorly enough to refit."""
AHEAD = 0.5
"""How far ahead [s] predictions are judged."""
BETTER = 0.9
"""The refitted parameters are kept when their error is below this share of that of the findings' own."""
FREER = 20.0
"""Factor each way that nominal parameters may lie from their guess, where the vehicle file gives no bounds."""
MOTIONLESS = (
    "gyro_bias", "accel_bias", "gyro_scale", "imu_misalignment", "imu_lever_arm", "imu_lag", "attitude_delay",
    "ahrs_acceleration_error",
)  # fmt: skip
"""Effects that do not move the vehicle."""


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
        validation: unseen flights, or none.
    """
    causes = _causes(found, listed)
    free = _freer(vehicle, decisive.free([*NOMINAL_NAMES, *(n for c in causes if _moves(c) for n in c.names)]))
    try:
        ahead = fit_ahead(windows, vehicle, free, [found.theta, _start(vehicle, decisive, found)])
        if _relative(*(_errors(windows, vehicle, theta) for theta in (ahead.theta, found.theta))) > np.log(BETTER):
            return None
        seen = list(validation) or windows
        diagnosed, refitted = (_errors(seen, vehicle, theta) for theta in (found.theta, ahead.theta))
    except NotIdentifiableError:  # no run of that length fits into any flight
        return None
    named = {c.effect for c in found.causes}
    sigma = (ahead.sigma * free.jacobian(ahead.theta)).tolist()
    return Foresight(
        Fitted(ahead.theta, dict(zip(free.names, sigma, strict=True)), causes),
        tuple(e for e in STAND_INS if e not in named), "validation logs" if validation else "training logs",
        diagnosed, refitted,
    )  # fmt: skip


def _freer(vehicle: Vehicle, free: Free) -> Free:
    """Lets nominal parameters whose bounds are mere defaults stand in too: such an inertia is none any more."""
    bounds = {n: (p.initial / FREER, p.initial * FREER) for n, p in vehicle.parameters.items() if p.bounds is None}
    return Free(tuple(
        replace(e, lower=bounds[e.name][0], upper=bounds[e.name][1]) if e.name in bounds else e for e in free.entries
    ))  # fmt: skip


def _causes(found: Model, listed: Sequence[Candidate]) -> tuple[Candidate, ...]:
    present = {c.label for c in found.causes}
    return (*found.causes, *(c for c in listed if c.label in STAND_INS and c.label not in present and not c.split))


def _start(vehicle: Vehicle, decisive: Shooting, found: Model) -> FloatArray:
    """What is not refitted as found; the rest as in the vehicle file, with some drag: the findings may be far off."""
    out = decisive.layout.initial(vehicle)
    kept = [c for c in found.causes if not _moves(c)]
    places = [*decisive.free([n for c in kept for n in c.names]).index, *(c.timed for c in kept if c.timed is not None)]
    out[places] = found.theta[places]
    out[decisive.free(["rotor_drag.k_x", "rotor_drag.k_y"]).index] = FLEXIBLE_DRAG
    return out


def _moves(cause: Candidate) -> bool:
    """Whether a cause is refitted: it acts on the motion, all the time, and is the same in every flight."""
    return cause.effect not in MOTIONLESS and cause.timed is None and not EFFECTS[cause.effect].per_log


def _errors(windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray) -> dict[str, float]:
    """Mean error over all starts after `AHEAD`, by quantity; NaN for what the flights lack."""
    steps = max(round(AHEAD / windows[0].dt), 1)
    return horizon_scores([[w] for w in windows], vehicle, theta, (steps,))[0].at(steps)


def _relative(errors: dict[str, float], before: dict[str, float]) -> float:
    """Mean logarithm of the ratio; infinite when a prediction ran away."""
    ratios = np.array([errors[q] / e for q, e in before.items() if np.isfinite(e)])
    return float(np.mean(np.log(ratios))) if ratios.size and np.isfinite(ratios).all() else np.inf
