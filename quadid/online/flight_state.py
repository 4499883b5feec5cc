"""How a vehicle flies, as regressors of what a change is looked for in, and a step beside them.

To first order in each effect of the catalogue (`quadid.model.equations`), with omega_h the hover speed, N rotors, f the
specific force along -z, u, v, w the velocity in body axes, and M the roll moment by b omega^2 (pitch alike, with u):

    log(f / sum omega^2) = const - 2 dead_speed sum omega / sum omega^2     thrust_curve
                           + k_z w sum omega / (N omega_h f)                axial_inflow: w < 0 in climb
                           + k (u^2 + v^2) / f                              translational_lift
                           + c_z |(u, v, w)| w / f                          parasitic_drag
    p' - M / J_xx        = const + error(b / J_xx) M                        what is known of b and J
                           - l_p p                                          rate_damping
                           - k_y h m v / J_xx                               rotor_drag h above the centre of gravity
"""

from __future__ import annotations

import math

import numpy as np

from quadid.data.resample import median
from quadid.model.layout import Layout
from quadid.online.grid_buffer import Rows
from quadid.rotation import conjugate, rotated
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

SETTLES = 40.0
"""Velocity that nobody measures is integrated, and forgotten with this time constant [s]."""
ASTRAY = 0.5
"""Standard deviation, an axis, of a velocity that was integrated [m/s]."""
SETTLED = 0.01
"""A reweighted regression is done when no coefficient moves by more than this share of its standard deviation,"""
MOST_ROUNDS = 50
"""... or after so many fits."""


class Velocity:
    """Velocity of a vehicle, as well as it is known: measured, or integrated from the specific force.

    Attributes:
        sigma: standard deviation of the newest rows, an axis [m/s].
    """

    def __init__(self) -> None:
        """Stands still."""
        self._at, self.sigma = np.zeros(3), ASTRAY

    def body(self, rows: Rows) -> FloatArray:
        """Velocity in body axes [m/s] of the next rows, shape (n, 3); zero where no attitude says what is up."""
        q, force = rows.columns.get("attitude"), rows.columns["accel"]
        if q is None or len(rows.t) < 2:
            return np.zeros_like(force)
        step, known = float(rows.t[1] - rows.t[0]), np.isfinite(q).all(axis=1)
        q = q[np.maximum.accumulate(np.where(known, np.arange(len(q)), np.argmax(known)))]
        gain = np.nan_to_num(rotated(q, force) + [0.0, 0.0, GRAVITY]) * step
        gained = np.cumsum(gain, axis=0) - 0.5 * gain
        start = self._at * math.exp(-step * len(rows.t) / SETTLES)
        measured, self.sigma = rows.columns.get("velocity"), ASTRAY
        if measured is not None and (here := np.isfinite(measured).all(axis=1)).any():
            start, self.sigma = np.mean(measured[here] - gained[here], axis=0), 0.0
        self._at = start + gain.sum(axis=0)
        return np.nan_to_num(rotated(conjugate(q), start + gained))


class FlightState:
    """Regressors of one vehicle.

    Attributes:
        typical: standard deviations of the coefficients of thrust before any data, shape (4,).
        typical_moment: of those of a moment but the first, shape (2,).
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """Sizes are those of the table of effects, for `vehicle`."""
        layout, self._hover = Layout(vehicle), vehicle.hover_speed()
        dead, inflow, lift, drag, damping, along, high = (
            layout.entry(n).typical
            for n in ("thrust_curve.dead_speed", "axial_inflow.k_z", "translational_lift.k",
                      "parasitic_drag.beside_z", "rate_damping.l_p", "rotor_drag.k_x", "rotor_drag_moment.h_x")
        )  # fmt: skip
        self.typical = np.array([2.0 * dead, inflow, lift, drag])
        self.typical_moment = np.array([damping, along * high * vehicle.mass])

    def thrust(self, speed: FloatArray, velocity: FloatArray, lift: float) -> FloatArray:
        """Regressors of log thrust per squared speed over one stretch, shape (4,).

        Args:
            speed: rotor speeds [rad/s], shape (n, rotors).
            velocity: in body axes [m/s], shape (n, 3).
            lift: mean specific force along -z [m/s^2].
        """
        total, square = speed.sum(axis=1), (speed**2).sum(axis=1)
        flat, w = velocity[:, 0] ** 2 + velocity[:, 1] ** 2, velocity[:, 2]
        return np.array(
            [
                -total.mean() / square.mean(),
                np.mean(w * total) / (speed.shape[1] * self._hover * lift),
                flat.mean() / lift,
                np.mean(np.sqrt(flat + w * w) * w) / lift,
            ]
        )


def step_beside(
    y: FloatArray, x: FloatArray, typical: FloatArray, split: int, least: float, astray: FloatArray | None = None
) -> tuple[float, float]:  # fmt: skip
    """Step of `y` at `split` beside what regressors explain: its size in standard errors, and the step.

    The coefficients are zero to within their typical sizes, or what the values before the step say; their uncertainty
    counts as that of the step.  Every value after it must lie on the same side.

    Args:
        y: series, shape (n,).
        x: its regressors, shape (n, k).
        typical: standard deviations of their coefficients before any data, shape (k,).
        split: index of the first value after the step.
        least: smallest step; a smaller one counts as none.  No value is trusted to better than a fifth of it, because
            what no regressor describes does not average out.
        astray: ways in which the regressors may all be off together, each by one standard deviation, shape (n, m, k).
    """
    slope, centre, covariance, spread = _reweighted(y[:split], x[:split], typical, least / 5.0)
    left, far = y - x @ slope, x[split:].mean(axis=0) - centre
    left -= median(left[:split])
    size, count = median(left[split:]), len(y) - split
    if abs(size) < least or not np.all(np.sign(size) * left[split:] > 2.0 * spread):
        return 0.0, size
    # What no regressor describes lasts: means over as long a time scatter by more than single values would have it.
    means = np.convolve(left[:split], np.full(count, 1.0 / count), "valid")
    scatter = max(1.4826 * median(np.abs(means)), spread / math.sqrt(count))
    variance = 1.25**2 * (scatter**2 + spread**2 / split) + far @ covariance @ far
    if astray is not None:
        variance += float(np.sum((astray[split:].mean(axis=0) @ slope) ** 2))
    return abs(size) / math.sqrt(variance), size


def _reweighted(
    y: FloatArray, x: FloatArray, typical: FloatArray, least: float
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Regression with an intercept in which outliers count for next to nothing (Cauchy), however they lie.

    It begins with all values counting alike, and goes on until it has settled.  Begun at zero slope, where most values
    are of one state, as in a long climb, all others would be outliers, and what is left of that looks like a step.

    Returns:
        Coefficients, shape (k,), weighted mean of the regressors, shape (k,), covariance (k, k), and scatter of the
        residuals, no less than `least`.
    """
    slope, weight = np.zeros(x.shape[1]), np.ones(len(y))
    for done in range(MOST_ROUNDS):
        left = y - x @ slope
        left -= median(left)
        spread = max(1.4826 * median(np.abs(left)), least)
        centre = weight @ x / weight.sum()
        weighted = (x - centre).T * (weight / spread**2)
        covariance = np.linalg.inv(weighted @ (x - centre) + np.diag(typical**-2.0))
        before, slope = slope, covariance @ (weighted @ y)
        if done and np.all(np.abs(slope - before) <= SETTLED * np.sqrt(np.diag(covariance))):
            break
        left = y - x @ slope
        weight = 1.0 / (1.0 + ((left - median(left)) / (2.0 * spread)) ** 2)
    return slope, centre, covariance, spread
