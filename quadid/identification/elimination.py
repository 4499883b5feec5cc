"""Initial states of segments, and their elimination; of other parameters fitted along by the Schur complement.

Residuals of rolled-out lanes become one small quadratic form a segment, its initial state eliminated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadid.data.window import Window
from quadid.model.rollout import Rollout, Segments
from quadid.rotation import rotated
from quadid.types import BoolArray, FloatArray, IndexArray, IntArray
from quadid.vehicle import GRAVITY

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
        own, velocity = prior.ridge.copy(), _VELOCITY_ERROR
        if prior.velocity > 0.0:
            own[velocity] += prior.velocity
            self.offset[:, velocity] = prior.velocity * prior.away / own[velocity]
            self.occam[:] = np.sum(np.log(own[velocity])) - 3.0 * np.log(prior.velocity)
        self.cost[:] = np.inf


_VELOCITY_ERROR = slice(ANGLES_AND_RATES, ANGLES_AND_RATES + 3)


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
        diagonal[:, _VELOCITY_ERROR] += prior.velocity
        others[:, -1, _VELOCITY_ERROR] += prior.velocity * prior.away
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


# --- Initial states of segments: first guesses from measurements and dead reckoning, and steps along them


LEAK_SECONDS = 8.0
"""Time in which dead-reckoned velocity is forgotten."""
SPIKE = 20.0
"""Usual steps from one sample to the next by which a rate must be off its neighbours to be taken for a spike."""
_BLOCK = 256
_ADJACENT = 1
"""Rows before a segment at which simulation starts when no filter has to settle."""
_VELOCITY = slice(7, 10)


class Starts(NamedTuple):
    """Starts of the simulations of all segments.

    Attributes:
        x0: states, one array (segments, 13) a window.
        reckoned: velocity there as measured or by dead reckoning [m/s], one array (segments, 3) a window.
    """

    x0: tuple[FloatArray, ...]
    reckoned: tuple[FloatArray, ...]


@dataclass(frozen=True)
class InitialStates:
    """Initial states of the segments of a problem, found by a fit; what is missing is taken from measurements.

    Attributes:
        starts: by the rows between the start of the simulation and the segment (filters and delays need some).
    """

    starts: Mapping[int, Starts] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Checks whether any are known."""
        return bool(self.starts)

    def at(self, n_pre: int, rollouts: Sequence[Rollout], segments: Sequence[Segments]) -> Starts:
        """Starts `n_pre` rows before the segments; measured ones, with velocities found so far, if not known."""
        if n_pre in self.starts:
            return self.starts[n_pre]
        measured = [first_states(r, s, n_pre) for r, s in zip(rollouts, segments, strict=True)]
        reckoned = tuple(frozen(x[:, _VELOCITY].copy()) for x in measured)
        if _ADJACENT in self.starts:
            near = self.starts[_ADJACENT]
            for x, found, began in zip(measured, near.x0, near.reckoned, strict=True):
                x[:, _VELOCITY] += found[:, _VELOCITY] - began
        return Starts(tuple(frozen(x) for x in measured), reckoned)

    def replaced(self, n_pre: int, starts: Starts) -> InitialStates:
        """The same with other starts `n_pre` rows before the segments."""
        return InitialStates({**self.starts, n_pre: starts})

    def stepped(self, n_pre: int, da: FloatArray) -> InitialStates:
        """The same after the steps `da` along the tangents, shape (segments of all windows, k)."""
        old = self.starts[n_pre]
        moved = (retract(x, d) for x, d in zip(old.x0, _split(da, old.x0), strict=True))
        return self.replaced(n_pre, old._replace(x0=tuple(frozen(x) for x in moved)))

    def chosen(self, n_pre: int, better: BoolArray, other: InitialStates) -> InitialStates:
        """These states for segments where `better`, those of `other` elsewhere."""
        mine, its = self.starts[n_pre], other.starts[n_pre]
        parts = _split(better, mine.x0)
        x0 = tuple(
            frozen(np.where(take[:, None], new, old)) for take, new, old in zip(parts, mine.x0, its.x0, strict=True)
        )
        return self.replaced(n_pre, mine._replace(x0=x0))

    def taking(self, places: Sequence[IndexArray]) -> InitialStates:
        """States of some segments of each window, as `Shooting.taking`; windows of which none is kept are left out."""

        def some(arrays: tuple[FloatArray, ...]) -> tuple[FloatArray, ...]:
            return tuple(frozen(a[kept]) for a, kept in zip(arrays, places, strict=True) if len(kept))

        return InitialStates({n: Starts(some(s.x0), some(s.reckoned)) for n, s in self.starts.items()})


def frozen(array: FloatArray) -> FloatArray:
    """The same array, read-only from now on."""
    array.setflags(write=False)
    return array


def _split(rows: NDArray[Any], like: Sequence[FloatArray]) -> list[NDArray[Any]]:
    """Rows of all windows, one after the other, as one array a window."""
    return np.split(rows, np.cumsum([len(x) for x in like])[:-1])


def first_states(rollout: Rollout, segments: Segments, n_pre: int) -> FloatArray:
    """Measured initial states, rates without spikes; where velocity is not measured, that of dead reckoning."""
    x0 = rollout.initial_states(segments, n_pre)
    if rollout.window.gyro is not None:
        _without_spikes(x0, rollout.window.gyro, segments.starts - n_pre)
    if rollout.window.velocity is None:
        x0[:, 7:10] = dead_reckoning(rollout.window)[segments.starts - n_pre]
    return x0


def _without_spikes(x0: FloatArray, gyro: FloatArray, rows: IntArray) -> None:
    """Puts the median of five samples in place of an initial rate that is far from it, in place.

    Everything a segment simulates follows from its initial state; one spoilt sample there is worth a second of flight.
    """
    values = gyro[np.clip(rows[:, None] + np.arange(-2, 3), 0, len(gyro) - 1)]
    steps = np.abs(np.diff(gyro, axis=0))
    steps = steps[np.isfinite(steps).all(axis=1)]
    if not len(steps):
        return
    middle = np.median(values, axis=1)  # missing where any of the five is, and then nothing is replaced
    far = np.abs(x0[:, 4:7] - middle) > SPIKE * np.median(steps, axis=0)
    x0[:, 4:7] = np.where(far, middle, x0[:, 4:7])


def dead_reckoning(window: Window) -> FloatArray:
    """Rough velocity (n, 3) [m/s], NED: integrated specific force, leaking to zero; zeros without attitude or accel.

    The leak bounds what accelerometer and tilt errors add up to.  A starting point for fits in which velocity matters.
    """
    n = len(window)
    if window.accel is None or window.attitude is None:
        return np.zeros((n, 3))
    q, f = window.attitude, window.accel
    good = np.isfinite(q).all(axis=1) & np.isfinite(f).all(axis=1)
    acceleration = rotated(q, f) + np.array([0.0, 0.0, GRAVITY])
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
