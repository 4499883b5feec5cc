"""The measured speeds as a page for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.speed.goals import goals

Result = Mapping[str, Any]
_STEP_OPERATIONS = 190
"""Arithmetic of one nominal step and particle; see `benchmarks.kernel.NOMINAL_OPERATIONS`."""

INTRODUCTION = (
    "Cases of a table run in turn, round by round; medians, quartiles in brackets. Other programs share the machine, "
    "so ratios within a table mean more than its seconds; processor time, in the first table in brackets, is that of "
    "all threads and child processes, and grows too where programs share caches. Below every table stands when it was "
    "measured and how busy the machine was. Every number is in `speed.json`."
)


def page(results: Result) -> str:
    """Markdown of all parts that were measured."""
    out = [
        "# Speed",
        "",
        "`make bench`, that is `python -m benchmarks.speed --out docs/results`",
        "",
        INTRODUCTION,
        "",
        *goals(results),
    ]
    for name, (title, write) in PARTS.items():
        found = results.get(name)
        out += [f"## {title}", ""]
        if found is None:
            out += ["Not measured.", ""]
            continue
        out += [*write(found), "", f"_{found['rounds']} rounds; {_machine(found['machine'])}_", ""]
    return "\n".join(out)


def _machine(m: Result) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in m["versions"].items())
    return f"{m['date']}; {m['processor']}, {m['cores']} cores, load {m['load']:.1f}; Python {m['python']}, {versions}"


def _times(found: Result, extra: Callable[[str, Result], str] | None = None, head: str = "") -> list[str]:
    rows = [f"| what | wall [s] | processor [s] |{head}", "|---|---|---|" + "---|" * head.count("|")]
    for name, t in found["times"].items():
        low, high = t["wall_quartiles"]
        more = extra(name, t) if extra else ""
        rows.append(f"| {name} | {t['wall']:.3g} ({low:.3g} … {high:.3g}) | {t['processor']:.3g} |{more}")
    return rows


def _kernel(r: Result) -> list[str]:
    rows = [
        "| nanoseconds per particle and step | one core, best | quartiles | both cores, best |",
        "|---|---|---|---|",
    ]
    for t in r["timings"]:
        one, both = t["one_core"], t["all_cores"]
        rows.append(
            f"| {t['name']} | {one['least']:.1f} | {one['low']:.1f} … {one['high']:.1f} | {both['least']:.1f} |"
        )
    rows += [f"| {name} | {t['least']:.0f} | {t['low']:.0f} … {t['high']:.0f} | |" for name, t in r["numpy"].items()]
    return [
        "Short runs, spread over the whole measurement: processor time on one core, time by the clock on both. Other "
        "programs only ever add to a run, so the best is what the kernel takes, and quartiles say how busy the machine "
        "was.", "",
        *rows, "",
        f"Measured peak of one core: {r['fma_per_ns']:.1f} fused multiply-adds of float64 per ns. The nominal rollout "
        f"does {r['operations']} operations a step, which is {r['share_of_peak']:.0%} of that peak. The same step in "
        f"NumPy at its best takes {r['gain_over_numpy']:.0f} times as long; rotor drag takes "
        f"{r['extended_over_nominal']:.1f} times the nominal, every effect {r['every_over_nominal']:.1f} times. All in "
        "float64.",
    ]  # fmt: skip


def _effects(r: Result) -> list[str]:
    rows = ["| effect alone | ns per particle and step | times the nominal |", "|---|---|---|"]
    for name, ratio in sorted(r["ratios"].items(), key=lambda item: -item[1]):
        rows.append(f"| {name} | {r['ns'][name]:.1f} | {ratio:.2f} |")
    return [
        "The swarm's cost with one effect of the catalogue, of another size in every particle; best runs on one core. "
        f"The nominal takes {r['ns']['nominal']:.1f} ns, the median effect {r['median']:.1f} times that, the dearest, "
        f"{r['largest']}, {r['ratios'][r['largest']]:.1f} times. Wind alone, without drag, changes nothing.", "", *rows,
    ]  # fmt: skip


def _single(r: Result) -> list[str]:
    rows = ["| cost of | float64 [ns] | float32 [ns] | faster | largest difference |", "|---|---|---|---|---|"]
    for name, c in r["cases"].items():
        rows.append(f"| {name} | {c['double']:.1f} | {c['single']:.1f} | {c['gain']:.2f} times | {c['error']:.1e} |")
    compiled = sum(c["compile"] for c in r["cases"].values())
    return [
        f"The kernel's modules compiled once more in float32, {r['seconds']:g} s of flight, one core, best runs, per "
        "particle and step; the differences are relative and of costs.", "", *rows, "",
        "Single precision would hold: costs differ by far less than one parameter's uncertainty changes them. It is "
        f"not in use all the same: the swarm alone would gain, polish and screening need double precision, and a first "
        f"start would compile for {compiled:.0f} s more.",
    ]  # fmt: skip


def _instructions(r: Result) -> list[str]:
    rows = [
        "Machine code of one Runge-Kutta step for one vector of lanes (a loop over lanes without branches):", "",
        "| step | register [bit] | instructions | arithmetic | of it fused | moves | with memory operand "
        "| divisions, roots |", "|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, c in r["steps"].items():
        cells = (
            "register_bits",
            "instructions",
            "arithmetic",
            "fused",
            "moves",
            "memory_operands",
            "divisions_and_roots",
        )
        rows.append(f"| {name} | {' | '.join(str(c[key]) for key in cells)} |")
    return [
        *rows, "",
        "There is hardly any scalar work, and about half of the arithmetic is fused.",
    ]  # fmt: skip


def _pieces(r: Result) -> list[str]:
    ns, peak = r["ns"], r["fma_per_ns"]
    rows = ["| piece | ns per particle |", "|---|---|", *(f"| {name} | {t:.1f} |" for name, t in ns.items())]
    return [
        "Each piece of the kernel alone, in a loop over data that stay in the first cache; best runs on one core.", "",
        *rows, "",
        f"The peak of the same run was {peak:.1f} operations per ns: the nominal step alone keeps "
        f"{_STEP_OPERATIONS / ns['nominal step'] / peak:.0%} of it busy. A rollout takes longer than its pieces; that "
        "its data (moments, measurements, weights, projections) come from the second cache is the likely reason.", "",
        "Kept, because it won: attitudes looked up for all lanes at once where they look back alike; shared rotor "
        "moments read inside the nominal step; steps compiled for groups of effects (the body alone, rotor drag, each "
        "with what is rare), with parameter vectors that need the same put into one block of lanes; rotors that begin "
        "anew before a late segment. Dropped: whitening one column as a product of two matrices (no gain). Not tried: "
        "two vectors of lanes interleaved by hand, a kernel for every single set of effects (each costs seconds to "
        "compile).",
    ]  # fmt: skip


def _objectives(r: Result) -> list[str]:
    rows = [
        "| segments | particles | kernel [ms] | NumPy over particles [ms] | / kernel "
        "| NumPy over particles and segments [ms] | / kernel |",
        "|---|---|---|---|---|---|---|",
    ]
    rows += [
        f"| {o['segments']} | {o['particles']} | {1e3 * o['kernel']:.2f} | {1e3 * o['numpy_particles']:.0f} "
        f"| {o['gain_particles']:.0f} | {1e3 * o['numpy']:.0f} | {o['gain']:.0f} |"
        for o in r["rows"]
    ]
    return [
        "One evaluation of the whole cost of a set (simulation, residual, weights, projection) of all particles; "
        "processor time of all threads, thus per core. Objectives for swarms are usually vectorised over particles; "
        "over the segments of multiple shooting as well, arrays are long enough for NumPy to be at its best.", "",
        *rows,
    ]  # fmt: skip


def _peers(r: Result) -> list[str]:
    return [
        f"{r['particles']} particles, {r['evaluations']} evaluations over all {r['samples']} samples; the NumPy "
        f"objective is the same simulation, weights and projection (costs agree to "
        f"{max(abs(1.0 - c) for c in r['cost_ratio']):.1e}).", "",
        *_times(r, lambda n, t: f" {t['ms_per_evaluation']:.3g} |", " ms per evaluation |"), "",
        f"pyswarms takes {r['gain_particles']:.0f} times as long for the same number of evaluations where the NumPy "
        f"objective is vectorised over particles (processor time: {r['gain_particles_processor']:.0f} times), "
        f"{r['gain']:.0f} times where over segments too ({r['gain_processor']:.0f} times).",
    ]  # fmt: skip


def _optimum(r: Result) -> list[str]:
    rows = [
        f"Six parameters, 400 short segments of 500 s, {r['seeds']} random starts in the bounds, the same kernel "
        "for all; until the cost is within 0.1 % of the optimum.", "",
        "| method | reached | seconds | evaluations |", "|---|---|---|---|",
    ]  # fmt: skip
    for name, m in r["methods"].items():
        if m["reached"]:
            low, high = m["quartiles"]
            told = f"{m['seconds']:.2f} ({low:.2f} … {high:.2f}) | {m['evaluations']:.0f}"
        else:
            told = "– | –"
        rows.append(f"| {name} | {m['reached']}/{r['seeds']} | {told} |")
    return rows


def _identification(r: Result) -> list[str]:
    return ["500 s at 50 Hz, warm.", "", *_times(r, lambda n, t: f" {r['evaluations'][n]} |", " evaluations |")]


def _diagnoses(r: Result) -> list[str]:
    found = {n: ", ".join(names) or "nothing" for n, names in r["found"].items()}
    return ["Warm, in one process, the whole catalogue.", "", *_times(r, lambda n, t: f" {found[n]} |", " found |")]


def _starts(r: Result) -> list[str]:
    first = r["first"]
    return [
        "Processes of their own, from their start to the end of a first fit of 10 s of flight.", "", *_times(r), "",
        f"Very first start, which compiles every kernel: {first['wall']:.0f} s ({first['processor']:.0f} s of "
        "processor time).",
    ]  # fmt: skip


def _memory(r: Result) -> list[str]:
    return [f"`quadid identify` of a 500 s MCAP: peak {r['peak_mb']:.0f} MB."]


def _logs(r: Result) -> list[str]:
    def more(name: str, t: Result) -> str:
        return f" {t['megabytes']:.1f} | {t['ms_per_mb']:.0f} |"

    return [
        "500 s of the simulated Pelican as MCAP, tlog and CSV; the largest recorded DataFlash and ULog where "
        "`QUADID_DATA` names recorded flights.", "", *_times(r, more, " MB | ms per MB |"),
    ]  # fmt: skip


def _size(r: Result) -> list[str]:
    return [f"{r['seconds']:g} s of flight in segments of 0.2 s.", "", *_times(r), "", "![](speed-size.png)"]


def _scaling(r: Result) -> list[str]:
    rows = ["| hours of flight at 50 Hz | fit, wall [s] | processor [s] | peak memory [MB] |", "|---|---|---|---|"]
    for hours, run in zip(r["hours"], r["runs"], strict=True):
        rows.append(f"| {hours:.1f} | {run['fit']:.1f} | {run['fit_processor']:.1f} | {run['peak_mb']:.0f} |")
    e = r["exponents"]
    return [
        *rows, "",
        f"Processor time grows with the {e['fit_processor']:.2f}th power of the length, memory with the "
        f"{e['peak_mb']:.2f}th: of more than an hour a fit takes stretches spread evenly (`identify/long_logs.py`); "
        "what grows beyond that are the windows themselves, 0.1 kB a sample.", "",
        "![](speed-scaling.png)",
    ]  # fmt: skip


PARTS: dict[str, tuple[str, Callable[[Result], list[str]]]] = {
    "kernel": ("The kernel", _kernel),
    "effects": ("Each effect alone", _effects),
    "single": ("Single precision", _single),
    "instructions": ("What limits it", _instructions),
    "pieces": ("Pieces of a step", _pieces),
    "objectives": ("One evaluation, beside NumPy", _objectives),
    "peers": ("Particle swarms", _peers),
    "optimum": ("Time to the optimum", _optimum),
    "identification": ("Identification of a 500 s set", _identification),
    "diagnoses": ("Diagnosis of 120 s", _diagnoses),
    "refits": ("Refit of a 10 s window", _times),
    "help": ("Commands that say something at once", _times),
    "commands": ("Commands", _times),
    "starts": ("Start-up", _starts),
    "memory": ("Memory", _memory),
    "logs": ("Reading of logs", _logs),
    "size": ("Particles, parameters, windows", _size),
    "scaling": ("Length of the log", _scaling),
}
