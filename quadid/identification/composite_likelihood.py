"""Parameters from two cuts of the same flight, the second half a segment later.

What happens across the borders of segments is lost with their initial states.  The second cut has its borders where the
first has the middle of its segments, so that each holds what the other loses.  Both see the same noise; what their
scores share where segments overlap decides how much is gained (a composite likelihood with its Godambe information;
Varin, Reid and Firth, Statistica Sinica 21 (2011) 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.identification.gauss_newton import Polished, polish
from quadid.identification.parameterization import Free
from quadid.identification.priors import Prior
from quadid.identification.shooting import Shooting
from quadid.types import FloatArray, IndexArray

FEWEST_SEGMENTS = 10
"""Segments of the second cut below which it is not made."""
LEAST_OF_FIRST = 0.9
"""Share of the segments of the first cut that the second must have: many short windows lose more than is gained."""
ITERATIONS = 8
"""Linearisations the second cut may take; it begins at the optimum of the first."""
WORSE = 1.2
"""Cost per row of the second cut over that of the first beyond which it went astray: both see the same data."""
MOST_COMPARED = 120
"""Segments of the second cut, the most informative, from which follows what both share."""
SINGULAR = 1e-12
"""Share of information below which a direction counts as not known."""


@dataclass(frozen=True)
class BothCuts:
    """Estimate from two cuts together.

    Attributes:
        theta: full parameter vector.
        information: of the data on the scaled parameters, shape (P, P).
        simulated: parameter vectors simulated for the second cut.
    """

    theta: FloatArray
    information: FloatArray
    simulated: int


def with_second_cut(shooting: Shooting, found: Polished, free: Free, prior: Prior, robust: bool) -> BothCuts | None:
    """Fits the second cut from the optimum of the first, and goes where both together fit best.

    Args:
        shooting: the first cut.
        found: its optimum.
        free: parameters to move.
        prior: of those; counts once.
        robust: down-weight outliers of the second cut too.

    Returns:
        None where there are too few segments, where random moments rule, or one of the cuts has no good fit.
    """
    second = shooting.between()
    enough = max(FEWEST_SEGMENTS, LEAST_OF_FIRST * shooting.count)
    if second.count < enough or shooting.noise.moments is not None or not np.isfinite(found.cost):
        return None
    other = polish(second, found.theta, free, prior, iterations=ITERATIONS, robust=robust)
    if not other.cost * found.lin.total_rows < WORSE * found.cost * other.lin.total_rows:
        return None
    precision = np.diag(prior.precision)
    h_one, h_other = found.lin.information, other.lin.information
    away = free.step(found.theta, other.theta)
    step = np.linalg.solve(h_one + h_other + 2.0 * precision, (h_other + precision) @ away)
    h = 0.5 * (h_one + h_other)
    information = _information(h, *_shared(shooting, second, found, other, free))
    return BothCuts(free.move(found.theta, np.asarray(step)), information, other.simulated)


def _shared(
    first: Shooting, second: Shooting, found: Polished, other: Polished, free: Free
) -> tuple[FloatArray, FloatArray]:
    """Covariance of the score of the second cut, and of that with the score of the first, both (P, P).

    From the most informative segments; exact for white noise, and nearly for the slow noise of an attitude, whose
    whitening begins anew with each segment.
    """
    p = len(free.entries)
    own, cross = np.zeros((p, p)), np.zeros((p, p))
    cuts = zip((first, second), (found.states, other.states), _compared(first, second, other), strict=True)
    columns = (cut.taking(some).columns(other.theta, free, states.taking(some)) for cut, states, some in cuts)
    for before, after in zip(*columns, strict=True):
        a, b = before.projected, after.projected
        place = {int(start): i for i, start in enumerate(before.rows[:, 0])}
        half, length = a.shape[1] // 2, a.shape[1]
        own += _products(b, b)
        begin = [place[int(start) - half] for start in after.rows[:, 0]]
        cross += _products(b[:, : length - half], a[begin, half:])
        goes_on = [j for j, start in enumerate(after.rows[:, 0]) if int(start) + length - half in place]
        end = [place[int(after.rows[j, 0]) + length - half] for j in goes_on]
        cross += _products(b[goes_on, length - half :], a[end, :half])
    return own, 0.5 * (cross + cross.T)


def _compared(first: Shooting, second: Shooting, other: Polished) -> tuple[list[IndexArray], list[IndexArray]]:
    """Places, window by window, of segments of the first cut that overlap the most informative of the second; these."""
    known = np.diagonal(other.lin.gram, axis1=1, axis2=2)
    total = known.sum(axis=0)
    weight = np.sum(known / np.where(total > 0.0, total, 1.0), axis=1)
    chosen = np.zeros(len(weight), dtype=bool)
    chosen[np.argsort(-weight, kind="stable")[:MOST_COMPARED]] = True
    later = [np.flatnonzero(chosen[other.lin.window == w]) for w in range(len(second.rollouts))]
    one, left = [], list(zip(second.rollouts, later, strict=True))
    for rollout, segments in zip(first.rollouts, first.segments, strict=True):
        places = left.pop(0)[1] if left and left[0][0] is rollout else np.zeros(0, dtype=np.intp)
        both = np.union1d(places, places + 1)
        one.append(both[both < len(segments.starts)])
    return one, later


def _products(a: FloatArray, b: FloatArray) -> FloatArray:
    """Sum of the products (P, P) of columns (segments, rows, channels, P)."""
    return np.asarray(a.reshape(-1, a.shape[-1]).T @ b.reshape(-1, b.shape[-1]))


def _information(h: FloatArray, own: FloatArray, shared: FloatArray) -> FloatArray:
    """Information (P, P) of the mean of both scores, given that of one cut, `h`: between once and twice as much.

    Args:
        h: information of one cut.
        own: the part of it that was compared.
        shared: what the other cut's score shares with that part.
    """
    size = _sizes(own)
    white = _root(own / np.outer(size, size), -0.5)
    common, turn = np.linalg.eigh(white @ (shared / np.outer(size, size)) @ white)
    gain = 2.0 / (1.0 + np.clip(common, 0.0, 1.0))
    size = _sizes(h)
    root = size[:, None] * (_root(h / np.outer(size, size), 0.5) @ turn)
    return np.asarray((root * gain) @ root.T)


def _sizes(matrix: FloatArray) -> FloatArray:
    return np.sqrt(np.where(np.diag(matrix) > 0.0, np.diag(matrix), 1.0))


def _root(matrix: FloatArray, power: float) -> FloatArray:
    """Symmetric power of a positive semi-definite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, SINGULAR) ** power) @ vectors.T)
