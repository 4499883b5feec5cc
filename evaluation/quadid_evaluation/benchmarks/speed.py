"""Speed of the kernel, the searches and the commands, and the processor's peak, in one run.

    python -m quadid_evaluation.benchmarks.speed --out docs/results

All cases of a table are run in turn, round by round, and told as medians: on a busy machine absolute times grow, ratios
stay.  Processor time (both cores together) stands beside wall time, the load average beside each table.
`--parts kernel starts` measures only those, and keeps the rest of an earlier run; `--longest` is the longest log of the
scaling, in flights of 360 s.
"""

import json
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from quadid_evaluation.benchmarks import whole
from quadid_evaluation.benchmarks.kernel import effect_table, kernel_table, step_table
from quadid_evaluation.benchmarks.timing import machine
from quadid_evaluation.harness import Given, options, table

Result = Mapping[str, Any]

# --- What was wanted, and what was measured


Goal = tuple[str, str, str, Callable[[Result], str]]
GOALS: tuple[Goal, ...] = (
    ("kernel", "share of the processor's peak", "40 %", lambda r: f"{r['share_of_peak']:.0%}"),
    ("effects", "any one effect against nominal", "3 times",
     lambda r: f"{min(r['ratios'].values()):.1f} to {max(r['ratios'].values()):.1f} times"),
    ("kernel", "every effect at once against nominal", "3 times", lambda r: f"{r['every_over_nominal']:.1f} times"),
    ("identification", "500 s, 64 x 100, polish, intervals", "5 s",
     lambda r: _both(r["times"]["64 x 100, polish, intervals"])),
    ("diagnoses", "diagnosis of 120 s, whole catalogue, warm", "6 s",
     lambda r: "; ".join(f"{name}: {_both(t)}" for name, t in r["times"].items())),
    ("commands", "... whole command, from its start", "3 s", lambda r: _of(r, "quadid diagnose, 120 s MCAP")),
    ("commands", "quadid identify of 60 s, after installation", "2 s", lambda r: _of(r, "quadid identify, 60 s MCAP")),
    ("refits", "warm refit of a 10 s window", "150 ms",
     lambda r: "{wall:.0f} ms ({processor:.0f} ms)".format(
         **{c: 1e3 * r["times"]["warm, one second later"][c] for c in ("wall", "processor")})),
    ("memory", "peak memory, 500 s", "400 MB", lambda r: f"{r['peak_mb']:.0f} MB"),
    ("scaling", "peak memory of a fit, longest log", "600 MB", lambda r: f"{r['runs'][-1]['peak_mb']:.0f} MB"),
    ("logs", "MCAP against mcap's reader without decoding", "1 time",
     lambda r: _faster(r, ".mcap", "mcap, bytes only")),
    ("logs", "tlog against pymavlink", "1 time", lambda r: _faster(r, ".tlog", "pymavlink")),
    ("help", "quadid --help", "0.3 s", lambda r: f"{r['times']['quadid --help']['wall']:.2f} s"),
    ("starts", "first quadid identify of 60 s, nothing compiled", "20 s",
     lambda r: _of(r, "first quadid identify, 60 s MCAP")),
    ("starts", "second start to first fit", "1.5 s", lambda r: _both(r["times"]["second start to first fit"])),
)  # fmt: skip
"""Part, what, what was wanted, what was measured."""


def _faster(r: Result, suffix: str, library: str) -> str:
    """Ratio of a library's reading to ours, all processor time counted."""
    other = r["times"].get(f"{suffix}, {library}")
    ours = r["times"][f"{suffix}, quadid"]["processor"]
    return "–" if other is None else f"{other['processor'] / ours:.1f} times faster"


def _both(t: Result) -> str:
    """Time by the clock and, in brackets, of the processor."""
    return f"{t['wall']:.1f} s ({t['processor']:.1f} s)"


def _of(r: Result, name: str) -> str:
    """Of a command, where it was among those that were measured last."""
    return _both(r["times"][name]) if name in r["times"] else "–"


# --- The page


SAMPLE_BYTES = 144
"""Of one row of a window: four rotors, rates, attitude, force, references, in doubles."""


def _kernel(r: Result) -> list[str]:
    least = r["operations"] / r["fma_per_ns"]
    rows = [
        (t["name"], *(f"{t[cores]['least']:.1f}" for cores in ("one_core", "all_cores")))
        for t in r["timings"]
        if t["name"].endswith(", cost")
    ]
    return [
        "Best runs in float64: processor time on one core, wall time on both. The arithmetic of the nominal step "
        f"({r['operations']} operations) takes {least:.1f} ns at the peak of {r['fma_per_ns']:.1f} fused multiply-adds "
        f"per ns; NumPy at its best {r['gain_over_numpy']:.0f} times the nominal.",
        "",
        *table(("nanoseconds per particle and step", "one core", "both cores"), rows),
    ]


def _step(r: Result) -> list[str]:
    rows = [(name, f"{1e6 * t:.3g}") for name, t in r["times"].items()]
    absent = [f"Not installed: {', '.join(r['absent'])}.", ""] if r["absent"] else []
    return [*absent, *table(("one step on one core; without a name, of `quadid.Simulator`", "us"), rows)]


