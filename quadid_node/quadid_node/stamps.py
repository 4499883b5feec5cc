"""Stamps: absolute times of messages, in nanoseconds there and in seconds [s, UNIX] here, to a quarter microsecond."""

from __future__ import annotations

import math

import numpy as np

from quadid.types import FloatArray, IntArray


def seconds(ns: int) -> float:
    """Seconds of a stamp in nanoseconds."""
    return ns * 1e-9


def many_seconds(ns: IntArray) -> FloatArray:
    """As `seconds`, for many stamps, the same numbers to the bit."""
    return np.asarray(ns * 1e-9)


def nanoseconds(t: float) -> int:
    """Nanoseconds of a time [s], to the microsecond; 0 for none."""
    return max(round(t * 1e6) * 1000, 0) if math.isfinite(t) else 0


def stamp(t: float) -> dict[str, int]:
    """builtin_interfaces/Time of a time [s]; zero for none."""
    ns = nanoseconds(t)
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}
