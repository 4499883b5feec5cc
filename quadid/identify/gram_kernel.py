"""From rolled-out lanes to one small matrix a segment.

One segment at a time, so that all of it stays in the processor's cache: finite-difference columns, whitening of each
channel, squares.  The last two are products of small matrices, made of tiles whose sums stay in vector registers.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from quadid.model.kernel import LANES

FloatArray = NDArray[np.float64]

TILE_ROWS, TILE_COLUMNS = 8, 16
"""Size of a tile of a product: sums that fit into the registers of one core."""
_VECTOR = 8
NEGLIGIBLE = 1e-5
"""Entries of a whitener below this share of its largest are left out."""


class Whitening:
    """What weights and whitens the channels of a segment.

    Attributes:
        precision: 1 / sigma of each channel, for rows that are not whitened, shape (C,).
        coloured: True for channels to whiten, in segments that have all their samples, shape (C,).
        matrix: lower-triangular, rows padded with zeros to whole tiles, shape (C, padded length, length).
        reach: first column of each tile of rows that counts, shape (C, tiles).
    """

    def __init__(self, sigma: FloatArray, coloured: NDArray[np.bool_], whitener: FloatArray) -> None:
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


def segment_grams(
    out: FloatArray, steps: FloatArray, weights: FloatArray, whitening: Whitening, grams: FloatArray
) -> None:
    """Weights, whitens and squares the residual and its finite-difference columns of every segment.

    Args:
        out: rolled-out residuals (blocks, segments, length, at least C channels, LANES); lane 0 is the base.
        steps: finite-difference step of each further lane (width,).
        weights: row weights (segments, length, C), 0 where nothing was measured.
        whitening: of the channels.
        grams: (segments, width + 1, width + 1), written: products of the columns, the base residual last.
    """
    inverse = np.zeros(out.shape[0] * LANES)
    inverse[1 : len(steps) + 1] = 1.0 / steps
    flat = out.reshape(*out.shape[:3], -1)
    w = whitening
    _segment_grams(flat, inverse, weights, w.precision, w.coloured, w.matrix, w.reach, len(steps) + 1, grams)


def _tile_product(typing_context: Any, a: Any, a_first: Any, a_k: Any, a_i: Any, b: Any, b_first: Any, b_k: Any,
               count: Any, c: Any, c_first: Any, c_i: Any) -> Any:  # fmt: skip
    """Writes one tile of a product, c[i, j] = sum over k of a[i, k] b[k, j], to an array.

    Arguments: a, its first entry, steps of k and i; b, its first entry, step of k; number of k; c, its first entry,
    step of i.  Arrays are flat.  All sums of the tile are vectors kept in registers over the loop, which compilers do
    not manage on their own.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.function.attributes.add("noinline")
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')  # the builder knows no such attribute
        arrays: list[Any] = [
            context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, values, strict=True)
        ]
        left, left_first, left_k, left_i, right, right_first, right_k, terms, out, out_first, out_i = arrays
        vector = ir.VectorType(ir.DoubleType(), _VECTOR)
        zero = ir.Constant(vector, [0.0] * _VECTOR)
        parts = TILE_COLUMNS // _VECTOR
        with builder.goto_entry_block():
            sums = [[builder.alloca(vector) for _ in range(parts)] for _ in range(TILE_ROWS)]
        for place in (p for row in sums for p in row):
            builder.store(zero, place)

        def vector_at(array: Any, index: Any) -> Any:
            return builder.bitcast(builder.gep(array, [index]), vector.as_pointer())

        with cgutils.for_range(builder, terms) as loop:
            row = builder.add(right_first, builder.mul(loop.index, right_k))
            entry = builder.add(left_first, builder.mul(loop.index, left_k))
            along = [
                builder.load(vector_at(right, builder.add(row, row.type(j * _VECTOR))), align=8) for j in range(parts)
            ]
            for i in range(TILE_ROWS):
                factor = builder.load(builder.gep(left, [builder.add(entry, builder.mul(left_i, left_i.type(i)))]))
                spread = builder.insert_element(ir.Constant(vector, ir.Undefined), factor, ir.IntType(32)(0))
                places = ir.Constant(ir.VectorType(ir.IntType(32), _VECTOR), [0] * _VECTOR)
                spread = builder.shuffle_vector(spread, ir.Constant(vector, ir.Undefined), places)
                for j in range(parts):
                    product = builder.fmul(spread, along[j], flags=("contract",))
                    total = builder.fadd(builder.load(sums[i][j]), product, flags=("contract",))
                    builder.store(total, sums[i][j])
        for i in range(TILE_ROWS):
            for j in range(parts):
                place = builder.add(builder.add(out_first, builder.mul(out_i, out_i.type(i))), out_i.type(j * _VECTOR))
                builder.store(builder.load(sums[i][j]), vector_at(out, place), align=8)
        return context.get_dummy_value()

    return types.none(a, a_first, a_k, a_i, b, b_first, b_k, count, c, c_first, c_i), generate


