"""Attitudes: unit quaternions, scalar first, body to world, as matrices and as tracks without jumps of sign."""

from __future__ import annotations

import numba as nb
import numpy as np

from quadid.types import FloatArray


@nb.njit(cache=True, inline="always")
def write_rotation(w: float, x: float, y: float, z: float, out: FloatArray) -> None:
    """Writes the rotation matrix of a unit quaternion into `out`, shape (3, 3)."""
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


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
