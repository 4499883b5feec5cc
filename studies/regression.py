"""The plain regression that a proper estimator has to beat: least squares of rate increments, axis by axis.

Over each stretch of 0.1 s the increment of a body rate is regressed on the mean torque about that axis, a constant
(which takes an offset of the centre of gravity), the mean velocity times rotor speed (which takes moments of rotor
drag) and the change of the rotors' summed speed (which takes their inertia).  No lag, no noise model, no initial
states: what one writes in ten lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.vehicle import Vehicle
from quadid.window import Window

FloatArray = NDArray[np.float64]
STRETCH = 0.1
"""Length of an increment [s]."""


@dataclass(frozen=True)
class Regression:
    """Coefficients of rate growth (3 axes, 5 regressors) [1/s], and the R^2 of each axis on the data fitted."""

    coefficients: FloatArray
    r2: FloatArray


def increments(window: Window, vehicle: Vehicle, seconds: float = STRETCH) -> tuple[FloatArray, FloatArray]:
    """Regressors summed over every stretch, (stretches, 3, 5), and increments of the rate, (stretches, 3) [rad/s]."""
    assert window.gyro is not None
    assert window.velocity is not None
    assert window.attitude is not None
    n = round(seconds / window.dt)
    w2, position = window.rotor_speed**2, vehicle.rotor_positions
    torque = np.column_stack([-w2 @ position[:, 1], w2 @ position[:, 0], w2 @ vehicle.spins])
    body = into_body(window.attitude, window.velocity) * window.rotor_speed.sum(axis=1)[:, None]
    rows = np.concatenate([torque, np.ones((len(torque), 1)), body[:, :2]], axis=1)
    sums = np.cumsum(np.vstack([np.zeros(6), rows]), axis=0)
    mean = (sums[n:-1] - sums[: -n - 1]) / n
    spin = window.rotor_speed @ vehicle.spins
    change = (spin[n:] - spin[:-n]) / seconds
    x = np.stack([np.column_stack([mean[:, [axis, 3, 4, 5]], change]) for axis in range(3)], axis=1)
    dy = window.gyro[n:] - window.gyro[:-n]
    good = np.isfinite(x).all(axis=(1, 2)) & np.isfinite(dy).all(axis=1)
    return x[good] * seconds, dy[good]


def into_body(q: FloatArray, v: FloatArray) -> FloatArray:
    """Turns world vectors into the body by quaternions wxyz body to world, shapes (n, 4), (n, 3) -> (n, 3)."""
    w, u = q[:, :1], -q[:, 1:]
    cross = np.cross(u, v)
    return np.asarray(v + 2.0 * (w * cross + np.cross(u, cross)))


def regress(windows: Sequence[Window], vehicle: Vehicle, seconds: float = STRETCH) -> Regression:
    """Fits the regression to all stretches of `seconds` of all windows."""
    pairs = [increments(w, vehicle, seconds) for w in windows if len(w) * w.dt > seconds]
    x, y = np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])
    out, r2 = [], []
    for axis in range(3):
        scale = np.std(x[:, axis], axis=0) + np.abs(np.mean(x[:, axis], axis=0))
        found = np.linalg.lstsq(x[:, axis] / scale, y[:, axis], rcond=None)[0] / scale
        out.append(found)
        r2.append(1.0 - np.var(y[:, axis] - x[:, axis] @ found) / np.var(y[:, axis]))
    return Regression(np.array(out), np.array(r2))


def errors(
    windows: Sequence[Window], vehicle: Vehicle, found: Regression, seconds: float = STRETCH
) -> tuple[FloatArray, FloatArray]:
    """Errors of the predicted rate after `seconds`, and those of assuming no change; both (stretches, 3) [rad/s]."""
    pairs = [increments(w, vehicle, seconds) for w in windows if len(w) * w.dt > seconds]
    x, y = np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])
    return np.einsum("nij,ij->ni", x, found.coefficients) - y, -y


def inertias(found: Regression, vehicle: Vehicle, b: float) -> FloatArray:
    """J_xx and J_yy [kg m^2] that the torque coefficients mean for thrust coefficient `b`."""
    return np.asarray(b / found.coefficients[:2, 0])
