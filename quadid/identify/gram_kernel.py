"""From rolled-out lanes to one small matrix a segment.

Three steps over a chunk of segments that stays in cache: finite-difference columns, whitening of each channel by one
matrix product over all segments, squares.
"""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from quadid.model.kernel import LANES

FloatArray = NDArray[np.float64]

CHUNK = 24
"""Segments worked on at once."""
PACK = 8
"""Columns are padded to a multiple of this."""
NEGLIGIBLE = 1e-5
"""Entries of a whitener below this share of its largest are left out."""


def segment_grams(
    out: FloatArray, steps: FloatArray, weights: FloatArray, sigma: FloatArray, coloured: NDArray[np.bool_],
    whitener: FloatArray, first: int, last: int, grams: FloatArray,
) -> None:  # fmt: skip
    """Weights, whitens and squares the residual and its finite-difference columns of segments `first` to `last`.

    Args:
        out: rolled-out residuals (blocks, segments, length, at least C channels, LANES); lane 0 is the base.
        steps: finite-difference step of each further lane (width,).
        weights: row weights (segments, length, C), 0 where nothing was measured.
        sigma: standard deviation of each channel (C,), for rows that are not whitened.
        coloured: True for channels to whiten, in segments that have all their samples.
        whitener: (C, length, length), lower-triangular.
        first: first segment.
        last: one past the last.
        grams: (segments, width + 1, width + 1), written: products of the columns, the base residual last.
    """
    length, channels = weights.shape[1:]
    width = len(steps) + 1
    lanes = -(-width // PACK) * PACK
    inverse = np.zeros(out.shape[0] * LANES)
    inverse[1:width] = 1.0 / steps
    flat_out = out.reshape(*out.shape[:3], -1)
    reach = [_reach(w) for w in whitener]
    for start in range(first, last, CHUNK):
        stop = min(start + CHUNK, last)
        x = np.empty((channels, length, stop - start, lanes))
        complete = np.all(weights[start:stop] > 0.0, axis=1).T & coloured[:, None]
        _columns(flat_out, inverse, weights, 1.0 / sigma, complete, start, x)
        flat = x.reshape(channels, length, -1)
        for c in np.flatnonzero(complete.any(axis=1)):
            white = np.empty_like(flat[c])
            _product(whitener[c], reach[c], flat[c], white)
            white = white.reshape(length, stop - start, lanes)
            if complete[c].all():
                x[c] = white
            else:
                x[c][:, complete[c]] = white[:, complete[c]]
        products = np.zeros((stop - start, lanes, lanes))
        _squares(x.reshape(channels * length, stop - start, lanes), width, products)
        grams[start:stop, :-1, :-1] = products[:, 1:width, 1:width]
        grams[start:stop, -1, :-1] = grams[start:stop, :-1, -1] = products[:, 1:width, 0]
        grams[start:stop, -1, -1] = products[:, 0, 0]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _columns(
    out: FloatArray, inverse: FloatArray, weights: FloatArray, precision: FloatArray, complete: NDArray[np.bool_],
    first: int, x: FloatArray,
) -> None:  # fmt: skip
    """Writes weighted columns into x (C, length, segments, lanes): the base residual, then one a direction.

    Rows not to be whitened are multiplied by `precision`, 1 / sigma.
    """
    channels, length, count, lanes = x.shape
    for s in range(count):
        for i in range(length):
            for c in range(channels):
                scale = weights[first + s, i, c]
                if not complete[c, s]:
                    scale *= precision[c]
                base = out[0, first + s, i, c * LANES]
                to = x[c, i, s]
                for block in range(out.shape[0]):
                    row, start = out[block, first + s, i], block * LANES
                    for lane in range(min(LANES, lanes - start)):
                        to[start + lane] = (row[c * LANES + lane] - base) * inverse[start + lane] * scale
                to[0] = base * scale


def _reach(w: FloatArray) -> NDArray[np.int64]:
    """First column of each row of a lower-triangular whitener that still matters, shape (n,)."""
    matters = np.abs(w) > NEGLIGIBLE * np.max(np.abs(w))
    return np.asarray(np.argmax(matters, axis=1), dtype=np.int64)


@nb.njit(cache=True, nogil=True, fastmath=True)
def _product(w: FloatArray, reach: NDArray[np.int64], x: FloatArray, y: FloatArray) -> None:
    """Writes y = w x for lower-triangular w (n, n), x (n, m) in strips that stay in cache, four terms at a time.

    Row i of w counts from column `reach[i]` to i.  Own loops, as in `_squares`: the caller already runs one thread a
    core.
    """
    n, m = x.shape
    for low in range(0, m, 256):
        high = min(low + 256, m)
        for i in range(n):
            row = y[i, low:high]
            row[:] = 0.0
            first, end = reach[i], i + 1
            last = end - (end - first) % 4
            for r in range(first, last, 4):
                f0, f1, f2, f3 = w[i, r], w[i, r + 1], w[i, r + 2], w[i, r + 3]
                r0, r1, r2, r3 = x[r, low:high], x[r + 1, low:high], x[r + 2, low:high], x[r + 3, low:high]
                for j in range(high - low):
                    row[j] += f0 * r0[j] + f1 * r1[j] + f2 * r2[j] + f3 * r3[j]
            for r in range(last, end):
                f0 = w[i, r]
                r0 = x[r, low:high]
                for j in range(high - low):
                    row[j] += f0 * r0[j]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _squares(x: FloatArray, width: int, products: FloatArray) -> None:
    """Adds up the products of the first `width` columns of each segment, four rows at a time to spare loads.

    Own loops: for matrices so small a library call would start threads of its own.
    """
    rows, count, _ = x.shape
    for s in range(count):
        g = products[s]
        for i in range(0, rows - 3, 4):
            r0, r1, r2, r3 = x[i, s], x[i + 1, s], x[i + 2, s], x[i + 3, s]
            for a in range(width):
                f0, f1, f2, f3 = r0[a], r1[a], r2[a], r3[a]
                # Below the diagonal only what fills a pack: the rest is copied at the end.
                for b in range(a // PACK * PACK, width):
                    g[a, b] += f0 * r0[b] + f1 * r1[b] + f2 * r2[b] + f3 * r3[b]
        for i in range(rows - rows % 4, rows):
            r0 = x[i, s]
            for a in range(width):
                f0 = r0[a]
                for b in range(a // PACK * PACK, width):
                    g[a, b] += f0 * r0[b]
        for a in range(width):
            for b in range(a // PACK * PACK):
                g[a, b] = g[b, a]
