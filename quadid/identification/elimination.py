"""Elimination of parameters that are fitted along: of initial states, and of others by the Schur complement.

Residuals of rolled-out lanes become one small quadratic form a segment, its initial state eliminated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quadid.types import FloatArray, IndexArray

# --- Quadratic form of every segment


ANGLES_AND_RATES = 6
"""Directions of an initial state before those of its velocity."""
ROUNDING = 1e-15
"""Share by which squares are raised before a factor is made of them."""
LEFT = 1e-12
"""A cost of which the elimination leaves a smaller share is made of rounding, where that is more than a unit of it."""


class StatePrior(NamedTuple):
    """Prior of the initial states.

    Attributes:
        ridge: precision of the step of each eliminated direction, shape (own,).
        velocity: precision of the initial velocity itself around a known one; 0 for none.
        away: how far the velocity is from there now, shape (segments, 3).
    """

    ridge: FloatArray
    velocity: float
    away: FloatArray

    def part(self, which: slice) -> StatePrior:
        """The prior of some segments."""
        return self._replace(away=self.away[which])


class Reduced(NamedTuple):
    """Quadratic form of every segment's cost in the parameters, see `quadid.identification.problem.Linearised`.

    Attributes:
        gram: (segments, P, P); grad: (segments, P); cost: (segments,).
        occam: log-determinant of the eliminated velocity, (segments,); 0 without its prior.
        fitted: directions of the initial state that the data determine, (segments,).
        offset: step of the eliminated directions, (segments, own); slope: its change with parameters (…, P).
        base: residual, channel units, (segments, length, C).
        largest: largest product of two columns, (segments,).
    """

    gram: FloatArray
    grad: FloatArray
    cost: FloatArray
    occam: FloatArray
    fitted: FloatArray
    offset: FloatArray
    slope: FloatArray
    base: FloatArray
    largest: FloatArray

    @classmethod
    def room(cls, count: int, own: int, parameters: int, length: int, channels: int) -> Reduced:
        """Arrays to be written."""
        ends = (), (own,), (own, parameters), (length, channels), ()
        shapes = (parameters, parameters), (parameters,), (), (), *ends
        return cls(*(np.zeros((count, *shape)) for shape in shapes))

    def part(self, which: slice) -> Reduced:
        """Views of some segments."""
        return Reduced(*(a[which] for a in self))

    def run_away(self, prior: StatePrior) -> None:
        """Makes the cost infinite, which every search steps back from, and all else what no data leave."""
        for array in (self.gram, self.grad, self.fitted, self.offset, self.slope):
            array[...] = 0.0
        own, velocity = prior.ridge.copy(), _VELOCITY
        if prior.velocity > 0.0:
            own[velocity] += prior.velocity
            self.offset[:, velocity] = prior.velocity * prior.away / own[velocity]
            self.occam[:] = np.sum(np.log(own[velocity])) - 3.0 * np.log(prior.velocity)
        self.cost[:] = np.inf


_VELOCITY = slice(ANGLES_AND_RATES, ANGLES_AND_RATES + 3)


def columns_of(out: FloatArray, lane: IndexArray, steps: FloatArray, channels: int) -> FloatArray:
    """Residual at the base and what a unit of each direction does to it, (segments, length, channels, 1 + directions).

    Args:
        out: rolled-out residuals (blocks, segments, length, at least so many channels, LANES).
        lane: where the base and each direction are, (1 + directions,).
        steps: finite-difference step of each direction, (directions,).
    """
    rows = out[..., :channels, :].transpose(1, 2, 3, 0, 4)
    rows = np.take(rows.reshape(*rows.shape[:3], -1), lane, axis=3)
    rows[..., 1:] -= rows[..., :1]
    rows[..., 1:] *= 1.0 / steps
    return rows


def reduce_segments(white: FloatArray, prior: StatePrior, into: Reduced) -> None:
    """Squares the columns of every segment and eliminates its initial state; where they ran away, only marks that.

    Args:
        white: columns of `columns_of`, weighted and whitened: the directions that are eliminated first, then the
            parameters, (segments, rows, 1 + own + P).
        prior: of the initial states.
        into: written.
    """
    own = len(prior.ridge)
    products = np.matmul(white.transpose(0, 2, 1), white)
    squares = np.diagonal(products, axis1=1, axis2=2)
    into.largest[:] = np.max(squares, axis=1)
    if not np.isfinite(products).all():
        into.largest[:] = np.inf
        return
    # Products of the eliminated directions with their prior, and theirs with parameters and residual.
    own_own = products[:, 1 : 1 + own, 1 : 1 + own].copy()
    diagonal = np.einsum("sii->si", own_own)
    diagonal += prior.ridge
    others = np.concatenate([products[:, 1 + own :, 1 : 1 + own], products[:, :1, 1 : 1 + own]], axis=1)
    cost = products[:, 0, 0].copy()
    if prior.velocity > 0.0:
        diagonal[:, _VELOCITY] += prior.velocity
        others[:, -1, _VELOCITY] += prior.velocity * prior.away
        cost += prior.velocity * np.sum(prior.away**2, axis=1)
    into.fitted[:] = np.sum(squares[:, 1 : 1 + own] / diagonal, axis=1)
    diagonal *= 1.0 + ROUNDING
    if prior.velocity > 0.0:
        turned = own_own[:, :ANGLES_AND_RATES, :ANGLES_AND_RATES]
        into.occam[:] = np.linalg.slogdet(own_own)[1] - np.linalg.slogdet(turned)[1] - 3.0 * math.log(prior.velocity)
    back = np.linalg.solve(own_own, others.transpose(0, 2, 1))
    taken = np.matmul(others, back)
    into.offset[:], into.slope[:] = back[..., -1], back[..., :-1]
    into.cost[:] = cost - taken[:, -1, -1]
    into.gram[:] = products[:, 1 + own :, 1 + own :] - taken[:, :-1, :-1]
    into.grad[:] = products[:, 0, 1 + own :] - taken[:, -1, :-1]
    into.largest[into.cost < LEFT * cost - 1.0] = np.inf


# --- Normal equations of some parameters once others are fitted along: the Schur complement
#
# Minimised over the others o, the cost ``2 g z + z h z`` is that of the parameters m alone, with ``h_mm - gain h_om``
# for h and ``g_m - gain g_o`` for g, where ``gain = h_mo h_oo^-1``.  Inverse covariances are marginalised alike.


class Schur(NamedTuple):
    """Parameters m with others o eliminated.

    Attributes:
        h: Schur complement, shape (..., m, m).
        gain: how a gradient of the others counts for them, shape (..., m, o).
    """

    h: FloatArray
    gain: FloatArray


def eliminated(h_mm: FloatArray, h_mo: FloatArray, h_oo: FloatArray) -> Schur:
    """Eliminates the parameters o.

    Args:
        h_mm: products of the parameters that stay, shape (..., m, m).
        h_mo: and with those that go, shape (..., m, o).
        h_oo: of those that go, positive definite, shape (o, o).
    """
    rows = h_mo.reshape(math.prod(h_mo.shape[:-1]), h_mo.shape[-1])
    gain = np.asarray(np.linalg.solve(h_oo, rows.T), dtype=np.float64).T.reshape(h_mo.shape)
    return Schur(h_mm - gain @ np.swapaxes(h_mo, -1, -2), gain)


def freed(h_mm: FloatArray, h_mo: FloatArray, h_oo: FloatArray, g_m: FloatArray, g_o: FloatArray) -> FloatArray:
    """By how much more the cost falls where the parameters m are free beside the others, shape (...).

    Args:
        h_mm: as in `eliminated`; positive definite together with the next two.
        h_mo: as there.
        h_oo: as there.
        g_m: gradient of the parameters m, shape (..., m).
        g_o: and of the others, shape (o,).
    """
    left = eliminated(h_mm, h_mo, h_oo)
    g = g_m - left.gain @ g_o
    return np.asarray(np.sum(g * np.linalg.solve(left.h, g[..., None])[..., 0], axis=-1))
