"""Initial states of segments: first guesses from measurements and dead reckoning, and steps along them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quadid.model.rollout import Rollout, Segments
from quadid.vehicle import GRAVITY
from quadid.window import Window

FloatArray = NDArray[np.float64]

LEAK_SECONDS = 8.0
"""Time in which dead-reckoned velocity is forgotten."""
_BLOCK = 256


def first_states(rollout: Rollout, segments: Segments, n_pre: int) -> FloatArray:
    """Measured initial states; where velocity is not measured, that of dead reckoning."""
    x0 = rollout.initial_states(segments, n_pre)
    if rollout.window.velocity is None:
        x0[:, 7:10] = dead_reckoning(rollout.window)[segments.starts - n_pre]
    return x0


def dead_reckoning(window: Window) -> FloatArray:
    """Rough velocity (n, 3) [m/s], NED: integrated specific force, leaking to zero; zeros without attitude or accel.

    The leak bounds what accelerometer and tilt errors add up to.  A starting point for fits in which velocity matters.
    """
    n = len(window)
    if window.accel is None or window.attitude is None:
        return np.zeros((n, 3))
    q, f = window.attitude, window.accel
    good = np.isfinite(q).all(axis=1) & np.isfinite(f).all(axis=1)
    w, v = q[:, :1], q[:, 1:]
    cross = np.cross(v, f)
    acceleration = f + 2.0 * (w * cross + np.cross(v, cross)) + np.array([0.0, 0.0, GRAVITY])
    acceleration[~good] = 0.0
    keep = float(np.exp(-window.dt / LEAK_SECONDS))
    out = window.dt * acceleration
    # v_k = keep v_k-1 + step_k, a block of rows at a time: there keep^-k is a number of moderate size.
    fading = keep ** np.arange(_BLOCK)[:, None]
    for first in range(0, n, _BLOCK):
        part = out[first : first + _BLOCK]
        if first:
            part[0] += keep * out[first - 1]
        part[:] = np.cumsum(part / fading[: len(part)], axis=0) * fading[: len(part)]
    return np.asarray(out)


def retract(x0: FloatArray, da: FloatArray) -> FloatArray:
    """Steps initial states (segments, 13) along tangents (segments, k): rotation vector, rate, velocity, position."""
    out = x0.copy()
    half = 0.5 * da[:, :3]
    dq = np.column_stack([np.ones(len(half)), half])
    dq /= np.linalg.norm(dq, axis=1, keepdims=True)
    w, v = x0[:, 0], x0[:, 1:4]
    dw, dv = dq[:, 0], dq[:, 1:]
    out[:, 0] = w * dw - np.sum(v * dv, axis=1)
    out[:, 1:4] = w[:, None] * dv + dw[:, None] * v + np.cross(v, dv)
    k = da.shape[1]
    out[:, 4 : 4 + k - 3] += da[:, 3:]
    return out
