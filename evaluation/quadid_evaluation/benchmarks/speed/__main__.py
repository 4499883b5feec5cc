"""Speed of the kernel, the searches and the commands, beside peers and the processor's peak, in one run.

    python -m quadid_evaluation.benchmarks.speed --out docs/results

All cases of a table are run in turn, round by round, and told as medians: on a busy machine absolute times grow, ratios
stay.  Processor time (both cores together) stands beside wall time, the load average beside each table.
`--parts peers,starts` measures only those, and what the machine could do at best, and keeps the rest of an earlier run.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from quadid_evaluation.benchmarks.speed import peers, whole
from quadid_evaluation.benchmarks.speed.assembly import instructions
from quadid_evaluation.benchmarks.speed.cases import effect_table, kernel_table
from quadid_evaluation.benchmarks.speed.limits import limits
from quadid_evaluation.benchmarks.speed.page import page
from quadid_evaluation.benchmarks.speed.plots import draw
from quadid_evaluation.benchmarks.speed.timing import machine


def parts(rounds: int, longest: int, folder: Path) -> dict[str, Callable[[], dict[str, Any]]]:
    """What can be measured, in the order of the page."""
    few = max(rounds // 2, 1)
    return {
        "limits": lambda: limits(rounds, folder),
        "kernel": lambda: kernel_table(rounds),
        "effects": lambda: effect_table(rounds),
        "instructions": instructions,
        "objectives": lambda: peers.objectives(rounds),
        "peers": lambda: peers.swarms(few),
        "optimum": lambda: peers.time_to_optimum(rounds),
        "identification": lambda: whole.identification(rounds),
        "diagnoses": lambda: whole.diagnoses(few),
        "refits": lambda: whole.refits(3 * rounds),
        "help": lambda: whole.sayings(rounds),
        "commands": lambda: whole.commands(few, folder),
        "starts": lambda: whole.starts(rounds, folder),
        "memory": lambda: whole.memory(folder),
        "logs": lambda: whole.logs(rounds, folder),
        "size": lambda: whole.particles_and_parameters(rounds),
        "scaling": lambda: whole.scaling(folder, longest),
    }


def main() -> None:
    """Measures, prints progress, writes page, pictures and JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for speed.json, speed.md and speed-scaling.png")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--parts", default="", help="comma-separated; all by default")
    parser.add_argument("--longest", type=int, default=100, help="longest log of the scaling, in flights of 360 s")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / "speed.json"
    known = json.loads(target.read_text(encoding="utf-8")) if target.exists() else {}
    results: dict[str, Any] = {"schema": "quadid.benchmark.speed/1", **known}
    with tempfile.TemporaryDirectory() as folder:
        all_parts = parts(options.rounds, options.longest, Path(folder))
        for name in ["limits", *options.parts.split(",")] if options.parts else all_parts:
            begin = time.perf_counter()
            results[name] = {"machine": machine(), "rounds": options.rounds, **all_parts[name]()}
            target.write_text(whole.written(results), encoding="utf-8")
            print(f"{name}: measured in {time.perf_counter() - begin:.0f} s", flush=True)
    draw(results, options.out)
    (options.out / "speed.md").write_text(page(results), encoding="utf-8")


if __name__ == "__main__":
    main()
