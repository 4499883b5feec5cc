"""Compiled functions whose machine code stays on disk until any source it was made from changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def kept(function: F, sources: object = "", **options: Any) -> F:
    """Compiles with numba and keeps the machine code on disk; where nothing can be written, every start compiles anew.

    Args:
        function: the kernel.
        sources: checksum of what the kernel calls in other files.  numba alone looks at the file of the function
            itself: after an upgrade an old version of what it calls would go on running.
        options: of `numba.njit`.
    """
    try:
        compiled: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return cast(F, numba.njit(**options)(function))
    file = compiled._cache._cache_file
    file._source_stamp = f"{file._source_stamp} {sources}"
    return cast(F, compiled)
