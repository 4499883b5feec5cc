"""What about a hundred lines of learning reach: ridge regression, also on random features.

All predict the change of position, velocity, attitude and rate over half a second at once, from the measured state and
from the rotor speeds of that half second, in body axes.  That is more than a simulation gets to see: in closed loop
the later rotor speeds betray the motion that they answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.identification.predict import lengths
from quadid.types import FloatArray

BINS = 10
"""Parts of the half second over which rotor speeds are averaged."""
FEATURES = 400
WEIGHTS = (1e-4, 1e-3, 1e-2, 1e-1)
"""Ridge weights; the best on a held-out fifth of the training flights is taken."""
EVERY = 0.02
"""Time between runs [s]."""


@dataclass(frozen=True)
class Runs:
    """States and inputs (runs, inputs) and changes over half a second (runs, 4, 3): position, velocity, turn, rate."""

    x: FloatArray
    y: FloatArray


def runs_of(windows: Sequence[Window], seconds: float = 0.5) -> Runs:
    """All runs of windows that measure attitude and velocity; changes that are not measured are zero."""
    parts = [p for w in windows if (p := _runs(w, seconds)) is not None]
    return Runs(np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]))


def _runs(w: Window, seconds: float) -> tuple[FloatArray, FloatArray] | None:
    steps, every = round(seconds / w.dt), max(round(EVERY / w.dt), 1)
    if w.attitude is None or w.velocity is None or w.gyro is None or len(w) <= steps + 1:
        return None
    known = np.isfinite(w.attitude).all(axis=1) & np.isfinite(w.velocity).all(axis=1) & np.isfinite(w.gyro).all(axis=1)
    start = np.arange(0, len(w) - steps, every)
    start = start[known[start] & known[start + steps]]
    end = start + steps
    turn = _matrix(w.attitude)
    into = turn[start].transpose(0, 2, 1)
    edges = np.linspace(0, steps, BINS + 1).astype(int)
    sums = np.cumsum(np.vstack([np.zeros(w.rotor_speed.shape[1]), w.rotor_speed]), axis=0)
    inputs = [(sums[start + b] - sums[start + a]) / (b - a) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    state = [np.einsum("nij,nj->ni", into, w.velocity[start]), w.gyro[start], turn[start, 2]]
    place = np.zeros_like(w.velocity) if w.position is None else np.nan_to_num(w.position)
    changes = [
        np.einsum("nij,nj->ni", into, place[end] - place[start]),
        np.einsum("nij,nj->ni", into, w.velocity[end] - w.velocity[start]),
        _rotation_vector(np.einsum("nij,njk->nik", into, turn[end])),
        w.gyro[end] - w.gyro[start],
    ]
    return np.concatenate([*state, *inputs], axis=1), np.stack(changes, axis=1)


def velocity_against_position(windows: Sequence[Window], seconds: float = 0.5) -> tuple[float, float]:
    """How much larger the logged velocity is than the change of position, and what that alone costs.

    Returns:
        Scale of the velocity against the change of position, least squares; mean distance between the change of
        position over `seconds` and the integral of the logged velocity, as a share of no change.  NaN without both.
    """
    moved, flown = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for w in windows:
        steps = round(seconds / w.dt)
        if w.position is None or w.velocity is None or len(w) <= steps:
            continue
        path = np.vstack([np.zeros(3), np.cumsum(0.5 * (w.velocity[1:] + w.velocity[:-1]) * w.dt, axis=0)])
        both = np.hstack([w.position[steps:] - w.position[:-steps], path[steps:] - path[:-steps]])
        both = both[np.isfinite(both).all(axis=1)]
        moved, flown = [*moved, both[:, :3]], [*flown, both[:, 3:]]
    p, v = np.concatenate(moved), np.concatenate(flown)
    if not len(p):
        return float("nan"), float("nan")
    miss = np.linalg.norm(p - v, axis=1).mean() / np.linalg.norm(p, axis=1).mean()
    return float(np.sum(v * p) / np.sum(p * p)), float(miss)


Predictor = Callable[[FloatArray], FloatArray]


def ridge(train: Runs, features: int = 0, seed: int = 1) -> Predictor:
    """Ridge regression, with random cosine features beside the inputs where asked for (Rahimi and Recht, 2007)."""
    mean, spread = train.x.mean(axis=0), train.x.std(axis=0) + 1e-9
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(train.x.shape[1], features)) * 0.7 / np.sqrt(train.x.shape[1])
    phases = rng.uniform(0.0, 2.0 * np.pi, features)

    def mapped(x: FloatArray) -> FloatArray:
        z = (x - mean) / spread
        bends = np.cos(z @ weights + phases) * 5.0 * np.sqrt(2.0 / max(features, 1))
        return np.concatenate([np.ones((len(z), 1)), z, bends], axis=1)

    a, y = mapped(train.x), train.y.reshape(len(train.y), -1)
    cut = 4 * len(a) // 5

    def solved(rows: int, weight: float) -> FloatArray:
        part = a[:rows]
        return np.asarray(np.linalg.solve(part.T @ part + weight * rows * np.eye(a.shape[1]), part.T @ y[:rows]))

    scale = y.std(axis=0) + 1e-12
    best = min(WEIGHTS, key=lambda weight: float(np.mean(((a[cut:] @ solved(cut, weight) - y[cut:]) / scale) ** 2)))
    coefficients = solved(len(a), best)
    return lambda x: (mapped(x) @ coefficients).reshape(-1, 4, 3)


def shares(predict: Predictor, unseen: Runs) -> FloatArray:
    """Mean error of each quantity as a share of predicting no change, shape (4,)."""
    guess = predict(unseen.x)
    return np.asarray(_errors(unseen.y, guess).mean(axis=0) / _errors(unseen.y, np.zeros_like(guess)).mean(axis=0))


def _errors(truth: FloatArray, guess: FloatArray) -> FloatArray:
    """Errors (runs, 4): Euclidean, of turns the angle between them."""
    miss = truth - guess
    between = np.einsum("nji,njk->nik", _turn(guess[:, 2]), _turn(truth[:, 2]))
    angle = np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))
    miss[:, 2] = 0.0
    miss[:, 2, 0] = 2.0 * np.sin(0.5 * angle)  # `lengths` takes an axis times twice the sine of half the angle
    return lengths(miss)


def _matrix(q: FloatArray) -> FloatArray:
    """Rotation matrices of quaternions wxyz, shape (n, 3, 3)."""
    w, x, y, z = q.T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
            1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
            1 - 2 * (x * x + y * y)]  # fmt: skip
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def _rotation_vector(turn: FloatArray) -> FloatArray:
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))
    axis = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
    length = np.linalg.norm(axis, axis=1)
    return np.asarray(axis * (angle / np.maximum(length, 1e-12))[:, None])


def _turn(vector: FloatArray) -> FloatArray:
    """Rotation matrices of rotation vectors (Rodrigues), shape (n, 3, 3)."""
    angle = np.linalg.norm(vector, axis=1)
    k = vector / np.maximum(angle, 1e-12)[:, None]
    cross = np.zeros((len(k), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -k[:, 2], k[:, 1], -k[:, 0]
    cross -= cross.transpose(0, 2, 1)
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + (1.0 - cosine) * cross @ cross)
