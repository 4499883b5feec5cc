"""The measured speeds as a page for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from quadid_evaluation.benchmarks.speed.bounds import SAMPLE_BYTES, machine_limits
from quadid_evaluation.benchmarks.speed.goals import goals

Result = Mapping[str, Any]
SHOWN = ("nominal, cost", "motor lag, one a particle, cost", "rotor drag, cost", "every effect, cost")
"""Cases of the kernel in the table."""
INTRODUCTION = (
    "Medians of interleaved runs; compare ratios, since other programs share the machine. In brackets: processor time "
    "of all threads and child processes. `speed.json` has every value."
)


def page(results: Result) -> str:
    """Markdown of the goals, and of the parts of `PARTS` that were measured."""
    out = [
        "# Speed",
        "",
        "`make bench`, that is `python -m quadid_evaluation.benchmarks.speed --out docs/results`",
        "",
        INTRODUCTION,
        "",
    ]
    shown = [name for name in PARTS if name in results]
    out += [*goals(results), *([_machine(results[shown[0]]["machine"]), ""] if shown else [])]
    for name in shown:
        title, write = PARTS[name]
        out += [f"## {title}", "", *write(results[name]), ""]
        if results[name]["machine"] != results[shown[0]]["machine"]:
            out += [_measured(results[name]["machine"]), ""]
    return "\n".join(out)


def _machine(m: Result) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in m["versions"].items())
    return f"{m['date']}; {m['processor']}, {m['cores']} cores, load {m['load']:.1f}; Python {m['python']}, {versions}"


def _measured(m: Result) -> str:
    return f"Measured {m['date']}, load {m['load']:.1f}, {m['processor']}."


def _kernel(r: Result) -> list[str]:
    least = r["operations"] / r["fma_per_ns"]
    rows = [
        "| nanoseconds per particle and step | one core | both cores |",
        "|---|---|---|",
    ]
    for t in r["timings"]:
        one, both = t["one_core"], t["all_cores"]
        if t["name"] in SHOWN:
            rows.append(f"| {t['name']} | {one['least']:.1f} | {both['least']:.1f} |")
    return [
        "Best runs in float64: processor time on one core, wall time on both. The arithmetic of the nominal step "
        f"({r['operations']} operations) takes {least:.1f} ns at the peak of {r['fma_per_ns']:.1f} fused multiply-adds "
        f"per ns; NumPy at its best {r['gain_over_numpy']:.0f} times the nominal.", "", *rows,
    ]  # fmt: skip


def _scaling(r: Result) -> list[str]:
    rows = [
        "| hours of flight at 50 Hz | fit: wall, processor [s] | peak memory, windows alone [MB] |",
        "|---|---|---|",
    ]
    for hours, run in zip(r["hours"], r["runs"], strict=True):
        rows.append(
            f"| {hours:.1f} | {run['fit']:.1f}, {run['fit_processor']:.1f} | "
            f"{run['peak_mb']:.0f}, {1e-6 * run['rows'] * SAMPLE_BYTES:.0f} |"
        )
    e = r["exponents"]
    return [
        *rows, "",
        f"Exponents: processor time {e['fit_processor']:.2f}, memory {e['peak_mb']:.2f}. Of more than an hour, a fit "
        "uses stretches spread evenly (`quadid/identification/fit.py`).", "",
        "![](speed-scaling.png)",
    ]  # fmt: skip


def _logs(r: Result) -> list[str]:
    return [
        "A simulated log of 500 s, and the largest recorded ones. quadid reads, checks, hashes and puts all channels "
        "on one clock; large files in a process of their own.", "",
        "| what | wall [s] | ms of processor per MB |", "|---|---|---|",
        *(f"| {n} | {t['wall']:.3g} | {t['ms_per_mb']:.3g} |" for n, t in r["times"].items()),
    ]  # fmt: skip


PARTS: dict[str, tuple[str, Callable[[Result], list[str]]]] = {
    "limits": ("What the machine can do", machine_limits),
    "kernel": ("The kernel", _kernel),
    "logs": ("Reading of logs", _logs),
    "scaling": ("Length of the log", _scaling),
}
"""Parts that are shown."""
