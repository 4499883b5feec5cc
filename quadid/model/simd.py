"""Help for the compiler: full-width vectors and aligned memory for kernels whose innermost loop runs over lanes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from numba.core import types
from numba.extending import intrinsic

from quadid.effects import EFFECTS
from quadid.on_disk import kept, sources
from quadid.types import FloatArray

LANES = 16
"""Parameter vectors rolled out together; two AVX-512 or four AVX2 registers of float64."""
CACHE_LINE = 8
"""float64 numbers in one cache line and in one AVX-512 register; access across lines costs twice."""

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
