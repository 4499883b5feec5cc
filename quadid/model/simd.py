"""Help for the compiler: full-width vectors and aligned memory for kernels whose innermost loop runs over lanes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from quadid.effects import EFFECTS
from quadid.on_disk import kept, sources
from quadid.types import FloatArray

LANES = 16
"""Parameter vectors rolled out together; two AVX-512 or four AVX2 registers of float64."""
CACHE_LINE = 8
"""float64 numbers in one cache line and in one AVX-512 register; access across lines costs twice."""

TILE_ROWS, TILE_COLUMNS = 8, 16
"""Size of a tile of a product: sums that fit into the registers of one core."""
_VECTOR = ir.VectorType(ir.DoubleType(), CACHE_LINE)

FREE = {"contract", "nnan", "ninf", "nsz"}
"""Freedom of the compiler: fused multiply-add, and no regard for infinities.  No regrouping of sums: each compilation
would round differently, and flights replayed after a restart would not be the same bit for bit."""
whole: dict[str, Any] = {"nogil": True, "fastmath": FREE, "error_model": "numpy"}
"""Options of functions that Python calls."""
_ORDER = ",".join(f"{e.name}.{p.name}" for e in EFFECTS.values() for p in e.parameters)
cached: Any = kept(sources("quadid.model", _ORDER), fastmath=FREE)
"""Compiles such a function as one of the kernels on disk, which the order of parameters is built into."""
jit: dict[str, Any] = {**whole, "_nrt": False}
"""Options of the pieces of kernels: no reference counts, whose atomic updates cost more than a short lane loop."""
exact: dict[str, Any] = {**jit, "fastmath": False}
"""Options of pieces that prepare constants, whose loops are not all vectors: fused or not, lanes must round alike."""
inlined: dict[str, Any] = {**jit, "forceinline": True}
"""Options of pieces that are merged into what calls them."""


def variant(which: str) -> Callable[[Any], Any]:
    """Names a function that is compiled several times, each time with other constants of the function around it.

    The linker finds compiled functions by name, types of arguments, and a number counted anew in each process.  Kernels
    on disk come from several processes: without names of their own, one kernel may be given the other's variant.

    Args:
        which: distinguishes the variants of one function.
    """

    def name(function: Any) -> Any:
        function.__name__ += f"_{which}"
        function.__qualname__ += f"_{which}"
        return function

    return name


def _lane_kernel(context: Any) -> Any:
    """Called first in a function whose loops run over lanes; sets three attributes of that function.

    It is not merged into its callers, where its loops would be vectorised anew, and worse.  Registers may be 512 bits
    wide where the processor has them.  No two array arguments overlap, so no loop needs a check for that.
    """

    def generate(codegen_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        function = builder.function
        function.attributes.add("noinline")
        set.add(function.attributes, '"prefer-vector-width"="512"')  # the builder lacks this attribute; LLVM has it
        for argument in function.args[2:]:  # after the places for result and error
            if argument.type.is_pointer:
                argument.add_attribute("noalias")
        return codegen_context.get_dummy_value()

    return types.none(), generate


lane_kernel: Any = intrinsic(_lane_kernel)


def _vector(array: Any) -> Any:
    """Returns a function that gives the place of a vector in a flat array."""
    return lambda builder, index: builder.bitcast(builder.gep(array, [index]), _VECTOR.as_pointer())


def _spread(builder: Any, number: Any) -> Any:
    """A vector of equal numbers."""
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(nothing, number, ir.IntType(32)(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(ir.IntType(32), CACHE_LINE), None))


def _data(context: Any, builder: Any, signature: Any, values: Any) -> list[Any]:
    """Arguments, of arrays the place of their numbers."""
    return [
        context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
        for kind, value in zip(signature.args, values, strict=True)
    ]


def _scaled_lanes(typing_context: Any, a: Any, a_first: Any, base: Any, b: Any, b_first: Any, scale: Any, c: Any,
                  c_first: Any) -> Any:  # fmt: skip
    """Writes c = (a - base) (b scale) for LANES numbers of flat arrays; a loop so short would become scalar code."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        left, left_first, base, right, right_first, scale, out, out_first = _data(context, builder, signature, values)
        base, scale = _spread(builder, base), _spread(builder, scale)
        for j in range(0, LANES, CACHE_LINE):
            index = [builder.add(first, first.type(j)) for first in (left_first, right_first, out_first)]
            change = builder.fsub(builder.load(_vector(left)(builder, index[0]), align=8), base)
            factor = builder.fmul(builder.load(_vector(right)(builder, index[1]), align=8), scale)
            builder.store(builder.fmul(change, factor), _vector(out)(builder, index[2]), align=8)
        return context.get_dummy_value()

    return types.none(a, a_first, base, b, b_first, scale, c, c_first), generate


