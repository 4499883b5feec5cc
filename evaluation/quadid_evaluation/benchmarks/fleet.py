"""Many logs: how long `quadid fleet` takes, what its processes need, and what workers that are killed cost.

    python -m quadid_evaluation.benchmarks.fleet --logs 1000 --workers 1 2 --kills 0 20 [--out docs/results]

Flies a few vehicles, writes that many logs of 10 s of them, and runs the command over all, its start and its report
included; before it a plain loop in one process over some of them.  Workers are killed at random places of the run, one
at a time.  Beside the clock's time stands the processor time that parent and workers took, also those killed, which
other work on the machine hardly lengthens: logs per processor second beside those of the plain loop are the throughput
per core.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pickle
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from quadid_replay import write_mcap

from quadid.app.fleet import Job
from quadid.flight import fly
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.speed.timing import child

SECONDS = 10.0
FLOWN = 10
"""Different flights; more logs are the same at another date."""


class Run(NamedTuple):
    """One run over all logs: seconds of the clock and of processors, peak memory [MB], logs by outcome."""

    workers: int
    kills: int
    seconds: float
    parent_cpu: float
    worker_cpu: float
    parent_memory: float
    worker_memory: float
    outcomes: Counter[str]


HEAD = (
    "workers", "killed", "seconds", "logs/s", "speed-up", "processor of workers, s/log", "processor of parent, s/log",
    "throughput per core, of a plain loop's", "peak of parent [MB]", "peak of a worker [MB]", "outcomes",
    "lost",
)  # fmt: skip
PLAIN = """
import json, pickle, sys, time
from quadid.app.fleet import identify_one
jobs = pickle.load(open(sys.argv[1], "rb"))
identify_one(jobs[0])  # loads the kernels
begin = time.process_time()
for job in jobs[1:]:
    identify_one(job)
print(json.dumps({"a_log": (time.process_time() - begin) / len(jobs[1:])}))
"""
PLAIN_LOGS = 41
"""Logs of the plain loop; the first is not counted."""


BUSY = (
    "Other work was running: it lengthens the clock's time, so that a speed-up is not sure, but hardly the\n"
    "processor time: that of a log decides how many logs one more worker with a core of its own adds."
)


def main() -> None:
    """Measures, prints the results page and writes it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=1000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--kills", type=int, nargs="+", default=[0], help="workers to kill, in runs of their own")
    parser.add_argument("--out", type=Path, help="folder for fleet.md")
    options = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "logs"
        write_logs(folder, options.logs)
        plain = plain_loop(folder, Path(place))
        runs = [
            run(folder, Path(place) / f"out{workers}_{kills}", workers, kills)
            for workers in options.workers for kills in options.kills
        ]  # fmt: skip
    text = told(options, plain, runs, (load, os.getloadavg()[0]))
    print(text)
    if options.out:
        (options.out / "fleet.md").write_text(text, encoding="utf-8")


def told(options: argparse.Namespace, plain: float, runs: list[Run], load: tuple[float, float]) -> str:
    """The results page; `plain` is the processor time of a log in the plain loop [s]."""
    logs = options.logs
    count, killed = (" ".join(map(str, numbers)) for numbers in (options.workers, options.kills))
    idle = load[0] < 0.5
    lines = [
        "# Many logs, measured",
        "",
        f"`python -m quadid_evaluation.benchmarks.fleet --logs {logs} --workers {count} --kills {killed} --out "
        f"docs/results`: {logs}",
        f"logs of {SECONDS:g} s, identified by `quadid fleet` on {os.cpu_count()} cores; load",
        f"average {load[0]:.1f} before and {load[1]:.1f} after. A plain loop in one process takes {plain:.3f} s of the",
        "processor for a log. Workers that are killed die at random places of the run; what they had begun and the",
        "start of those that replace them are counted.",
        *([] if idle else [BUSY]),
        "",
        f"| {' | '.join(HEAD)} |",
        f"|{'---|' * len(HEAD)}",
        *(f"| {' | '.join(_cells(one, runs[0], logs, plain, idle))} |" for one in runs),
        "",
        "Logs are independent: a worker holds one at a time. What the parent (scheduler, SQLite) takes for a log",
        "bounds how many workers one scheduler can keep busy.",
        "",
    ]
    return "\n".join(lines)


