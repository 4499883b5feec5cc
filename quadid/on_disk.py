"""Kernels compiled with numba, their machine code kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import IndexDataCacheFile

F = TypeVar("F", bound=Callable[..., object])


class Files(IndexDataCacheFile):
    """Index and machine code of one kernel; what cannot be read, as if it were not there: it is compiled again.

    numba reads the types of all signatures before it looks whether the index belongs to this version of the source: a
    named tuple that was renamed since would end the program, as would a file that was cut short.
    """

    def _load_index(self) -> dict[Any, str]:
        try:
            return cast(dict[Any, str], super()._load_index())  # type: ignore[no-untyped-call]
        except Exception:  # noqa: BLE001  what unpickling raises is anything
            return {}

    def _load_data(self, name: str) -> Any:
        try:
            return super()._load_data(name)  # type: ignore[no-untyped-call]
        except Exception as error:
            raise FileNotFoundError(name) from error  # numba takes it for a file that was removed


def kept(stamp: str = "", **options: Any) -> Callable[[F], F]:
    """Compiles without the interpreter's lock, and keeps the machine code where something can be written.

    Args:
        stamp: of the sources beside the function's own file; where it changes, machine code on disk is dropped.
        options: of `numba.njit`.
    """

    def compiled(function: F) -> F:
        try:
            dispatcher: Any = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
        except RuntimeError:  # every start compiles anew
            return cast(F, numba.njit(nogil=True, error_model="numpy", **options)(function))
        old = dispatcher._cache._cache_file
        stamps = f"{old._source_stamp} {stamp}"
        files: Any = Files
        dispatcher._cache._cache_file = files(old._cache_path, old._index_name.removesuffix(".nbi"), stamps)
        return cast(F, dispatcher)

    return compiled
