"""Measures the online service and writes `online.json` (every number) and `online.md` (for people).

    python -m quadid_evaluation.benchmarks.online --out docs/results
    python -m quadid_evaluation.benchmarks.online --only load --out docs/results     # one part anew, the others as they
    are

Parts: estimate, change, hover, repeat, refit, load and costs (these need the ROS extra), memory.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from quadid_evaluation.benchmarks.online import accuracy, load, memory, repeat
from quadid_evaluation.benchmarks.online.own_code import own_code
from quadid_evaluation.benchmarks.online.page import page


def parts(given: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """What can be measured."""
    return {
        "estimate": lambda: accuracy.against_batch(range(given.flights)),
        "change": lambda: accuracy.mass_changes(range(given.flights)),
        "hover": lambda: {**accuracy.hover(600.0, range(3)), "after_flight": accuracy.hover_after_flight(600.0, 3)},
        "repeat": lambda: repeat.repeatability(60.0, 1),
        "refit": lambda: memory.refits(120.0),
        "load": lambda: {
            "excited": load.under_load(given.load_seconds, "excited"),
            "hover": load.under_load(given.load_seconds, "hover"),
            "recording": load.under_load(given.load_seconds, "excited", record=True),
        },
        "costs": lambda: {**{w: load.bare(given.load_seconds, w) for w in load.WAYS}, "own": own_code(20.0)},
        "memory": lambda: memory.day(given.hours, given.refit, progress=True),
    }


def main() -> None:
    """Measures what was asked for."""
    parser = argparse.ArgumentParser(prog="python -m quadid_evaluation.benchmarks.online", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder of online.json and online.md")
    parser.add_argument("--only", nargs="*", default=[], help="parts to measure; default: all")
    parser.add_argument("--flights", type=int, default=40, help="flights of the accuracy parts")
    parser.add_argument("--hours", type=float, default=24.0, help="flight time of the memory part [h]")
    parser.add_argument("--refit", type=float, default=10.0, help="time between refits of the memory part [s]")
    parser.add_argument("--load-seconds", type=float, default=60.0, help="length of each flight of the load part [s]")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    known = parts(given)
    unknown = set(given.only) - set(known)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; use {', '.join(known)}")
    for name in given.only or known:
        begin = time.monotonic()
        measured = {"result": known[name](), "measured": time.strftime("%Y-%m-%d"), "machine": machine()}
        measured["took_seconds"] = round(time.monotonic() - begin, 1)
        file = given.out / "online.json"  # read again each time: parts may be measured side by side
        results = json.loads(file.read_text()) if file.exists() else {}
        results[name] = measured
        file.write_text(json.dumps(results, indent=1) + "\n")
        (given.out / "online.md").write_text(page(results))
        print(f"{name}: {measured['took_seconds']} s", flush=True)


def machine() -> str:
    """Processor, cores and how busy they were."""
    info = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in info if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}"


if __name__ == "__main__":
    main()