def _cells(one: Run, first: Run, logs: int, plain: float, idle: bool) -> list[str]:
    outcomes = ", ".join(f"{number} {status}" for status, number in one.outcomes.items())
    return [
        f"{one.workers}", f"{one.kills}", f"{one.seconds:.0f}", f"{logs / one.seconds:.2f}",
        f"{first.seconds / one.seconds:.2f}{'' if idle or one is first else ', not sure'}",
        f"{one.worker_cpu / logs:.3f}", f"{one.parent_cpu / logs:.4f}",
        f"{logs * plain / (one.worker_cpu + one.parent_cpu):.0%}", f"{one.parent_memory:.0f}",
        f"{one.worker_memory:.0f}", outcomes, f"{logs - one.outcomes.total()}",
    ]  # fmt: skip


def write_logs(folder: Path, count: int) -> None:
    """Writes `count` logs of ten vehicles."""
    pelican = Vehicle.shipped("pelican")
    flown = []
    for i in range(min(count, FLOWN)):
        path = folder / f"vehicle{i}" / "flight0.mcap"
        path.parent.mkdir(parents=True)
        recording = fly(pelican, seconds=SECONDS, seed=i).recording
        write_mcap(path, recording)
        flown.append((path, recording))
    for i in range(len(flown), count):
        path, recording = flown[i % len(flown)]
        hours = i // len(flown)
        write_mcap(path.with_name(f"flight{hours}.mcap"), recording, hours * 3600 * 10**9)


def jobs_of(folder: Path) -> Sequence[Job]:
    """Jobs of the plain loop, as the command makes them."""
    text = Vehicle.shipped("pelican").to_yaml()
    paths = sorted(folder.rglob("*.mcap"))[:PLAIN_LOGS]
    return [Job(str(path), path.name, path.parent.name, text, path.stat().st_size, 0, "", 50.0, 1, False)
            for path in paths]  # fmt: skip


def plain_loop(folder: Path, place: Path) -> float:
    """Processor time of a log in a process that identifies one after the other [s]."""
    path = place / "jobs.pkl"
    path.write_bytes(pickle.dumps(jobs_of(folder)))
    return float(child(PLAIN, str(path), environment={"OPENBLAS_NUM_THREADS": "1"})["a_log"])


def run(folder: Path, out: Path, workers: int, kills: int = 0) -> Run:
    """Identifies the folder; kills that many workers at random places."""
    out.mkdir()
    count = sum(1 for _ in folder.rglob("*.mcap"))
    rng = random.Random(kills)
    places = sorted(rng.sample(range(1, count), kills), reverse=True)
    command = [str(Path(sys.executable).with_name("quadid")), "fleet", str(folder), "--vehicle", "pelican"]
    command += ["--workers", str(workers), "--out", str(out), "--json", str(out / "fleet.json")]
    begin, seen = time.perf_counter(), Seen()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as running:
        while running.poll() is None:
            time.sleep(0.2)
            started = seen.look(running.pid)
            if places and started and stored(out / "fleet.sqlite") >= places[-1]:
                os.kill(rng.choice(started), signal.SIGKILL)
                places.pop()
    seconds = time.perf_counter() - begin
    outcomes = Counter(json.loads((out / "fleet.json").read_text(encoding="utf-8"))["counts"])
    (parent, busy), (own, largest) = seen.processor, seen.memory
    return Run(workers, kills, seconds, parent, busy, own, largest, outcomes)


def stored(database: Path) -> int:
    """Logs with an outcome so far."""
    with contextlib.closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as connection:
        return int(connection.execute("SELECT count(*) FROM logs").fetchone()[0])


class Seen:
    """Processor time [s] and peak memory [MB] of the command and of the processes below it, as far as they were seen.

    Attributes:
        processor: of the command, and of all below it, also those that have ended.
        memory: of the command, and of the largest below it.
    """

    def __init__(self) -> None:
        self.processor = [0.0, 0.0]
        self.memory = [0.0, 0.0]

    def look(self, pid: int) -> list[int]:
        """Looks at what runs now; returns the workers, which a process of the command forks."""
        import psutil

        with contextlib.suppress(psutil.NoSuchProcess):
            own = psutil.Process(pid)
            below = own.children(recursive=True)
            direct = {process.pid for process in own.children()}
            self._note(0, [own], 2)
            self._note(1, below, 4)  # and of their children that have ended
            return [process.pid for process in below if process.ppid() in direct]
        return []

    def _note(self, which: int, processes: Sequence[Any], times: int) -> None:
        self.processor[which] = max(self.processor[which], sum(sum(p.cpu_times()[:times]) for p in processes))
        self.memory[which] = max([self.memory[which], *(p.memory_info().rss / 1e6 for p in processes)])


if __name__ == "__main__":
    main()
