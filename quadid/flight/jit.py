"""The one place that sets how kernels of the flown vehicle are compiled."""

from __future__ import annotations

from quadid.on_disk import F, kept, sources
from quadid.vehicle import GRAVITY


def kernel(function: F) -> F:
    """Compiles `function` with numba, in IEEE arithmetic (no fastmath).

    The truth is a reference, so no arithmetic is re-ordered: the same seed gives the same bits.
    """
    return kept(sources("quadid.flight", repr(GRAVITY)))(function)
