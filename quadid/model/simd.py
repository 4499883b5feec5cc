"""Help for the compiler: full-width vectors and aligned memory for kernels whose innermost loop runs over lanes."""

from __future__ import annotations

import math
import zlib
from importlib import resources
from typing import Any

import numba as nb
import numpy as np
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LANES = 16
"""Parameter vectors rolled out together; two AVX-512 or four AVX2 registers of float64."""
CACHE_LINE = 8
"""float64 numbers in one cache line and in one AVX-512 register; access across lines costs twice."""

FREE = {"contract", "nnan", "ninf", "nsz"}
"""Freedom of the compiler: fused multiply-add, and no regard for infinities.  No regrouping of sums: each compilation
would round differently, and flights replayed after a restart would not be the same bit for bit."""
cached: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": FREE, "error_model": "numpy"}
"""Options of the kernels that Python calls."""
allocating: dict[str, Any] = {
    "nogil": True, "fastmath": FREE, "error_model": "numpy", "no_cfunc_wrapper": True
}  # fmt: skip
"""Options of kernels that make arrays."""
jit: dict[str, Any] = {**allocating, "_nrt": False}
"""Options of all others: without reference counts, whose atomic updates cost more than a short lane loop."""
exact: dict[str, Any] = {**jit, "fastmath": False}
"""Options of kernels that prepare constants, whose loops are not all vectors: fused or not, lanes must round alike."""
inlined: dict[str, Any] = {**jit, "forceinline": True}
"""Options of the pieces that kernels are made of."""


def _sources() -> int:
    """Checksum of the source of the kernels, and of the control law and rotations that one of them calls."""
    folder = resources.files("quadid.model")
    names = sorted(
        entry.name
        for entry in folder.iterdir()
        if entry.name.endswith(("kernel.py", "rows.py", "layout.py", "simd.py"))
    )
    outside = [(resources.files("quadid") / name).read_bytes() for name in ("stabiliser.py", "rotation.py")]
    return zlib.crc32(b"".join([*((folder / name).read_bytes() for name in names), *outside]))


SOURCES = _sources()
"""Captured by the kernels on disk, so that it becomes part of their key: numba alone looks at the file of the function
that is called, and would run an old version of what that function calls."""


def _lane_kernel(context: Any) -> Any:
    """Called first in a kernel whose loops run over lanes; tells the compiler three things about that kernel.

    Registers may be 512 bits wide where the processor has them: the compiler prefers 256, out of care for code that
    mixes wide and scalar work, but lane loops are nearly all arithmetic and gain 1.6 times.  No two array arguments
    overlap, so no loop needs a check (or falls back to scalar code because it would need too many).  The kernel stays
    a function of its own: merged into its caller it would be vectorised anew, and worse, in every caller.
    """

    def generate(codegen_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        function = builder.function
        function.attributes.add("noinline")
        function.attributes.alignstack = 64
        set.add(function.attributes, '"prefer-vector-width"="512"')  # the builder knows no such attribute; LLVM does
        for argument in function.args[2:]:  # after the places for result and error
            if argument.type.is_pointer:
                argument.add_attribute("noalias")
        return codegen_context.get_dummy_value()

    return types.none(), generate


lane_kernel: Any = intrinsic(_lane_kernel)


@nb.njit(**allocating)
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
