"""What was wanted of the speed, and what was measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from quadid_evaluation.benchmarks.speed import bounds

Result = Mapping[str, Any]

GOALS: tuple[tuple[str, str, str, Callable[[Result], str], Callable[[Result], str]], ...] = (
    ("kernel", "share of the processor's peak", "40 %", lambda r: f"{r['share_of_peak']:.0%}",
     lambda all: "100 %"),
    ("effects", "any one effect against nominal", "3 times",
     lambda r: f"{min(r['ratios'].values()):.1f} to {max(r['ratios'].values()):.1f} times",
     lambda all: "1 time"),
    ("kernel", "every effect at once against nominal", "3 times", lambda r: f"{r['every_over_nominal']:.1f} times",
     lambda all: "1 time"),
    ("objectives", "NumPy over particles against ours, per core", "60 times",
     lambda r: _range(_gains(r, "gain_particles")),
     lambda all: bounds.at_peak(all, _gains(all["objectives"], "gain_particles"))),
    ("objectives", "... over particles and segments", "60 times", lambda r: _range(_gains(r, "gain")),
     lambda all: bounds.at_peak(all, _gains(all["objectives"], "gain"))),
    ("peers", "pyswarms with NumPy over particles, wall time", "50 times",
     lambda r: f"{r['gain_particles']:.0f} times", lambda all: bounds.at_peak(all, [all["peers"]["gain_particles"]])),
    ("peers", "... over particles and segments", "50 times", lambda r: f"{r['gain']:.0f} times",
     lambda all: bounds.at_peak(all, [all["peers"]["gain"]])),
    ("optimum", "swarm and polish against least squares", "3 times",
     lambda r: f"{_seconds(r, 'pso_polish') / _seconds(r, 'least_squares'):.1f} times",
     lambda all: "1 time"),
    ("optimum", "swarm and polish against CMA-ES", "1 time",
     lambda r: f"{_seconds(r, 'pso_polish') / _seconds(r, 'cma_es'):.1f} times",
     lambda all: "{:.2f} times".format(
         _seconds(all["optimum"], "least_squares") / _seconds(all["optimum"], "cma_es"))),
    ("identification", "500 s, 64 x 100, polish, intervals", "2 s",
     lambda r: _both(r["times"]["64 x 100, polish, intervals"]),
     lambda all: _busy(all["identification"], "64 x 100, polish, intervals")),
    ("diagnoses", "diagnosis of 120 s, whole catalogue, warm", "3 s",
     lambda r: "; ".join(f"{name}: {_both(t)}" for name, t in r["times"].items()),
     lambda all: "; ".join(_busy(all["diagnoses"], name) for name in all["diagnoses"]["times"])),
    ("commands", "... whole command, from its start", "3 s",
     lambda r: _command(r, "quadid diagnose, 120 s MCAP"),
     lambda all: bounds.started(all, all["commands"].get("megabytes", {}).get("quadid diagnose, 120 s MCAP", 0.0))),
    ("commands", "quadid identify of 60 s, after installation", "2 s",
     lambda r: _command(r, "quadid identify, 60 s MCAP"),
     lambda all: bounds.started(all, all["commands"].get("megabytes", {}).get("quadid identify, 60 s MCAP", 0.0))),
    ("refits", "warm refit of a 10 s window", "250 ms",
     lambda r: "{wall:.0f} ms ({processor:.0f} ms)".format(
         **{c: 1e3 * r["times"]["warm, one second later"][c] for c in ("wall", "processor")}),
     lambda all: _busy(all["refits"], "warm, one second later")),
    ("memory", "peak memory, 500 s", "400 MB", lambda r: f"{r['peak_mb']:.0f} MB",
     lambda all: bounds.held(all, 25000.0)),
    ("scaling", "peak memory of a fit, longest log", "600 MB", lambda r: f"{r['runs'][-1]['peak_mb']:.0f} MB",
     lambda all: bounds.held(all, all["scaling"]["runs"][-1]["rows"])),
    ("logs", "MCAP against mcap's reader without decoding", "1 time",
     lambda r: _faster(r, ".mcap", "mcap, bytes only"), lambda all: _disk(all, ".mcap, mcap, bytes only")),
    ("logs", "tlog against pymavlink", "1 time", lambda r: _faster(r, ".tlog", "pymavlink"),
     lambda all: _disk(all, ".tlog, pymavlink")),
    ("help", "quadid --help", "0.3 s", lambda r: f"{r['times']['quadid --help']['wall']:.2f} s", bounds.started),
    ("starts", "first quadid identify of 60 s, nothing compiled", "20 s",
     lambda r: _both(r["times"]["first quadid identify, 60 s MCAP"]) if "first quadid identify, 60 s MCAP" in r["times"]
     else "–",
     lambda all: "{python_start:.2f} s".format(**all["limits"])),
    ("starts", "second start to first fit", "1.5 s",
     lambda r: _both(r["times"]["second start to first fit"]),
     lambda all: "{wall:.2f} s".format(**all["starts"]["times"]["import of the fit"])),
)  # fmt: skip
"""Part, what, what was wanted, what was measured of the part, and of all parts what bounds it on this machine."""


def _seconds(r: Result, method: str) -> float:
    return float(r["methods"][method]["seconds"])


def _busy(r: Result, case: str) -> str:
    return bounds.busy(r["times"][case], r["machine"]["cores"])


def _gains(r: Result, gain: str) -> list[float]:
    """A ratio, of several sets and swarms."""
    return [row[gain] for row in r["rows"]]


def _range(gains: list[float]) -> str:
    return f"{min(gains):.0f} to {max(gains):.0f} times"


def _faster(r: Result, suffix: str, library: str) -> str:
    """How often our reading, all processor time counted, goes into that of a library."""
    times = r["times"]
    other = times.get(f"{suffix}, {library}")
    return bounds.NOTHING if other is None else (
        f"{other['processor'] / times[f'{suffix}, quadid']['processor']:.1f} times faster"
    )  # fmt: skip


def _disk(results: Result, name: str) -> str:
    """The same ratio if we took no longer than the disk and the hash that names a log."""
    found, t = results.get("limits"), results["logs"]["times"].get(name)
    if found is None or t is None:
        return bounds.NOTHING
    least = 1e6 * t["megabytes"] * (1.0 / found["disk_read"] + 1.0 / found["sha256"])
    return f"{t['processor'] / least:.0f} times"


def _both(t: Result) -> str:
    """Time by the clock and, in brackets, of the processor."""
    return f"{t['wall']:.1f} s ({t['processor']:.1f} s)"


def _command(r: Result, name: str) -> str:
    """Of a command, where it was among those that were measured last."""
    return _both(r["times"][name]) if name in r["times"] else bounds.NOTHING


def goals(results: Result) -> list[str]:
    """Lines of a table: what, wanted, measured, limit of this machine; only of parts that were measured."""
    rows = [
        f"| {what} | {wanted} | {told(results[part])} | {limit(results)} |"
        for part, what, wanted, told, limit in GOALS
        if part in results
    ]
    return ["| what | wanted | measured | limit |", "|---|---|---|---|", *rows, ""]
