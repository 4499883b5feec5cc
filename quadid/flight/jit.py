"""The one place that sets how kernels of the flown vehicle are compiled.

numba keeps machine code on disk by the content of the file a kernel is in, and does not see that a kernel it calls, in
another file, has changed: after an upgrade the old physics would go on flying.  The stamp of every kernel here
therefore covers all sources of this room.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib import resources

from quadid.on_disk import F, kept
from quadid.vehicle import GRAVITY


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
    """Compiles `function` with numba, in IEEE arithmetic (no fastmath).

    The truth is a reference, so no arithmetic is re-ordered: the same seed gives the same bits.
    """
    return kept(fingerprint())(function)
