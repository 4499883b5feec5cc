"""Interleaved timing: every round runs each case once, so that a busy machine is busy for all of them."""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from quadid_evaluation.harness import QUADID

LIBRARIES = ("numpy", "numba", "scipy")


def interleaved(cases: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, dict[str, Any]]:
    """Runs every case once, to warm up, and then in turn.

    Returns:
        Of each case medians and quartiles of wall and processor seconds, and the number of runs.
    """
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in cases}
    for turn in range(rounds + 1):
        for name, run in cases.items():
            wall, processor = time.perf_counter(), processor_seconds()
            run()
            if turn:
                spent[name].append((time.perf_counter() - wall, processor_seconds() - processor))
    found = {}
    for name, times in spent.items():
        (low, _), (wall, processor), (high, _) = np.percentile(times, [25, 50, 75], axis=0).tolist()
        least = min(used for _, used in times)
        found[name] = {"wall": wall, "wall_quartiles": [low, high], "processor": processor}
        found[name] |= {"processor_least": least, "runs": len(times)}
    return found


def processor_seconds() -> float:
    """Processor time of this process and of its children, also those that still live, as readers of logs do [s]."""
    own = psutil.Process()
    used = [own.cpu_times(), *(child.cpu_times() for child in own.children())]
    return float(sum(t.user + t.system + t.children_user + t.children_system for t in used))


def child(code: str, *arguments: str, environment: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Runs Python code in a process of its own; returns its JSON line with wall, processor time and peak memory [MB].

    Whoever starts a process lends it its own peak memory on Linux, so the peak is that of the child's own status.
    """
    peak = "print('PEAK', [line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')][0])"
    wall, processor = time.perf_counter(), processor_seconds()
    said = _run([sys.executable, "-c", f"{code}\n{peak}\n", *arguments], environment)
    spent = {"wall": time.perf_counter() - wall, "processor": processor_seconds() - processor}
    *_, told, last = ["{}", *said.splitlines()]
    return {**json.loads(told), **spent, "peak_mb": int(last.split()[1]) / 1024.0}


def command(*arguments: str, environment: Mapping[str, str] | None = None) -> None:
    """Runs `quadid` in a process of its own, quietly."""
    _run([QUADID, *arguments], environment)


def _run(words: list[str], environment: Mapping[str, str] | None) -> str:
    """Runs a program in the environment of a user, where Python keeps what it has compiled; returns what it prints."""
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(words, capture_output=True, text=True, check=True, env={**variables, **(environment or {})})
    return done.stdout


def machine() -> dict[str, Any]:
    """Processor, versions, date and load."""
    about = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    return {
        "processor": next((line.split(":")[1].strip() for line in about if line.startswith("model name")), "unknown"),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in LIBRARIES},
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "load": os.getloadavg()[0],
    }
