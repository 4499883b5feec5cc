"""Frames and units at the door of the core: ROS (ENU, FLU) and degrees become NED, FRD and SI.

All functions take arrays with one sample a row and return new arrays.  Rows that are not finite (damage) come out as
not finite and are dropped further on.
"""

from __future__ import annotations

import numpy as np

from quadid.rotation import euler
from quadid.types import BoolArray, FloatArray

GRAVITY = 9.80665
"""Standard gravity [m/s^2], the unit of accelerometers that count in g."""
_HALF = np.sqrt(0.5)
_BODY, _WORLD = np.array([1.0, -1.0, -1.0]), np.array([1.0, 1.0, -1.0])


def _columns(*columns: FloatArray) -> FloatArray:
    """As `np.column_stack`, which takes longer than the sums of a few rows."""
    out = np.empty((len(columns[0]), len(columns)))
    for k, column in enumerate(columns):
        out[:, k] = column
    return out


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of rows, shape (n, 3): `np.cross` to the bit, which takes ten times as long for a few rows."""
    (a1, a2, a3), (b1, b2, b3) = a.T, b.T
    return _columns(a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1)


def flip_body(vectors: FloatArray) -> FloatArray:
    """Turns body vectors between FLU and FRD (its own inverse), shape (n, 3)."""
    return np.asarray(vectors * _BODY)


def flip_world(vectors: FloatArray) -> FloatArray:
    """Turns world vectors between ENU and NED (its own inverse), shape (n, 3)."""
    return np.asarray(vectors[:, [1, 0, 2]] * _WORLD)


def flip_attitude(q: FloatArray) -> FloatArray:
    """Turns attitudes between FLU->ENU and FRD->NED, quaternions wxyz, shape (n, 4).

    q' = -q_world q q_body with q_world = (0, 1, 1, 0)/sqrt(2) and q_body = (0, 1, 0, 0), in closed form; its own
    inverse, sign included.
    """
    w, x, y, z = q.T
    return np.asarray(_HALF * _columns(w + z, x + y, x - y, w - z))


def from_euler(angles: FloatArray) -> FloatArray:
    """Turns roll, pitch, yaw [rad] (z-y-x), shape (n, 3), into quaternions wxyz body to world, shape (n, 4)."""
    half = 0.5 * angles
    with np.errstate(invalid="ignore"):
        (cr, cp, cy), (sr, sp, sy) = np.cos(half).T, np.sin(half).T
    return _columns(
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler(q: FloatArray) -> FloatArray:
    """Turns quaternions wxyz, shape (n, 4), into roll, pitch, yaw [rad], shape (n, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return euler(q)


def unit_quaternions(q: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Returns the quaternions with those off unit length by more than 1e-3 normalised, and which rows are attitudes.

    Rows of length below 0.5 or above 2 (zeros, garbage) are no attitudes.
    """
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(q, axis=1)
    good = (norm > 0.5) & (norm < 2.0)
    off = good & (np.abs(norm - 1.0) > 1e-3)
    if off.any():
        q = q.copy()
        q[off] /= norm[off, None]
    return q, good
