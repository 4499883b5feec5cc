"""Interleaved timing: every round runs each case once, so that a busy machine is busy for all of them."""

import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from quadid_evaluation.harness import QUADID

LIBRARIES = ("numpy", "numba", "scipy")


@dataclass
class Times:
    """Wall and processor seconds of every run of a case."""

    wall: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Medians, quartiles and number of runs."""
        low, middle, high = np.percentile(self.wall, [25, 50, 75])
        return {
            "wall": middle,
            "wall_quartiles": [low, high],
            "processor": float(np.median(self.processor)),
            "processor_least": min(self.processor),
            "runs": len(self.wall),
        }


def interleaved(cases: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, dict[str, Any]]:
    """Runs every case once, to warm up, and then in turn; returns the summary of each."""
    found = {name: Times() for name in cases}
    for turn in range(rounds + 1):
        for name, run in cases.items():
            wall, processor = time.perf_counter(), processor_seconds()
            run()
            if turn:
                found[name].wall.append(time.perf_counter() - wall)
                found[name].processor.append(processor_seconds() - processor)
    return {name: times.summary() for name, times in found.items()}


def processor_seconds() -> float:
    """Processor time of this process and of its children, also those that still live, as readers of logs do [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    living = [pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()]
    stats = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in living]
    ticks = sum(int(number) for fields in stats for number in fields[11:15])
    return sum(u.ru_utime + u.ru_stime for u in used) + ticks / os.sysconf("SC_CLK_TCK")


def child(code: str, *arguments: str, environment: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Runs Python code in a process of its own; returns its JSON line with wall, processor time and peak memory [MB].

    Whoever starts a process lends it its own peak memory on Linux, so the peak is that of the child's own status.
    """
    wrapped = code + (
        "\nprint('PEAK', [line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')][0])\n"
    )
    wall, processor = time.perf_counter(), processor_seconds()
    done = subprocess.run(
        [sys.executable, "-c", wrapped, *arguments],
        capture_output=True,
        text=True,
        check=True,
        env={**_surroundings(), **(environment or {})},
    )
    lines = done.stdout.splitlines()
    told = json.loads(lines[-2]) if len(lines) > 1 else {}
    spent = {"wall": time.perf_counter() - wall, "processor": processor_seconds() - processor}
    return {**told, **spent, "peak_mb": int(lines[-1].split()[1]) / 1024.0}


def command(*arguments: str, environment: Mapping[str, str] | None = None) -> None:
    """Runs `quadid` in a process of its own, quietly."""
    with tempfile.TemporaryFile() as nothing:
        subprocess.run(
            [QUADID, *arguments],
            stdout=nothing,
            stderr=nothing,
            check=True,
            env={**_surroundings(), **(environment or {})},
        )


def _surroundings() -> dict[str, str]:
    """Environment of a started process: that of a user, where Python keeps what it has compiled."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def machine() -> dict[str, Any]:
    """Processor, versions, date and load."""
    cpu = next((line.split(":")[1].strip() for line in _cpu_lines() if line.startswith("model name")), "unknown")
    return {
        "processor": cpu,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in LIBRARIES},
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "load": os.getloadavg()[0],
    }


def _cpu_lines() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []
