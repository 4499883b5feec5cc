"""Elimination of parameters that are fitted along: of initial states by a kernel, of others by the Schur complement.

The kernel makes of rolled-out lanes one small quadratic form a segment, its initial state eliminated.  One segment at a
time, so that all of it stays in the processor's cache: finite-difference columns, whitening of each channel, squares,
elimination.  Whitening and squares are products of small matrices, made of tiles whose sums stay in vector registers;
the elimination is a Cholesky factor of the initial state's own products.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from quadid.types import BoolArray, FloatArray, IndexArray, IntArray, check_shapes

# isort: off
from quadid.model.simd import (
    LANES, TILE_COLUMNS, TILE_ROWS, cache_aligned, cached, jit, lane_kernel, scaled_lanes, tile_product,
)  # fmt: skip
# isort: on

# --- Input and output of the kernel


VELOCITY = 6
"""Place of the velocity among the directions of an initial state."""
NEGLIGIBLE = 1e-5
"""Entries of a whitener below this share of its largest are left out."""


class Whitening:
    """Weights and whitening of the channels of a segment.

    Attributes:
        precision: 1 / sigma of each channel, for rows that are not whitened, shape (C,).
        coloured: True for channels to whiten, in segments that have all their samples, shape (C,).
        matrix: lower-triangular, rows padded with zeros to whole tiles, shape (C, padded length, length).
        reach: first column of each tile of rows that counts, shape (C, tiles).
    """

    def __init__(self, sigma: FloatArray, coloured: BoolArray, whitener: FloatArray) -> None:
        """Prepares standard deviations (C,) and a whitener (C, length, length)."""
        channels, length, _ = whitener.shape
        tiles = -(-length // TILE_ROWS)
        self.precision, self.coloured = 1.0 / sigma, coloured
        self.matrix = np.zeros((channels, tiles * TILE_ROWS, length))
        self.reach = np.zeros((channels, tiles), dtype=np.int64)
        for c, w in enumerate(whitener):
            matters = np.abs(w) > NEGLIGIBLE * np.max(np.abs(w))
            reach = np.argmax(matters, axis=1)
            self.matrix[c, :length] = np.where(np.arange(length) >= reach[:, None], np.tril(w), 0.0)
            self.reach[c] = [reach[i : i + TILE_ROWS].min() for i in range(0, length, TILE_ROWS)]


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
        largest: largest product of two columns, (segments,); infinite when it is none.
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

    @staticmethod
    def shapes(count: int, own: int, parameters: int, length: int, channels: int) -> tuple[tuple[int, ...], ...]:
        """Shapes of the fields, in order."""
        one, p = (count,), parameters
        ends = ((count, own), (count, own, p), (count, length, channels), one)
        return ((count, p, p), (count, p), one, one, one, *ends)

    @classmethod
    def room(cls, count: int, own: int, parameters: int, length: int, channels: int) -> Reduced:
        """Arrays to be written."""
        return cls(*(np.empty(shape) for shape in cls.shapes(count, own, parameters, length, channels)))

    def part(self, which: slice) -> Reduced:
        """Views of some segments."""
        return Reduced(*(a[which] for a in self))

    def run_away(self, prior: StatePrior) -> None:
        """Makes the cost infinite, which every search steps back from, and all else what no data leave."""
        for array in (self.gram, self.grad, self.fitted, self.offset, self.slope):
            array[...] = 0.0
        own, velocity = prior.ridge.copy(), slice(VELOCITY, VELOCITY + 3)
        if prior.velocity > 0.0:
            own[velocity] += prior.velocity
            self.offset[:, velocity] = prior.velocity * prior.away / own[velocity]
            self.occam[:] = np.sum(np.log(own[VELOCITY:])) - 3.0 * np.log(prior.velocity)
        self.cost[:] = np.inf


# --- The kernel


def reduce_segments(
    out: FloatArray, lane: IndexArray, steps: FloatArray, weights: FloatArray, whitening: Whitening,
    prior: StatePrior, into: Reduced,
) -> None:  # fmt: skip
    """Weights, whitens and squares the columns of every segment and eliminates its initial state.

    Args:
        out: rolled-out residuals (blocks, segments, length, at least C channels, LANES).
        lane: where the base, which is lane 0, and each direction are, (1 + own + P,).
        steps: finite-difference step of each direction: those eliminated first, then the parameters, (own + P,).
        weights: row weights (segments, length, C), 0 where nothing was measured.
        whitening: of the channels.
        prior: of the initial states.
        into: written.

    Raises:
        ValueError: arrays whose shapes do not belong together.
    """
    w, own = whitening, len(prior.ridge)
    count, length, channels = weights.shape
    check_shapes(
        "reduce_segments",
        ("out", out, (len(out), count, length, max(channels, out.shape[3]), LANES)),
        ("lane", lane, (1 + len(steps),)),
        ("precision", w.precision, (channels,)), ("coloured", w.coloured, (channels,)),
        ("matrix", w.matrix, (channels, -(-length // TILE_ROWS) * TILE_ROWS, length)),
        ("reach", w.reach, (channels, -(-length // TILE_ROWS))),
        ("away", prior.away, (count, 3)),
        *((name, array, (*shape,)) for name, array, shape in zip(
            into._fields, into, Reduced.shapes(count, own, len(steps) - own, length, channels), strict=True
        )),
    )  # fmt: skip
    inverse = np.zeros(len(out) * LANES)
    inverse[lane[1:]] = 1.0 / steps  # raises IndexError for a lane that is none
    # A copy, because read-only arrays are another type, for which all would be compiled again.
    own_lane = np.array(lane)
    _reduce_on_disk(out, inverse, weights, w.precision, w.coloured, w.matrix, w.reach, own_lane, prior, into)


@nb.njit(**{**jit, "fastmath": False})
def _tile(a, a_first, a_k, a_i, b, b_first, b_k, count, c, c_first, c_i):  # type: ignore[no-untyped-def]
    """A function of its own around `tile_product`, compiled once."""
    tile_product(a, a_first, a_k, a_i, b, b_first, b_k, count, c, c_first, c_i)


@nb.njit(**jit)
def _columns(
    out: FloatArray, segments: int, channels: int, inverse: FloatArray, scales: FloatArray, s: int, c: int,
    x: FloatArray, first: int,
) -> None:  # fmt: skip
    """Writes columns of one segment and channel times `scales` (length,) to rows of x: base residual, directions.

    Arrays are flat; `out` has been (blocks, segments, length, channels, LANES), x rows of all blocks' lanes.
    """
    lane_kernel()
    blocks = len(inverse) // LANES
    lanes = blocks * LANES
    for i in range(len(scales)):
        scale, base = scales[i], out[((s * len(scales) + i) * channels + c) * LANES]
        for block in range(blocks):
            at = (((block * segments + s) * len(scales) + i) * channels + c) * LANES
            scaled_lanes(out, at, base, inverse, block * LANES, scale, x, (first + i) * lanes + block * LANES)
        x[(first + i) * lanes] = base * scale


@nb.njit(**jit)
def _product(g: FloatArray, i: int, j: int) -> float:
    return float(g[i, j]) if i < j else float(g[j, i])


@nb.njit(**jit)
def _squares(y: FloatArray, i: int, row: FloatArray) -> None:
    """Writes row i of y' y."""
    lane_kernel()
    for j in range(y.shape[1]):
        row[j] = 0.0
    for m in range(y.shape[0]):
        factor = y[m, i]
        for j in range(y.shape[1]):
            row[j] += factor * y[m, j]


@nb.njit(**jit)
def _factor(g: FloatArray, lane: IndexArray, s: int, prior: StatePrior, into: Reduced, l: FloatArray) -> None:
    """Cholesky factor L of the products of the eliminated columns with their prior; writes its results."""
    own, fitted, occam = len(l), 0.0, 0.0
    for i in range(own):
        at = lane[1 + i]
        for j in range(i + 1):
            l[i, j] = _product(g, at, lane[1 + j])
        l[i, i] += prior.ridge[i]
        if prior.velocity > 0.0 and VELOCITY <= i < VELOCITY + 3:
            l[i, i] += prior.velocity
        whole = l[i, i]
        fitted += g[at, at] / whole
        for j in range(i):
            for m in range(j):
                l[i, j] -= l[i, m] * l[j, m]
            l[i, j] /= l[j, j]
            l[i, i] -= l[i, j] * l[i, j]
        l[i, i] = math.sqrt(max(l[i, i], 1e-16 * whole))  # against rounding; the ridge keeps it positive
        if i >= VELOCITY:
            occam += 2.0 * math.log(l[i, i])
    into.fitted[s] = fitted
    into.occam[s] = occam - 3.0 * math.log(prior.velocity) if prior.velocity > 0.0 else 0.0


@nb.njit(**jit)
def _eliminate(
    g: FloatArray, lane: IndexArray, s: int, prior: StatePrior, into: Reduced, l: FloatArray, y: FloatArray,
    row: FloatArray,
) -> None:  # fmt: skip
    """Eliminates the initial state of segment s from products g of its columns, known on and above the diagonal.

    Columns are laid out as in `lane`: base, eliminated, parameters.  y = L^-1 (B, r) for parameters and residual.
    """
    own, p = y.shape[0], y.shape[1] - 1
    _factor(g, lane, s, prior, into, l)
    cost = g[0, 0]
    for i in range(own):
        at = lane[1 + i]
        for j in range(p):
            y[i, j] = _product(g, at, lane[1 + own + j])
        y[i, p] = g[0, at]
        if prior.velocity > 0.0 and VELOCITY <= i < VELOCITY + 3:
            away = prior.away[s, i - VELOCITY]
            y[i, p] += prior.velocity * away
            cost += prior.velocity * away * away
        for m in range(i):
            for j in range(p + 1):
                y[i, j] -= l[i, m] * y[m, j]
        inverse = 1.0 / l[i, i]
        for j in range(p + 1):
            y[i, j] *= inverse
        cost -= y[i, p] * y[i, p]
    into.cost[s] = cost
    for i in range(p):
        at = lane[1 + own + i]
        _squares(y, i, row)
        for j in range(i, p):
            into.gram[s, i, j] = into.gram[s, j, i] = _product(g, at, lane[1 + own + j]) - row[j]
        into.grad[s, i] = g[0, at] - row[p]
    for i in range(own - 1, -1, -1):
        for m in range(i + 1, own):
            for j in range(p + 1):
                y[i, j] -= l[m, i] * y[m, j]
        inverse = 1.0 / l[i, i]
        for j in range(p + 1):
            y[i, j] *= inverse
        into.offset[s, i] = y[i, p]
        for j in range(p):
            into.slope[s, i, j] = y[i, j]


