"""The paper's objective: the whole set simulated with the stabiliser in the loop, Eqs. (12) and (13).

Nothing but the references and the throttle goes in; what comes out is compared with the nine logged outputs, attitude
in degrees, rates in degrees a second, gravity-corrected acceleration in m/s^2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.errors import NotIdentifiableError
from quadid.identification.controller_gains import Autopilot
from quadid.model.closed_loop import ClosedLoop, kinematic_acceleration
from quadid.rotation import euler
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.optimisers.box import Box

RUNAWAY = 1e6
"""Squared errors are cut here, so that the score of a simulation that ran away stays a number."""


@dataclass(frozen=True)
class PaperScore:
    """Score of one parameter vector on one set.

    Attributes:
        mse: mean of the squared errors over the nine outputs, Eq. (13).
        channels: the same of each output, in its unit squared, shape (9,); NaN for what was not measured.
        fit_percent: 100 (1 - |y - y_sim| / |y - mean y|) of each output, shape (9,).
        t: times [s], shape (n,).
        measured: shape (n, 9), NaN where not measured; yaw unwrapped.
        simulated: shape (n, 9).
    """

    mse: float
    channels: FloatArray
    fit_percent: FloatArray
    t: FloatArray
    measured: FloatArray
    simulated: FloatArray


class PaperProblem:
    """The paper's objective on the windows of one set."""

    def __init__(self, windows: Sequence[Window], vehicle: Vehicle, autopilot: Autopilot) -> None:
        """Prepares windows that hold references.

        Raises:
            NotIdentifiableError: no window holds references throughout.
        """
        usable = [w for w in windows if has_references(w)]
        if not usable:
            raise NotIdentifiableError(
                "no stretch with complete attitude and throttle references",
                "roll, pitch, yaw, throttle in the log",
                "log them, or use the multiple-shooting objective",
            )
        self._loops = [ClosedLoop(w, vehicle, autopilot.gains, autopilot.rate) for w in usable]
        self._measured = [measured_outputs(w) for w in usable]
        rows = np.concatenate(self._measured)
        # Every output counts alike, however many of its samples are missing.
        self._weight = 1.0 / np.sqrt(np.maximum(np.count_nonzero(np.isfinite(rows), axis=0), 1) * _seen(rows))

    def mse(self, thetas: FloatArray) -> FloatArray:
        """Mean squared error of full parameter vectors, shapes (m, size) -> (m,)."""
        return np.asarray(np.sum(self.errors(thetas) ** 2, axis=1))

    def errors(self, thetas: FloatArray) -> FloatArray:
        """Errors whose sum of squares is the mean squared error, shapes (m, size) -> (m, samples); 0 if unmeasured."""
        parts = []
        for loop, measured in zip(self._loops, self._measured, strict=True):
            error = _difference(simulated_outputs(loop, thetas, measured), measured) * self._weight
            parts.append(np.nan_to_num(error, nan=0.0).reshape(len(thetas), -1))
        return np.concatenate(parts, axis=1)

    def score(self, theta: FloatArray) -> PaperScore:
        """Scores one parameter vector."""
        simulated = [
            simulated_outputs(loop, theta[None], y)[0] for loop, y in zip(self._loops, self._measured, strict=True)
        ]
        y, y_sim = np.concatenate(self._measured), np.concatenate(simulated)
        error = _difference(y_sim, y)
        with np.errstate(invalid="ignore"):
            count = np.maximum(np.count_nonzero(np.isfinite(error), axis=0), 1)
            channels = np.where(np.isfinite(error).any(axis=0), np.nansum(error**2, axis=0) / count, np.nan)
            spread = np.nanvar(y, axis=0)
        percent = 100.0 * (1.0 - np.sqrt(channels / np.where(spread > 0.0, spread, np.nan)))
        t = np.concatenate([loop.window.t for loop in self._loops])
        return PaperScore(float(np.nanmean(channels)), channels, percent, t, y, y_sim)


def has_references(window: Window) -> bool:
    """True when references of attitude and throttle are known in every row."""
    return window.attitude_reference is not None and bool(np.isfinite(window.attitude_reference).all())


def paper_score(
    windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, autopilot: Autopilot | None
) -> PaperScore | None:
    """Scores a parameter vector as the paper does; None where the stabiliser or the references are not known.

    Args:
        windows: of one set.
        vehicle: geometry and mass.
        theta: full parameter vector, shape (size,).
        autopilot: the stabiliser, see `quadid.identification.controller_gains.find_autopilot`.
    """
    if autopilot is None or not any(has_references(w) for w in windows):
        return None
    return PaperProblem(windows, vehicle, autopilot).score(theta)


def measured_outputs(window: Window) -> FloatArray:
    """The nine outputs of a window in the paper's units, shape (n, 9); NaN where not measured, yaw unwrapped."""
    out = np.full((len(window), 9), np.nan)
    if window.attitude is not None:
        out[:, :3] = np.degrees(euler(window.attitude))
        seen = np.isfinite(out[:, 2])
        out[seen, 2] = np.unwrap(out[seen, 2], period=360.0)
    if window.gyro is not None:
        out[:, 3:6] = np.degrees(window.gyro)
    if window.accel is not None and window.attitude is not None:
        out[:, 6:] = kinematic_acceleration(window.accel, window.attitude)
    return out


def simulated_outputs(loop: ClosedLoop, thetas: FloatArray, measured: FloatArray) -> FloatArray:
    """The nine outputs of the simulation, shape (m, n, 9); yaw on the turn of the measured one."""
    flown = loop.fly(thetas)
    angles = np.degrees([euler(q) for q in flown.attitude])
    yaw = np.nan_to_num(measured[:, 2])
    angles[..., 2] = yaw + np.remainder(angles[..., 2] - yaw + 180.0, 360.0) - 180.0
    acceleration = kinematic_acceleration(flown.accel, flown.attitude)
    return np.concatenate([angles, np.degrees(flown.rates), acceleration], axis=2)


def _seen(rows: FloatArray) -> int:
    """Number of outputs that are measured at all, at least 1."""
    return max(int(np.isfinite(rows).any(axis=0).sum()), 1)


def _difference(simulated: FloatArray, measured: FloatArray) -> FloatArray:
    """Simulated minus measured, angles the short way round; NaN where not measured, cut at `RUNAWAY`."""
    error = simulated - measured
    error[..., :3] = np.remainder(error[..., :3] + 180.0, 360.0) - 180.0
    limit = np.sqrt(RUNAWAY)
    lost = ~np.isfinite(simulated) & np.isfinite(measured)
    return np.asarray(np.where(lost, limit, np.clip(error, -limit, limit)))


class PaperBox(Box, PaperProblem):
    """The paper's objective: mean squared error over the nine outputs of the closed loop, Eq. (13)."""

    def __init__(self, windows: Sequence[Window], vehicle: Vehicle, autopilot: Autopilot) -> None:
        """Prepares the windows; raises NotIdentifiableError without references."""
        Box.__init__(self, vehicle)
        PaperProblem.__init__(self, windows, vehicle, autopilot)

    def residual(self, points: FloatArray) -> FloatArray:
        """Shapes (k, 6) -> (k, samples); the sum of squares is twice the mean squared error."""
        return np.asarray(self.errors(self.thetas(points)) * np.sqrt(2.0))

    def cost(self, points: FloatArray) -> FloatArray:
        """Mean squared errors, shapes (k, 6) -> (k,)."""
        return self.mse(self.thetas(points))