scaled_lanes: Any = intrinsic(_scaled_lanes)


def _tile_product(typing_context: Any, a: Any, a_first: Any, a_k: Any, a_i: Any, b: Any, b_first: Any, b_k: Any,
               count: Any, c: Any, c_first: Any, c_i: Any) -> Any:  # fmt: skip
    """Writes one tile of a product, c[i, j] = sum over k of a[i, k] b[k, j], to an array.

    Arguments: a, its first entry, steps of k and i; b, its first entry, step of k; number of k; c, its first entry,
    step of i.  Arrays are flat.  All sums of the tile are vectors kept in registers over the loop, which compilers do
    not manage on their own.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.function.attributes.add("noinline")
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')  # the builder lacks this attribute
        arrays = _data(context, builder, signature, values)
        left, left_first, left_k, left_i, right, right_first, right_k, terms, out, out_first, out_i = arrays
        zero = ir.Constant(_VECTOR, [0.0] * CACHE_LINE)
        parts = TILE_COLUMNS // CACHE_LINE
        with builder.goto_entry_block():
            sums = [[builder.alloca(_VECTOR) for _ in range(parts)] for _ in range(TILE_ROWS)]
        for place in (p for row in sums for p in row):
            builder.store(zero, place)
        with cgutils.for_range(builder, terms) as loop:
            row = builder.add(right_first, builder.mul(loop.index, right_k))
            entry = builder.add(left_first, builder.mul(loop.index, left_k))
            places = [builder.add(row, row.type(j * CACHE_LINE)) for j in range(parts)]
            along = [builder.load(_vector(right)(builder, place), align=8) for place in places]
            for i in range(TILE_ROWS):
                factor = builder.load(builder.gep(left, [builder.add(entry, builder.mul(left_i, left_i.type(i)))]))
                spread = _spread(builder, factor)
                for j in range(parts):
                    product = builder.fmul(spread, along[j], flags=("contract",))
                    total = builder.fadd(builder.load(sums[i][j]), product, flags=("contract",))
                    builder.store(total, sums[i][j])
        for i in range(TILE_ROWS):
            for j in range(parts):
                at = builder.add(builder.add(out_first, builder.mul(out_i, out_i.type(i))), out_i.type(j * CACHE_LINE))
                builder.store(builder.load(sums[i][j]), _vector(out)(builder, at), align=8)
        return context.get_dummy_value()

    return types.none(a, a_first, a_k, a_i, b, b_first, b_k, count, c, c_first, c_i), generate


tile_product: Any = intrinsic(_tile_product)


@nb.njit(**whole)
def cache_aligned(size: int) -> FloatArray:
    """Returns an uninitialised array of `size` numbers that starts on a cache line; for use in kernels."""
    room = np.empty(size + CACHE_LINE)
    skip = -(room.ctypes.data // 8) % CACHE_LINE
    return room[skip : skip + size]


def aligned(shape: tuple[int, ...]) -> FloatArray:
    """Returns an uninitialised C-contiguous array that starts on a cache line."""
    size = math.prod(shape)
    room = np.empty(size + CACHE_LINE)
    skip = -(room.ctypes.data // room.itemsize) % CACHE_LINE
    return room[skip : skip + size].reshape(shape)
