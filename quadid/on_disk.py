"""Kernels compiled with numba, their machine code kept on disk."""

import hashlib
import os
from collections.abc import Callable
from functools import cache
from importlib import resources
from typing import Any, TypeVar, cast

import numba
from numba.core import config
from numba.core.caching import IndexDataCacheFile

from quadid.files import refuse

F = TypeVar("F", bound=Callable[..., object])

refuse()
config._config_fname = ""  # looked for before every compilation, in the folder that the program has changed to by then
config.reload_config()  # type: ignore[no-untyped-call]


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


@cache
def sources(package: str, also: str = "") -> str:
    """Hash of all source files of a package, of what its kernels call outside of it, and of `also`.

    numba looks at the file of the function that is called, and would run an old version of what that function calls in
    another file: after an upgrade the old physics would go on.
    """
    digest = hashlib.sha256(also.encode())
    for name in ("attitude_controller.py", "rotation.py"):
        digest.update((resources.files("quadid") / name).read_bytes())
    for entry in sorted(resources.files(package).iterdir(), key=lambda e: e.name):
        if entry.name.endswith(".py"):
            digest.update(entry.read_bytes())
    return digest.hexdigest()


def kept(stamp: str = "", **options: Any) -> Callable[[F], F]:
    """Compiles without the interpreter's lock, and keeps the machine code where something can be written.

    Args:
        stamp: of the sources beside the function's own file; where it changes, machine code on disk is dropped.
        options: of `numba.njit`.
    """

    def compiled(function: F) -> F:
        try:
            dispatcher: Any = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
            old = dispatcher._cache._cache_file
            if not os.path.isabs(old._cache_path):  # of a user without a home: in the working folder
                raise RuntimeError(old._cache_path)
        except RuntimeError:  # every start compiles anew
            return cast(F, numba.njit(nogil=True, error_model="numpy", **options)(function))
        stamps = f"{old._source_stamp} {stamp}"
        files: Any = Files
        dispatcher._cache._cache_file = files(old._cache_path, old._index_name.removesuffix(".nbi"), stamps)
        return cast(F, dispatcher)

    return compiled
