"""Parameters from two cuts of the same flight, the second half a segment later.

What happens across the borders of segments is lost with their initial states.  The second cut has its borders where the
first has the middle of its segments, so that each tells what the other loses.  Both see the same noise; what their
scores share where segments overlap decides how much is gained (a composite likelihood with its Godambe information;
Varin, Reid and Firth, Statistica Sinica 21 (2011) 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.identify.polish import Polished, Prior, bounded_step, prior_terms, robust_weights
from quadid.identify.shooting import Free, Linearised, Shooting

FloatArray = NDArray[np.float64]

FEWEST_SEGMENTS = 10
"""Segments below which the second cut, which has fewer still, is not worth making."""
MOST_COMPARED = 120
"""Segments of each cut, spread evenly, that tell what both share."""
LINEARISATIONS = 5
"""Spent on it, over the whole flight."""
SINGULAR = 1e-12
"""Share of information below which a direction counts as not known."""


@dataclass(frozen=True)
class BothCuts:
    """What two cuts tell together.

    Attributes:
        theta: full parameter vector.
        information: of the data on the scaled parameters, shape (P, P).
    """

    theta: FloatArray
    information: FloatArray


def with_second_cut(shooting: Shooting, found: Polished, free: Free, prior: Prior, robust: bool) -> BothCuts | None:
    """Takes one Gauss-Newton step from the optimum of one cut towards that of both.

    Args:
        shooting: the first cut.
        found: its optimum.
        free: parameters to move.
        prior: of those; counts once.
        robust: down-weight outliers of the second cut too.

    Returns:
        None where there are too few segments, where moments were set aside, or without a finite fit.
    """
    second = shooting.between()
    if second.count < FEWEST_SEGMENTS or shooting.local or not np.isfinite(found.cost):
        return None
    other = _settled(second, found.theta, free, robust)
    precision, pull, _ = prior_terms(free, prior, found.theta)
    h = 0.5 * (found.lin.gram.sum(axis=0) + other.gram.sum(axis=0))
    g = 0.5 * (found.lin.grad.sum(axis=0) + other.grad.sum(axis=0)) + pull
    if not (np.isfinite(h).all() and np.isfinite(g).all()):
        return None
    moved = free.move(found.theta, bounded_step(free, found.theta, h + np.diag(precision), g))
    return BothCuts(moved, _information(h, *_shared(shooting, found.theta, free)))


def _settled(second: Shooting, theta: FloatArray, free: Free, robust: bool) -> Linearised:
    """The second cut at `theta`, its initial states at their best."""
    lin = second.linearise(theta, free)
    second.adopt(theta, free, second.step_states(theta, free, lin, np.zeros(len(free.entries))))
    lin = second.linearise(theta, free)
    if robust:
        second.robust = list(robust_weights(second, lin))
        lin = second.linearise(theta, free)
    return lin


def _shared(shooting: Shooting, theta: FloatArray, free: Free) -> tuple[FloatArray, FloatArray]:
    """Covariance of the score of a segment, and of those of a segment of each cut, means over some; both (P, P)."""
    some = shooting.at_most(MOST_COMPARED, run=2)
    own, begins, ends = (_Products(len(free.entries)) for _ in range(3))
    later = {id(c.window): c for c in some.between().columns(theta, free)}
    for one in some.columns(theta, free):
        if id(one.window) not in later:
            continue
        first, second = one.projected, later[id(one.window)].projected
        half = first.shape[1] // 2
        own.add(first, first)
        begins.add(first[: len(second), half:], second[:, : first.shape[1] - half])
        followed = np.flatnonzero(one.rows[1:, 0] == one.rows[:-1, -1] + 1)
        ends.add(first[followed + 1, :half], second[followed, -half:])
    cross = begins.mean + ends.mean
    return own.mean, 0.5 * (cross + cross.T)


class _Products:
    """Mean products (P, P) of the columns of segments, shape (segments, rows, channels, P)."""

    def __init__(self, parameters: int) -> None:
        self._sum, self._count = np.zeros((parameters, parameters)), 0

    def add(self, a: FloatArray, b: FloatArray) -> None:
        self._sum += a.reshape(-1, len(self._sum)).T @ b.reshape(-1, len(self._sum))
        self._count += len(a)

    @property
    def mean(self) -> FloatArray:
        return self._sum / max(self._count, 1)


def _information(h: FloatArray, own: FloatArray, shared: FloatArray) -> FloatArray:
    """Information (P, P) of the mean of both scores, given that of one cut, `h`, and what scores share."""
    known = np.diag(own) > 0.0
    scale = np.sqrt(np.where(known, np.diag(own), 1.0))
    values, vectors = np.linalg.eigh(own / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, SINGULAR))
    white = vectors / root / scale[:, None]
    common, turn = np.linalg.eigh(white.T @ shared @ white)
    share = 0.5 * (1.0 + np.clip(common, 0.0, 1.0))
    size = np.sqrt(np.where(known, np.diag(h) / scale**2, 0.0))
    out = size[:, None] * scale[:, None] * ((vectors * root) @ turn)
    return np.asarray((out / share) @ out.T)
