"""Moments at random: what no model of the vehicle makes, such as turbulence and the wake of rotors.

They turn the vehicle, the controller answers, and a fit that takes the rotors for all there is finds inertias too large
(an error of closed loop: U. Forssell and L. Ljung, Automatica 35 (1999) 1215).  With the covariance of what they do to
the rate the fit is consistent: slow motion, which they rule, hardly counts, and fast motion does.  Their angular
acceleration is taken for a random walk, and for unknown where a segment begins: the controller answers it already.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from quadid.types import FloatArray

ANY = 100.0
"""Angular acceleration [rad/s^2] beyond all at the beginning of a segment."""
AXES = (0, 1, 2)
"""Residual channels that it acts on: the rates."""
_USUAL = 0.98
"""Share of the segments, those with the least power, that count: the rest holds outliers."""
LEAST_WHITE = 1e-4
"""Smallest white noise [rad/s]: sixteen bits for 2000 degrees a second resolve ten times that."""
_WHITE, _MOMENT = 61, np.concatenate([[0.0], np.geomspace(1e-4, 3.0, 81)])
"""White parts tried, and random accelerations as shares of what would make all of the power."""


@lru_cache(maxsize=32)
def rate_covariance(length: int, dt: float) -> FloatArray:
    """Of rates [rad^2/s^2] that an angular acceleration makes which walks by 1 rad/s^2 in a second, (length, length).

    From the first row on; rows `dt` apart [s].
    """
    integral = dt * np.tril(np.ones((length, length)), -1)
    walk = integral @ np.tril(np.ones((length, length))) * np.sqrt(dt)
    return np.asarray(walk @ walk.T)


@lru_cache(maxsize=32)
def begun_covariance(length: int, dt: float) -> FloatArray:
    """Of rates that an acceleration makes which is unknown at the first row, shape (length, length)."""
    time = dt * np.arange(length)
    return np.asarray(ANY**2 * np.outer(time, time))


def likeliest(residuals: FloatArray, dt: float) -> tuple[float, float]:
    """Standard deviation of white noise [rad/s] and walk of the acceleration [rad/s^2/sqrt(s)] that are likeliest.

    Args:
        residuals: of one rate in complete segments, shape (segments, length).
        dt: grid step [s].
    """
    modes, levels = _modes(residuals.shape[1], round(float(dt), 9))
    power = (residuals @ modes) ** 2
    total = power.sum(axis=1)
    power = np.mean(power[total <= np.quantile(total, _USUAL)], axis=0)
    usual = float(np.mean(power))
    if not LEAST_WHITE**2 < usual < np.inf:
        return LEAST_WHITE, 0.0
    white = np.geomspace(max(0.05 * float(np.min(power)), LEAST_WHITE**2), usual, _WHITE)
    moment = usual / float(np.mean(levels)) * _MOMENT
    level = white[:, None, None] + moment[None, :, None] * levels
    cost = np.sum(np.log(level) + power / level, axis=2)
    i, j = np.unravel_index(int(np.argmin(cost)), cost.shape)
    return float(np.sqrt(white[i])), float(np.sqrt(moment[j]))


@lru_cache(maxsize=32)
def _modes(length: int, dt: float) -> tuple[FloatArray, FloatArray]:
    """Independent modes, as columns, of the random rate beside a fitted straight line, and their variances."""
    modes, levels = modes_beside_trend(rate_covariance(length, dt), 2)
    return modes, np.maximum(levels, 0.0)


def modes_beside_trend(covariance: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """Independent modes of noise less its fitted trend, as columns (length, modes), and their variances.

    Args:
        covariance: of the noise, shape (length, length).
        order: coefficients of the trend, a polynomial in time.
    """
    length = len(covariance)
    trend = np.vander(np.linspace(-1.0, 1.0, length), order)
    rest = np.linalg.qr(np.column_stack([trend, np.eye(length)]))[0][:, order:]
    levels, turn = np.linalg.eigh(rest.T @ covariance @ rest)
    return rest @ turn, levels