_tile_code: Any = intrinsic(_tile_product)


@nb.njit(cache=True, nogil=True)
def _tile(a, a_first, a_k, a_i, b, b_first, b_k, count, c, c_first, c_i):  # type: ignore[no-untyped-def]
    """A function of its own around `_tile_code`, compiled once."""
    _tile_code(a, a_first, a_k, a_i, b, b_first, b_k, count, c, c_first, c_i)


@nb.njit(cache=True, nogil=True, fastmath=True)
def _columns(
    out: FloatArray, inverse: FloatArray, scales: FloatArray, s: int, c: int, x: FloatArray, first: int
) -> None:
    """Writes columns of one segment and channel times `scales` (length,) to rows of x: base residual, directions."""
    lanes = x.shape[1]
    for i in range(len(scales)):
        scale, base = scales[i], out[0, s, i, c * LANES]
        for block in range(out.shape[0]):
            for lane in range(LANES):
                j = block * LANES + lane
                x[first + i, j] = (out[block, s, i, c * LANES + lane] - base) * (inverse[j] * scale)
        x[first + i, 0] = base * scale
        for j in range(out.shape[0] * LANES, lanes):
            x[first + i, j] = 0.0


@nb.njit(cache=True, nogil=True)
def _segment_grams(
    out: FloatArray, inverse: FloatArray, weights: FloatArray, precision: FloatArray, coloured: NDArray[np.bool_],
    matrix: FloatArray, reach: NDArray[np.int64], width: int, grams: FloatArray,
) -> None:  # fmt: skip
    """The loop over segments of `segment_grams`; `matrix` and `reach` as in `Whitening`."""
    count, length, channels = weights.shape
    padded = matrix.shape[1]
    lanes = -(-width // TILE_COLUMNS) * TILE_COLUMNS
    x = np.empty((channels * length + TILE_ROWS, lanes))
    plain = np.empty((length, lanes))
    g = np.empty((lanes, lanes))
    scales = np.empty(length)
    flat, flat_plain, flat_g, flat_matrix = x.reshape(-1), plain.reshape(-1), g.reshape(-1), matrix.reshape(-1)
    for s in range(count):
        for c in range(channels):
            whiten = coloured[c]
            for i in range(length):
                scales[i] = weights[s, i, c]
                whiten = whiten and scales[i] > 0.0
            if not whiten:
                for i in range(length):
                    scales[i] *= precision[c]
                _columns(out, inverse, scales, s, c, x, c * length)
                continue
            _columns(out, inverse, scales, s, c, plain, 0)
            # The last tile runs over into rows of the next channel, which are written after it.
            for tile in range(padded // TILE_ROWS):
                begin, end = reach[c, tile], min((tile + 1) * TILE_ROWS, length)
                at = (c * padded + tile * TILE_ROWS) * length + begin
                to = (c * length + tile * TILE_ROWS) * lanes
                for j in range(0, lanes, TILE_COLUMNS):
                    right = begin * lanes + j
                    _tile(flat_matrix, at, 1, length, flat_plain, right, lanes, end - begin, flat, to + j, lanes)
        for i in range(0, lanes, TILE_ROWS):
            for j in range(i // TILE_COLUMNS * TILE_COLUMNS, lanes, TILE_COLUMNS):
                _tile(flat, i, lanes, 1, flat, j, lanes, channels * length, flat_g, i * lanes + j, lanes)
        for i in range(width):
            to_row = width - 1 if i == 0 else i - 1
            for j in range(i, width):
                to_column = width - 1 if j == 0 else j - 1
                grams[s, to_row, to_column] = g[i, j]
                grams[s, to_column, to_row] = g[i, j]