def _logs(r: Result) -> list[str]:
    return [
        "A simulated log of 500 s, and the largest recorded ones. quadid reads, checks, hashes and puts all channels "
        "on one clock; large files in a process of their own.",
        "",
        *table(
            ("what", "wall [s]", "ms of processor per MB"),
            [(n, f"{t['wall']:.3g}", f"{t['ms_per_mb']:.3g}") for n, t in r["times"].items()],
        ),
    ]


def _scaling(r: Result) -> list[str]:
    rows = [
        (
            f"{hours:.1f}",
            f"{run['fit']:.1f}, {run['fit_processor']:.1f}",
            f"{run['peak_mb']:.0f}, {1e-6 * run['rows'] * SAMPLE_BYTES:.0f}",
        )
        for hours, run in zip(r["hours"], r["runs"], strict=True)
    ]
    heads = ("hours of flight at 50 Hz", "fit: wall, processor [s]", "peak memory, windows alone [MB]")
    e = r["exponents"]
    return [
        *table(heads, rows),
        "",
        f"Exponents: processor time {e['fit_processor']:.2f}, memory {e['peak_mb']:.2f}. Of more than an hour, a fit "
        "uses stretches spread evenly (`quadid/identification/fit.py`).",
        "",
        "![](speed-scaling.png)",
    ]


SHOWN: dict[str, tuple[str, Callable[[Result], list[str]]]] = {
    "kernel": ("The kernel", _kernel),
    "step": ("One step", _step),
    "logs": ("Reading of logs", _logs),
    "scaling": ("Length of the log", _scaling),
}
"""Parts with a section of their own."""
PARTS: dict[str, Callable[[Given, Path], dict[str, Any]]] = {
    "kernel": lambda g, folder: kernel_table(g.rounds),
    "effects": lambda g, folder: effect_table(g.rounds),
    "step": lambda g, folder: step_table(),
    "identification": lambda g, folder: whole.identification(g.rounds),
    "diagnoses": lambda g, folder: whole.diagnoses(max(g.rounds // 2, 1)),
    "refits": lambda g, folder: whole.refits(3 * g.rounds),
    "help": lambda g, folder: whole.sayings(g.rounds),
    "commands": lambda g, folder: whole.commands(max(g.rounds // 2, 1), folder),
    "starts": lambda g, folder: whole.starts(g.rounds, folder),
    "memory": lambda g, folder: whole.memory(folder),
    "logs": lambda g, folder: whole.logs(g.rounds, folder),
    "scaling": lambda g, folder: whole.scaling(folder, g.longest),
}
"""Measurements, in order; the folder is for logs."""


def page(results: Result) -> str:
    """Markdown: what was wanted beside what was measured, then the parts of `SHOWN`; only of what was measured."""
    rows = [(what, wanted, told(results[part])) for part, what, wanted, told in GOALS if part in results]
    out = [
        "# Speed",
        "",
        "`make bench`, that is `python -m quadid_evaluation.benchmarks.speed --out docs/results`",
        "",
        "Medians of interleaved runs; compare ratios, since other programs share the machine. In brackets: processor "
        "time of all threads and child processes. `speed.json` has every value.",
        "",
        *table(("what", "wanted", "measured"), rows),
        "",
    ]
    first: Result = {}
    for name, (title, write) in SHOWN.items():
        if name not in results:
            continue
        m, end = results[name]["machine"], list[str]()
        versions = ", ".join(f"{library} {number}" for library, number in m["versions"].items())
        where = f"{m['processor']}, {m['cores']} cores, load {m['load']:.1f}; Python {m['python']}, {versions}"
        if not first:
            first, out = m, [*out, f"{m['date']}; {where}", ""]
        elif m != first:
            end = [f"Measured {m['date']}, load {m['load']:.1f}, {m['processor']}.", ""]
        out += [f"## {title}", "", *write(results[name]), "", *end]
    return "\n".join(out)


def draw_scaling(r: Result, path: Path) -> None:
    """Time and memory of a fit over the length of the log."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    labels = {"fit_processor": "processor time of a fit [s]", "peak_mb": "peak memory [MB]"}
    for axis, (key, label) in zip(axes, labels.items(), strict=True):
        axis.loglog(r["hours"], [run[key] for run in r["runs"]], "o-")
        axis.set(xlabel="hours of flight at 50 Hz", ylabel=label, title=f"exponent {r['exponents'][key]:.2f}")
        axis.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    given = options(__doc__, PARTS, rounds=5, longest=100)
    target = (given.out or Path("docs/results")) / "speed.json"
    known = json.loads(target.read_text(encoding="utf-8")) if target.exists() else {}
    results: dict[str, Any] = {"schema": "quadid.benchmark.speed/1", **known}
    with tempfile.TemporaryDirectory() as folder:
        for name in given.parts:
            begin = time.perf_counter()
            results[name] = {"machine": machine(), "rounds": given.rounds, **PARTS[name](given, Path(folder))}
            print(f"{name}: measured in {time.perf_counter() - begin:.0f} s", flush=True)
            told = SHOWN[name][1](results[name]) if name in SHOWN else [json.dumps(results[name], indent=1)]
            print(*told, sep="\n", flush=True)
            if given.out is not None:
                target.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    if given.out is not None:
        if "scaling" in results:
            draw_scaling(results["scaling"], given.out / "speed-scaling.png")
        (given.out / "speed.md").write_text(page(results), encoding="utf-8")
