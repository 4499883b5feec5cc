"""Parameters that predict, for a flight that the catalogue does not explain.

Where much stays unexplained, the most likely parameters of the findings are those of the fastest motion, which the
model follows best, and a simulation half a second ahead may be worse than none.  Who needs a prediction all the same is
better served by effects of the catalogue as stand-ins for what is not known, fitted on segments as long as the
prediction, with all that is left counted as noise, flight by flight.  Such numbers are no physics, and no findings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.candidates import Candidate
from quadid.diagnose.models import Model, as_model
from quadid.effects import EFFECTS
from quadid.errors import NotIdentifiableError
from quadid.identify.floor import FLEXIBLE_DRAG
from quadid.identify.horizon import horizon_scores
from quadid.identify.noise import NoiseModel
from quadid.identify.polish import Polished, polish
from quadid.identify.shooting import Free, Linearised, Shooting
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
LENGTHS = (0.2, 0.4, 0.7)
"""Segments [s], short ones first: on them even a poor start is nearly linear."""
MOST_SEGMENTS = 500
"""Of longer logs every n-th segment."""
ROUNDS = 2
"""Fits on each length; after each the noise of every flight is what the fit left of it."""
ITERATIONS = 4
AHEAD = 0.5
"""How far ahead [s] predictions are judged."""
BETTER = 0.9
"""The refitted parameters are kept when their error is below this share of that of the findings' own."""
_EXPECTED = np.array([0.3] * 3 + [0.05] * 3 + [1.0] * 3 + [0.1] * 3 + [0.03] * 3)
"""What such a prediction typically misses by: rad/s, rad, m/s^2, m/s, m."""
MOTIONLESS = (
    "gyro_bias", "accel_bias", "gyro_scale", "imu_misalignment", "imu_lever_arm", "imu_lag", "attitude_delay",
    "ahrs_acceleration_error",
)  # fmt: skip
"""Effects that do not move the vehicle."""


@dataclass(frozen=True)
class Foresight:
    """Model refitted to predict.

    Attributes:
        model, shooting: the refitted model and the problem it was fitted on.
        stand_ins: effects in it that are not findings.
        on: ``validation logs`` or ``training logs``, where the errors were taken.
        diagnosed: mean error after `AHEAD` of the findings' own parameters, by quantity.
        refitted: likewise of the refitted ones.
    """

    model: Model
    shooting: Shooting
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

    Which length of segments serves best is decided on `windows`; `validation` only measures.

    Args:
        windows: training flights.
        vehicle: nominal vehicle.
        decisive: problem on which `found` was fitted.
        found: the findings' model.
        listed: the catalogue.
        validation: unseen flights, or none.
    """
    causes = _causes(found, listed)
    best, least = None, np.log(BETTER)
    try:
        before = _errors(windows, vehicle, found.theta)
        for fitted in _stages(windows, vehicle, decisive, causes, _start(vehicle, decisive, found)):
            ratio = _relative(_errors(windows, vehicle, fitted[1].theta), before)
            if ratio < least:
                best, least = fitted, ratio
        if best is None:
            return None
        seen = list(validation) or windows
        diagnosed, refitted = (_errors(seen, vehicle, theta) for theta in (found.theta, best[1].theta))
    except NotIdentifiableError:  # no run of that length fits into any flight
        return None
    shooting, result, free = best
    named = {c.effect for c in found.causes}
    return Foresight(
        as_model(shooting, result, free, causes), shooting, tuple(e for e in STAND_INS if e not in named),
        "validation logs" if validation else "training logs", diagnosed, refitted,
    )  # fmt: skip


def _causes(found: Model, listed: Sequence[Candidate]) -> tuple[Candidate, ...]:
    present = {c.label for c in found.causes}
    return (*found.causes, *(c for c in listed if c.label in STAND_INS and c.label not in present and not c.split))


def _start(vehicle: Vehicle, decisive: Shooting, found: Model) -> FloatArray:
    """Sensors as found; the motion as in the vehicle file, with some drag: the findings may lie in the wrong basin."""
    out = decisive.layout.initial(vehicle)
    sensors = decisive.free([n for c in found.causes if not _moves(c) for n in c.names]).index
    out[sensors] = found.theta[sensors]
    out[decisive.free(["rotor_drag.k_x", "rotor_drag.k_y"]).index] = FLEXIBLE_DRAG
    return out


def _moves(cause: Candidate) -> bool:
    """Whether a cause is refitted: it acts on the motion, all the time, and is the same in every flight."""
    return cause.effect not in MOTIONLESS and cause.timed is None and not EFFECTS[cause.effect].per_log


def _stages(
    windows: Sequence[Window], vehicle: Vehicle, decisive: Shooting, causes: Sequence[Candidate], start: FloatArray
) -> Iterator[tuple[Shooting, Polished, Free]]:
    """Yields problem, polish and free parameters of each length, each begun where the one before ended."""
    names = [n for c in causes if _moves(c) for n in c.names]
    sigma: FloatArray | None = None
    for seconds in LENGTHS:
        shooting = Shooting(windows, vehicle, seconds, None, decisive.layout)
        shooting = shooting.thinned(max(shooting.count // MOST_SEGMENTS, 1))
        free = shooting.free([*NOMINAL_NAMES, *names])
        for _ in range(ROUNDS):
            _weigh(shooting, sigma)
            result = polish(shooting, start, free, iterations=ITERATIONS)
            sigma, start = _left(result.lin, len(shooting.rollouts)), result.theta
        yield shooting, result, free


def _weigh(shooting: Shooting, sigma: FloatArray | None) -> None:
    """Counts `sigma`, shape (windows, channels), as the noise of each flight; None: the same for all."""
    noise = _EXPECTED[: shooting.channels] if sigma is None else np.exp(np.mean(np.log(sigma), axis=0))
    shooting.noise = NoiseModel(noise, np.zeros(shooting.channels))
    if sigma is not None:
        shooting.robust = [
            np.broadcast_to(noise / own, (len(s.starts), s.length, shooting.channels)).copy()
            for own, s in zip(sigma, shooting.segments, strict=True)
        ]


def _left(lin: Linearised, windows: int) -> FloatArray:
    """Root mean square residual of each flight and channel; where nothing was measured, what is typical."""
    out = np.tile(_EXPECTED[: lin.residuals.shape[2]], (windows, 1))
    for i in range(windows):
        used = lin.weights[lin.window == i] > 0.0
        square = np.where(used, lin.residuals[lin.window == i], 0.0) ** 2
        count = used.sum(axis=(0, 1))
        mean = square.sum(axis=(0, 1)) / np.maximum(count, 1)
        out[i] = np.where((count > 0) & (mean > 0.0), np.sqrt(mean), out[i])
    return out


def _errors(windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray) -> dict[str, float]:
    """Mean error over all starts after `AHEAD`, by quantity; NaN for what the flights lack."""
    steps = max(round(AHEAD / windows[0].dt), 1)
    return horizon_scores([[w] for w in windows], vehicle, theta, (steps,))[0].at(steps)


def _relative(errors: dict[str, float], before: dict[str, float]) -> float:
    """Mean logarithm of the ratio; infinite when a prediction ran away."""
    ratios = np.array([errors[q] / e for q, e in before.items() if np.isfinite(e)])
    return float(np.mean(np.log(ratios))) if ratios.size and np.isfinite(ratios).all() else np.inf
