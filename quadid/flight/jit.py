"""The one place that knows how kernels of the flown vehicle are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compiles `function` with numba: no interpreter lock, cached on disk, IEEE arithmetic (no fastmath).

    The truth is a reference, so no arithmetic is re-ordered: the same seed gives the same bits.
    """
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