@nb.njit(**jit)
def _largest(g: FloatArray) -> float:
    """Largest product of two columns, which is one with itself; infinite when one is not a number."""
    out = 0.0
    for i in range(len(g)):
        if not g[i, i] <= out:
            out = g[i, i] if g[i, i] > out else math.inf
    return out


@cached
def _reduce_on_disk(
    out: FloatArray, inverse: FloatArray, weights: FloatArray, precision: FloatArray, coloured: BoolArray,
    matrix: FloatArray, reach: IntArray, lane: IndexArray, prior: StatePrior, into: Reduced,
) -> None:  # fmt: skip
    """The loop over segments of `reduce_segments`; `matrix` and `reach` as in `Whitening`."""
    count, length, channels = weights.shape
    padded = matrix.shape[1]
    blocks = out.shape[0]
    lanes = blocks * LANES
    x = cache_aligned((channels * length + TILE_ROWS) * lanes)
    plain = cache_aligned(length * lanes)
    g = cache_aligned(lanes * lanes).reshape(lanes, lanes)
    scales = np.empty(length)
    own = into.offset.shape[1]
    l, y, row = np.empty((own, own)), np.empty((own, len(lane) - own)), np.empty(len(lane) - own)
    flat_out, flat_g, flat_matrix = out.reshape(-1), g.reshape(-1), matrix.reshape(-1)
    for s in range(count):
        for c in range(channels):
            whiten = coloured[c]
            for i in range(length):
                scales[i] = weights[s, i, c]
                whiten = whiten and scales[i] > 0.0
                into.base[s, i, c] = out[0, s, i, c, 0]
            if not whiten:
                for i in range(length):
                    scales[i] *= precision[c]
                _columns(flat_out, count, out.shape[3], inverse, scales, s, c, x, c * length)
                continue
            _columns(flat_out, count, out.shape[3], inverse, scales, s, c, plain, 0)
            # The last tile runs over into rows of the next channel, which are written after it.
            for tile in range(padded // TILE_ROWS):
                begin, end = reach[c, tile], min((tile + 1) * TILE_ROWS, length)
                at = (c * padded + tile * TILE_ROWS) * length + begin
                to = (c * length + tile * TILE_ROWS) * lanes
                for j in range(0, lanes, TILE_COLUMNS):
                    right = begin * lanes + j
                    _tile(flat_matrix, at, 1, length, plain, right, lanes, end - begin, x, to + j, lanes)
        for i in range(0, lanes, TILE_ROWS):
            for j in range(i // TILE_COLUMNS * TILE_COLUMNS, lanes, TILE_COLUMNS):
                _tile(x, i, lanes, 1, x, j, lanes, channels * length, flat_g, i * lanes + j, lanes)
        into.largest[s] = _largest(g)
        _eliminate(g, lane, s, prior, into, l, y, row)


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
