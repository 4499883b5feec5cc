"""The least error that a prediction from a measured state can have: what sensor noise alone makes of a perfect model.

A run starts from a measured attitude, rate, velocity and position, each with its noise, and is compared with measured
ones.  Over a time T an error of the rate grows into one of the attitude (T), a tilt error accelerates the vehicle
sideways (g T), and so on; damping is left out, so that at long horizons the floor is rather too high than too low.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from quadid.data.window import Window
from quadid.identification.open_loop import QUANTITIES
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY

ORDER = 4
"""Differences of this order leave white noise and take smooth motion away."""
MEAN_LENGTH = math.sqrt(8.0 / math.pi)
"""Mean length of a vector of three Gaussian components over their standard deviation."""


def prediction_floor(windows: Sequence[Window], samples: int) -> dict[str, float]:
    """Mean error `samples` after the start that sensor noise alone makes, by quantity; NaN for what the logs lack.

    Args:
        windows: of one or more files, on one grid.
        samples: after the start.
    """
    sigma = {name: white_noise([_vectors(w, name) for w in windows]) for name in QUANTITIES}
    t = samples * windows[0].dt
    position, velocity, rotation, rate = (sigma[name] for name in QUANTITIES)
    sideways = 2.0 / 3.0  # of three components two feel a tilt
    from_tilt, from_rate = GRAVITY * t * rotation, GRAVITY * t**2 * rate / 2.0
    grown = {
        "rate": 2.0 * rate**2,
        "rotation": 2.0 * rotation**2 + (rate * t) ** 2,
        "velocity": 2.0 * velocity**2 + sideways * (from_tilt**2 + from_rate**2),
        "position": 2.0 * position**2
        + (velocity * t) ** 2
        + sideways * ((from_tilt * t / 2.0) ** 2 + (from_rate * t / 3.0) ** 2),
    }
    return {name: MEAN_LENGTH * math.sqrt(grown[name]) for name in QUANTITIES}


def white_noise(series: Sequence[FloatArray]) -> float:
    """Standard deviation of the white noise of a component, from differences of order `ORDER`; NaN without data.

    Args:
        series: samples (n, 3) of each window; robust against the few rows in which the motion itself is not smooth.
    """
    parts = [np.abs(np.diff(values, ORDER, axis=0)).ravel() for values in series if len(values) > ORDER]
    differences = np.concatenate([np.zeros(0), *parts])
    if len(differences) == 0:
        return math.nan
    return float(1.4826 * np.median(differences) / math.sqrt(math.comb(2 * ORDER, ORDER)))


def _vectors(window: Window, quantity: str) -> FloatArray:
    """Measured rows of a quantity, (n, 3); an attitude as the turns from its first row on, summed up."""
    values = {
        "position": window.position, "velocity": window.velocity, "rotation": window.attitude, "rate": window.gyro,
    }[quantity]  # fmt: skip
    if values is None:
        return np.zeros((0, 3))
    known = values[np.isfinite(values).all(axis=1)]
    if quantity != "rotation":
        return known
    w, v = known[:, :1], known[:, 1:]
    turned = w[:-1] * v[1:] - w[1:] * v[:-1] - np.cross(v[:-1], v[1:])
    return np.cumsum(2.0 * turned, axis=0)
