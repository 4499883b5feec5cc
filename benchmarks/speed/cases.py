"""The kernel's own table: nanoseconds per particle and step, and the share of the processor's peak."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.kernel import NOMINAL_OPERATIONS, Case, all_model_cases, numpy_case, particles, peak_case
from quadid.model.simd import LANES
from quadid.vehicle import Vehicle

SLICE = 0.1
"""Time a case runs in one round [s]; its best run there counts, and the median over rounds is told.

On one core that is processor time, on both the clock on the wall.
"""


def kernel_table(rounds: int) -> dict[str, Any]:
    """Measures every line of `benchmarks.kernel`, NumPy and the peak, in turn."""
    vehicle = Vehicle.shipped("pelican")
    model = all_model_cases(vehicle, 8 * LANES)
    plain = [numpy_case(vehicle, particles(vehicle, m)) for m in (256, 4096)]
    peak = peak_case()
    every = [*(c for pair in model for c in pair), *plain, peak]
    both = {id(c) for _, c in model}
    seen: dict[int, list[float]] = {id(c): [] for c in every}
    for turn in range(rounds + 1):
        for case in every:
            best = _best(case, time.perf_counter if id(case) in both else time.thread_time)
            if turn:
                seen[id(case)].append(1e9 * best / case.steps)
    return {
        "lanes": LANES,
        "timings": [
            {"name": one.name, "one_core": _told(seen, one), "all_cores": _told(seen, both)} for one, both in model
        ],
        "numpy": {c.name: _told(seen, c) for c in plain},
        "fma_per_ns": 1.0 / _told(seen, peak)["median"],
        "operations": NOMINAL_OPERATIONS,
        "share_of_peak": NOMINAL_OPERATIONS * _told(seen, peak)["median"] / _told(seen, model[0][0])["median"],
        "share_of_peak_best": NOMINAL_OPERATIONS * _told(seen, peak)["least"] / _told(seen, model[0][0])["least"],
        "gain_over_numpy": min(_told(seen, c)["median"] for c in plain) / _told(seen, model[0][0])["median"],
        "extended_over_nominal": _told(seen, model[3][0])["median"] / _told(seen, model[0][0])["median"],
    }  # fmt: skip


def _best(case: Case, clock: Callable[[], float]) -> float:
    end, best = time.perf_counter() + SLICE, np.inf
    while time.perf_counter() < end:
        begin = clock()
        case.run()
        best = min(best, clock() - begin)
    return best


def _told(seen: dict[int, list[float]], case: Case) -> dict[str, float]:
    low, middle, high = np.percentile(seen[id(case)], [25, 50, 75])
    return {"median": middle, "low": low, "high": high, "least": min(seen[id(case)])}
