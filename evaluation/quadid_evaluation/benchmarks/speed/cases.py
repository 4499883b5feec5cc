"""The kernel's own table: nanoseconds per particle and step, and the share of the processor's peak."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from quadid.effects import EFFECTS
from quadid.model.layout import Layout
from quadid.model.simd import LANES
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.kernel import (
    NOMINAL_OPERATIONS,
    Case,
    all_model_cases,
    free,
    model_cases,
    numpy_case,
    particles,
    peak_case,
)  # fmt: skip

SLICE, TURNS = 0.01, 10
"""Time a case runs in one turn [s], and turns in a round.

The best run of a turn counts; told are the best and quartiles over turns.  On one core that is processor time, so that
other programs only take cache and memory from a run; on both it is time by the clock, which they add to.
"""


def kernel_table(rounds: int) -> dict[str, Any]:
    """Measures every line of `quadid_evaluation.benchmarks.kernel`, NumPy and the peak, in turn."""
    vehicle = Vehicle.shipped("pelican")
    model = all_model_cases(vehicle, 8 * LANES)
    plain = [numpy_case(vehicle, particles(vehicle, m)) for m in (256, 4096)]
    peak = peak_case()
    every = [*(c for pair in model for c in pair), *plain, peak]
    both = {id(c) for _, c in model}
    seen: dict[int, list[float]] = {id(c): [] for c in every}
    for turn in range(TURNS * rounds + 1):
        for case in every:
            best = _best(case, time.perf_counter if id(case) in both else time.thread_time)
            if turn:
                seen[id(case)].append(1e9 * best / case.steps)
    nominal, full, plainest, top = (
        _told(seen, c)["least"]
        for c in (model[0][0], model[3][0], min(plain, key=lambda c: _told(seen, c)["least"]), peak)
    )
    return {
        "lanes": LANES,
        "timings": [
            {"name": one.name, "one_core": _told(seen, one), "all_cores": _told(seen, both)} for one, both in model
        ],
        "numpy": {c.name: _told(seen, c) for c in plain},
        "fma_per_ns": 1.0 / top,
        "operations": NOMINAL_OPERATIONS,
        "share_of_peak": NOMINAL_OPERATIONS * top / nominal,
        "gain_over_numpy": plainest / nominal,
        "extended_over_nominal": full / nominal,
        "every_over_nominal": _told(seen, model[5][0])["least"] / nominal,
    }  # fmt: skip


def effect_table(rounds: int) -> dict[str, Any]:
    """The swarm's cost with each effect of the catalogue alone, of another size in every particle, over the nominal."""
    vehicle = Vehicle.shipped("pelican")
    nominal, entries = particles(vehicle, LANES), Layout(vehicle).entries.values()
    vectors = {"nominal": nominal}
    for effect in EFFECTS:
        own = [e for e in entries if e.name.startswith(f"{effect}.") and not e.name.endswith(".time")]
        vectors[effect] = free(nominal, *((e.index, e.typical) for e in own))
    cases = {name: model_cases(name, vehicle, thetas, 9, True)[0] for name, thetas in vectors.items()}
    least = dict.fromkeys(cases, np.inf)
    for _ in range(TURNS * rounds):
        for name, case in cases.items():
            least[name] = min(least[name], 1e9 * _best(case, time.thread_time) / case.steps)
    ratios = {name: ns / least["nominal"] for name, ns in least.items() if name != "nominal"}
    return {
        "ns": least, "ratios": ratios, "median": float(np.median(list(ratios.values()))),
        "largest": max(ratios, key=lambda name: ratios[name]),
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
