"""What was wanted of the speed, and what was measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Result = Mapping[str, Any]

GOALS: tuple[tuple[str, str, str, Callable[[Result], str]], ...] = (
    ("kernel", "share of the processor's peak", "40 %", lambda r: f"{r['share_of_peak']:.0%}"),
    ("effects", "any one effect against nominal", "3 times",
     lambda r: f"{min(r['ratios'].values()):.1f} to {max(r['ratios'].values()):.1f} times"),
    ("kernel", "every effect at once against nominal", "3 times", lambda r: f"{r['every_over_nominal']:.1f} times"),
    ("objectives", "NumPy's objective, over particles, against ours, per core", "60 times",
     lambda r: _range(r, "gain_particles")),
    ("objectives", "... over particles and segments", "60 times", lambda r: _range(r, "gain")),
    ("peers", "pyswarms with NumPy over particles against ours, by the clock", "50 times",
     lambda r: f"{r['gain_particles']:.0f} times"),
    ("peers", "... over particles and segments", "50 times", lambda r: f"{r['gain']:.0f} times"),
    ("optimum", "swarm and polish against least squares", "3 times",
     lambda r: f"{_seconds(r, 'pso_polish') / _seconds(r, 'least_squares'):.1f} times"),
    ("optimum", "swarm and polish against CMA-ES", "1 time",
     lambda r: f"{_seconds(r, 'pso_polish') / _seconds(r, 'cma_es'):.1f} times"),
    ("identification", "500 s, 64 x 100, polish, intervals", "2 s",
     lambda r: _both(r["times"]["64 x 100, polish, intervals"])),
    ("diagnoses", "diagnosis of 120 s, whole catalogue, warm", "3 s",
     lambda r: "; ".join(f"{name}: {_both(t)}" for name, t in r["times"].items())),
    ("commands", "... whole command, from its start", "3 s",
     lambda r: _both(r["times"]["quadid diagnose, 120 s MCAP"])),
    ("refits", "warm refit of a 10 s window", "250 ms",
     lambda r: "{wall:.0f} ms ({processor:.0f} ms)".format(
         **{c: 1e3 * r["times"]["warm, one second later"][c] for c in ("wall", "processor")})),
    ("memory", "peak memory, 500 s", "400 MB", lambda r: f"{r['peak_mb']:.0f} MB"),
    ("help", "quadid --help", "0.3 s", lambda r: f"{r['times']['quadid --help']['wall']:.2f} s"),
    ("starts", "second start to first fit", "1.5 s",
     lambda r: _both(r["times"]["second start to first fit"])),
)  # fmt: skip


def _seconds(r: Result, method: str) -> float:
    return float(r["methods"][method]["seconds"])


def _range(r: Result, gain: str) -> str:
    """Smallest and largest ratio of several sets and swarms."""
    gains = [o[gain] for o in r["rows"]]
    return f"{min(gains):.0f} to {max(gains):.0f} times"


def _both(t: Result) -> str:
    """Time by the clock and, in brackets, of the processor."""
    return f"{t['wall']:.1f} s ({t['processor']:.1f} s)"


def goals(results: Result) -> list[str]:
    """Lines of a table: what, what was wanted, what was measured; only of parts that were measured."""
    rows = [f"| {what} | {wanted} | {told(results[part])} |" for part, what, wanted, told in GOALS if part in results]
    return ["| what | wanted | measured |", "|---|---|---|", *rows, ""]
