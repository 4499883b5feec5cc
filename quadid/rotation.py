"""Attitudes and turns of a body: unit quaternions, scalar first, body to world, and what a gyro adds up to."""

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


def down(q: FloatArray) -> FloatArray:
    """The world's downward direction in body axes, shape (..., 3), of unit quaternions (..., 4), body to world."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=-1)


def rotated(q: FloatArray, v: FloatArray) -> FloatArray:
    """Vectors (..., 3) turned by unit quaternions (..., 4), scalar first: body to world, or back with `conjugate`."""
    u = q[..., 1:]
    turned = np.cross(u, v)
    return np.asarray(v + 2.0 * (q[..., :1] * turned + np.cross(u, turned)))


def conjugate(q: FloatArray) -> FloatArray:
    """The turns back, of unit quaternions (..., 4)."""
    return np.asarray(q * [1.0, -1.0, -1.0, -1.0])


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Quaternions (..., 4) of the turns `b` seen from the bodies that `a` has turned."""
    scalar = a[..., 0] * b[..., 0] - np.einsum("...i,...i->...", a[..., 1:], b[..., 1:])
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar[..., None], vector], axis=-1)


def exponential(vector: FloatArray) -> FloatArray:
    """Unit quaternions of rotation vectors [rad], shape (n, 3) to (n, 4)."""
    half = 0.5 * np.linalg.norm(vector, axis=1, keepdims=True)
    return np.hstack([np.cos(half), 0.5 * vector * np.sinc(half / np.pi)])


def turn(before: FloatArray, after: FloatArray) -> FloatArray:
    """Rotation vectors [rad] in the body axes of `before`, shape (..., 3), the shorter way round to `after`.

    Both are unit quaternions, body to world, shape (..., 4).
    """
    between = product(conjugate(before), after)
    scalar = between[..., :1]
    vector = between[..., 1:] * np.where(scalar < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(scalar))
    return np.asarray(vector * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0))


def integrated(rate: FloatArray, step: float) -> FloatArray:
    """Rotation vectors [rad], shape (n, 3), that body rates [rad/s] of shape (k, n, 3), `step` [s] apart, add up to.

    Each step turns about the mean of the rates at its ends.
    """
    level = np.zeros((rate.shape[1], 4))
    level[:, 0] = 1.0
    q = level
    for mean in 0.5 * (rate[1:] + rate[:-1]):
        q = product(q, exponential(mean * step))
    return turn(level, q)
