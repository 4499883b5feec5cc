"""Many logs: how long `quadid fleet` takes, what its processes need, and what workers that are killed cost.

    python -m benchmarks.fleet --logs 1000 --workers 1 2 --kills 0 20 [--out docs/results]

Flies a few vehicles, writes that many logs of 10 s of them, and runs the command's own cluster over all; before it a
plain loop in one process over some of them.  Workers are killed at random places of the run, one at a time.  Beside the
clock's time stands the processor time that parent and workers took, also those killed, which other work on the machine
hardly lengthens: logs per processor second beside those of the plain loop are the throughput per core.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import pickle
import random
import resource
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from quadid_cli.fleet_cluster import cluster, results
from quadid_cli.fleet_folder import find_jobs
from quadid_cli.fleet_store import open_store
from quadid_replay import write_mcap

from benchmarks.speed.timing import child
from quadid.flight import fly
from quadid.vehicle import Vehicle
from quadid.workflow.fleet import Job

SECONDS = 10.0
FLOWN = 10
"""Different flights; more logs are the same at another date."""


class Run(NamedTuple):
    """One run over all logs: seconds of the clock and of processors, peak memory [MB], logs by outcome and twice."""

    workers: int
    kills: int
    seconds: float
    parent_cpu: float
    worker_cpu: float
    parent_memory: float
    worker_memory: float
    outcomes: Counter[str]
    twice: int


HEAD = (
    "workers", "killed", "seconds", "logs/s", "speed-up", "processor of workers, s/log", "processor of parent, s/log",
    "throughput per core, of a plain loop's", "peak of parent [MB]", "peak of a worker [MB]", "outcomes",
    "lost", "answered twice",
)  # fmt: skip
PLAIN = """
import json, pickle, sys, time
from quadid.workflow.fleet import identify_one
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
        f"`python -m benchmarks.fleet --logs {logs} --workers {count} --kills {killed} --out docs/results`: {logs}",
        f"logs of {SECONDS:g} s, identified by the own cluster of `quadid fleet` on {os.cpu_count()} cores; load",
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
        f"{one.worker_memory:.0f}", outcomes, f"{logs - one.outcomes.total() + one.twice}", f"{one.twice}",
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
    """Jobs of all logs of the folder."""
    return find_jobs(folder, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, False).jobs


def plain_loop(folder: Path, place: Path) -> float:
    """Processor time of a log in a process that identifies one after the other [s]."""
    path = place / "jobs.pkl"
    path.write_bytes(pickle.dumps(list(jobs_of(folder))[:PLAIN_LOGS]))
    return float(child(PLAIN, str(path), environment={"OPENBLAS_NUM_THREADS": "1"})["a_log"])


def run(folder: Path, out: Path, workers: int, kills: int = 0) -> Run:
    """Identifies the folder; kills that many workers at random places."""
    out.mkdir()
    jobs = jobs_of(folder)
    names: Counter[str] = Counter()
    outcomes: Counter[str] = Counter()
    seen = [0.0, 0.0]
    rng = random.Random(kills)
    places = set(rng.sample(range(1, len(jobs)), kills))
    with open_store(out / "fleet.sqlite") as store, cluster(None, workers, "2GiB") as client:
        done = threading.Event()
        watcher = threading.Thread(target=_watch, args=(seen, done))
        watcher.start()
        begin, parent, before = time.perf_counter(), time.process_time(), _workers_processor_time()
        for row in results(client, jobs):
            store.put(row)
            outcomes[row["status"]] += 1
            names[row["name"]] += 1
            if outcomes.total() in places:
                os.kill(rng.choice(list(client.run(os.getpid).values())), signal.SIGKILL)
        seconds, parent = time.perf_counter() - begin, time.process_time() - parent
        busy = _workers_processor_time() - before
        done.set()
        watcher.join()
    twice = sum(count - 1 for count in names.values())
    return Run(workers, kills, seconds, parent, busy, seen[0], seen[1], outcomes, twice)


def _workers_processor_time() -> float:
    """Processor time of all children, those that live and those that have ended [s]."""
    import psutil

    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    living = 0.0
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            living += sum(process.cpu_times()[:4])  # and of its children that have ended
    return ended.ru_utime + ended.ru_stime + living


def _watch(seen: list[float], done: threading.Event) -> None:
    import psutil

    while not done.wait(0.5):
        own = psutil.Process()
        seen[0] = max(seen[0], own.memory_info().rss / 1e6)
        for process in own.children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                seen[1] = max(seen[1], process.memory_info().rss / 1e6)


if __name__ == "__main__":
    main()
