"""Attitudes: unit quaternions, scalar first, body to world, as matrices and as tracks without jumps of sign."""

from __future__ import annotations

import numpy as np

from quadid.types import FloatArray


def continuous_sign(q: FloatArray) -> FloatArray:
    """Chooses signs so that neighbouring quaternions are less than half a turn apart; the first keeps its own.

    Args:
        q: unit quaternions, shape (n, 4).
    """
    if len(q) < 2:
        return q
    flips = np.where(np.einsum("ij,ij->i", q[1:], q[:-1]) < 0.0, -1.0, 1.0)
    return np.asarray(q * np.concatenate([[1.0], np.cumprod(flips)])[:, None])


def euler(q: FloatArray) -> FloatArray:
    """Roll, pitch, yaw [rad] (z-y-x) of unit quaternions wxyz body to world, shapes (n, 4) -> (n, 3)."""
    w, x, y, z = q.T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([roll, pitch, yaw])
