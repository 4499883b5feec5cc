"""The one place that knows how kernels of the flown vehicle are compiled."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from importlib import resources
from typing import TypeVar

from quadid.machine_code import kept
from quadid.vehicle import GRAVITY

F = TypeVar("F", bound=Callable[..., object])


@cache
def fingerprint() -> str:
    """Hash of every source file of this package and of what its kernels take from outside."""
    digest = hashlib.sha256(repr(GRAVITY).encode())
    digest.update((resources.files("quadid") / "attitude_controller.py").read_bytes())
    for entry in sorted(resources.files(__package__ or "quadid.flight").iterdir(), key=lambda e: e.name):
        if entry.name.endswith(".py"):
            digest.update(entry.read_bytes())
    return digest.hexdigest()


def kernel(function: F) -> F:
    """Compiles `function` with numba: no interpreter lock, cached on disk, IEEE arithmetic (no fastmath).

    The truth is a reference, so no arithmetic is re-ordered: the same seed gives the same bits.
    """
    return kept(function, fingerprint(), nogil=True, error_model="numpy")
