"""From rolled-out lanes to one small matrix a segment, without large arrays in between."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from quadid.model.kernel import LANES

FloatArray = NDArray[np.float64]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _times(w: FloatArray, x: FloatArray, first: int, scratch: FloatArray) -> None:
    """Multiplies the rows of x from `first` on by w (n, n)."""
    n, width = len(w), x.shape[1]
    for i in range(n):
        for j in range(width):
            scratch[i, j] = 0.0
        for r in range(n):
            f = w[i, r]
            if f != 0.0:
                for j in range(width):
                    scratch[i, j] += f * x[first + r, j]
    for i in range(n):
        for j in range(width):
            x[first + i, j] = scratch[i, j]


@nb.njit(cache=True, nogil=True, fastmath=True)
def _square(x: FloatArray, out: FloatArray) -> None:
    """Writes x' x.  Own loops: a library call for so small a matrix would start threads of its own."""
    rows, width = x.shape
    out[:] = 0.0
    for i in range(rows):
        for a in range(width):
            f = x[i, a]
            if f != 0.0:
                for b in range(a, width):
                    out[a, b] += f * x[i, b]
    for a in range(width):
        for b in range(a):
            out[a, b] = out[b, a]


@nb.njit(cache=True, nogil=True, fastmath=True)
def segment_grams(
    out: FloatArray, inverse_steps: FloatArray, weights: FloatArray, sigma: FloatArray, coloured: NDArray[np.bool_],
    whitener: FloatArray, channels: int, first: int, last: int, grams: FloatArray,
) -> None:  # fmt: skip
    """Weights, whitens and squares the residual and its finite-difference columns of segments `first` to `last`.

    Args:
        out: rolled-out residuals (blocks, segments, length, at least `channels`, LANES); lane 0 is the base.
        inverse_steps: 1 / step of each further lane (width,).
        weights: row weights (segments, length, channels), 0 where nothing was measured.
        sigma: standard deviation of each channel (channels,), for rows that are not whitened.
        coloured: True for channels to whiten, where a segment has all its samples.
        whitener: (channels, length, length).
        channels: channels used.
        first, last: range of segments.
        grams: (segments, width + 1, width + 1), written: products of the columns, the base residual last.
    """
    length, width = out.shape[2], len(inverse_steps)
    x = np.empty((channels * length, width + 1))
    scratch = np.empty((length, width + 1))
    for s in range(first, last):
        for c in range(channels):
            full = coloured[c]
            if full:
                for i in range(length):
                    if weights[s, i, c] <= 0.0:
                        full = False
            for i in range(length):
                row = c * length + i
                scale = weights[s, i, c] if full else weights[s, i, c] / sigma[c]
                base = out[0, s, i, c, 0]
                x[row, width] = base * scale
                for j in range(width):
                    lane = j + 1
                    value = out[lane // LANES, s, i, c, lane % LANES]
                    x[row, j] = (value - base) * inverse_steps[j] * scale
            if full:
                _times(whitener[c], x, c * length, scratch)
        _square(x, grams[s])
