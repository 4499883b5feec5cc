"""The measured speeds as a page for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.speed.bounds import SAMPLE_BYTES, machine_limits
from benchmarks.speed.goals import goals

Result = Mapping[str, Any]
SHOWN = ("nominal, cost", "motor lag, one a particle, cost", "rotor drag, cost", "every effect, cost")
"""Cases of the kernel in the table."""
INTRODUCTION = (
    "Medians of interleaved runs; compare ratios, since other programs share the machine. Processor time (in brackets "
    "in the first table) is that of all threads and child processes. `speed.json` has every value."
)


def page(results: Result) -> str:
    """Markdown of the goals, and of the parts of `PARTS` that were measured."""
    out = ["# Speed", "", "`make bench`, that is `python -m benchmarks.speed --out docs/results`", "", INTRODUCTION, ""]
    shown = [name for name in PARTS if name in results]
    out += [*goals(results), *([_machine(results[shown[0]]["machine"]), ""] if shown else [])]
    for name in shown:
        title, write = PARTS[name]
        out += [f"## {title}", "", *write(results[name]), ""]
    return "\n".join(out)


def _machine(m: Result) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in m["versions"].items())
    return f"{m['date']}; {m['processor']}, {m['cores']} cores, load {m['load']:.1f}; Python {m['python']}, {versions}"


def _times(found: Result) -> list[str]:
    rows = ["| what | wall [s] | processor [s] |", "|---|---|---|"]
    for name, t in found["times"].items():
        rows.append(f"| {name} | {t['wall']:.3g} | {t['processor']:.3g} |")
    return rows


def _kernel(r: Result) -> list[str]:
    least = r["operations"] / r["fma_per_ns"]
    rows = [
        "| nanoseconds per particle and step | one core | limit | both cores | limit |",
        "|---|---|---|---|---|",
    ]
    for t in r["timings"]:
        one, both = t["one_core"], t["all_cores"]
        if t["name"] in SHOWN:
            bound = "" if t["name"].startswith("nominal") else "> "
            rows.append(
                f"| {t['name']} | {one['least']:.1f} | {bound}{least:.1f} | {both['least']:.1f} | "
                f"{bound}{least / r['machine']['cores']:.1f} |"
            )
    rows += [f"| {name} | {t['least']:.0f} | {least:.1f} | | |" for name, t in r["numpy"].items()]
    return [
        "Best runs in float64: processor time on one core, wall time on both. The limit is the arithmetic of the "
        f"nominal step ({r['operations']} operations) at the peak of {r['fma_per_ns']:.1f} fused "
        "multiply-adds per ns and core.", "", *rows,
    ]  # fmt: skip


def _optimum(r: Result) -> list[str]:
    rows = [
        f"Six parameters, 400 short segments of 500 s, {r['seeds']} random starts, the same kernel for all; until the "
        "cost is within 0.1 % of the optimum.", "",
        "| method | reached | seconds | evaluations |", "|---|---|---|---|",
    ]  # fmt: skip
    for name, m in r["methods"].items():
        if m["reached"]:
            told = f"{m['seconds']:.2f} | {m['evaluations']:.0f}"
        else:
            told = "– | –"
        rows.append(f"| {name} | {m['reached']}/{r['seeds']} | {told} |")
    return rows


def _scaling(r: Result) -> list[str]:
    rows = [
        "| hours of flight at 50 Hz | fit, wall [s] | processor [s] | peak memory [MB] | limit: windows alone [MB] |",
        "|---|---|---|---|---|",
    ]
    for hours, run in zip(r["hours"], r["runs"], strict=True):
        rows.append(
            f"| {hours:.1f} | {run['fit']:.1f} | {run['fit_processor']:.1f} | {run['peak_mb']:.0f} | "
            f"{1e-6 * run['rows'] * SAMPLE_BYTES:.0f} |"
        )
    e = r["exponents"]
    return [
        *rows, "",
        f"Exponents: processor time {e['fit_processor']:.2f}, memory {e['peak_mb']:.2f}. Of more than an hour, a fit "
        "uses stretches spread evenly (`quadid/identify/long_logs.py`).", "",
        "![](speed-scaling.png)",
    ]  # fmt: skip


def _logs(r: Result) -> list[str]:
    return [
        "A simulated log of 500 s, and the largest recorded ones. quadid reads, checks, hashes and puts all channels "
        "on one clock; large files in a process of their own.", "",
        "| what | wall [s] | processor [s] | ms of processor per MB |", "|---|---|---|---|",
        *(f"| {n} | {t['wall']:.3g} | {t['processor']:.3g} | {t['ms_per_mb']:.3g} |" for n, t in r["times"].items()),
    ]  # fmt: skip


PARTS: dict[str, tuple[str, Callable[[Result], list[str]]]] = {
    "limits": ("What the machine can do", machine_limits),
    "kernel": ("The kernel", _kernel),
    "optimum": ("Time to the optimum", _optimum),
    "commands": ("Commands", _times),
    "logs": ("Reading of logs", _logs),
    "scaling": ("Length of the log", _scaling),
}
"""Parts that are shown."""
