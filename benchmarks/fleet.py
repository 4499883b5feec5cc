"""Many logs: how long `quadid fleet` takes with one and with more workers, and what its processes need of memory.

    python -m benchmarks.fleet --logs 1000 --workers 1 2 [--out docs/results]

Flies a few vehicles, writes that many logs of 10 s of them, and runs the command's own cluster over all.  Beside the
clock's time stands the processor time that parent and workers took, which other work on the machine does not lengthen:
workers share nothing but the parent, so logs / (processor time of one log) is what a worker on a core of its own does.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from quadid_cli.fleet_cluster import cluster, results
from quadid_cli.fleet_folder import find_jobs
from quadid_cli.fleet_store import open_store
from quadid_replay import write_mcap

from quadid.flight import fly
from quadid.vehicle import Vehicle

SECONDS = 10.0
FLOWN = 10
"""Different flights; more logs are copies of them."""


class Run(NamedTuple):
    """One run over all logs: seconds of the clock and of processors, peak memory [MB], outcomes."""

    workers: int
    seconds: float
    parent_cpu: float
    worker_cpu: float
    parent_memory: float
    worker_memory: float
    outcomes: Counter[str]


HEAD = (
    "workers", "seconds", "logs/s", "speed-up", "processor of workers, s/log", "processor of parent, s/log",
    "peak of parent [MB]", "peak of a worker [MB]", "outcomes",
)  # fmt: skip


BUSY = (
    "Other work was running: it lengthens the clock's time, so that a speed-up is not sure, but hardly the\n"
    "processor time: that of a log decides how many logs one more worker with a core of its own adds."
)


def main() -> None:
    """Measures, prints the results page and writes it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=1000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--out", type=Path, help="folder for fleet.md")
    options = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "logs"
        write_logs(folder, options.logs)
        runs = [run(folder, Path(place) / f"out{workers}", workers) for workers in options.workers]
    text = told(options.logs, options.workers, runs, (load, os.getloadavg()[0]))
    print(text)
    if options.out:
        (options.out / "fleet.md").write_text(text, encoding="utf-8")


def told(logs: int, workers: list[int], runs: list[Run], load: tuple[float, float]) -> str:
    """The results page."""
    count = " ".join(str(w) for w in workers)
    idle = load[0] < 0.5
    lines = [
        "# Many logs, measured",
        "",
        f"`python -m benchmarks.fleet --logs {logs} --workers {count} --out docs/results`: {logs} logs of",
        f"{SECONDS:g} s, identified by the own cluster of `quadid fleet` on {os.cpu_count()} cores; load average",
        f"{load[0]:.1f} before and {load[1]:.1f} after.",
        *([] if idle else [BUSY]),
        "",
        f"| {' | '.join(HEAD)} |",
        f"|{'---|' * len(HEAD)}",
        *(f"| {' | '.join(_cells(one, runs[0], logs, idle))} |" for one in runs),
        "",
        "Logs are independent: a worker holds one at a time. What the parent (scheduler, SQLite) takes for a log",
        "bounds how many workers one scheduler can keep busy.",
        "",
    ]
    return "\n".join(lines)


def _cells(one: Run, first: Run, logs: int, idle: bool) -> list[str]:
    outcomes = ", ".join(f"{number} {status}" for status, number in one.outcomes.items())
    return [
        f"{one.workers}", f"{one.seconds:.0f}", f"{logs / one.seconds:.2f}",
        f"{first.seconds / one.seconds:.2f}{'' if idle or one is first else ', not sure'}",
        f"{one.worker_cpu / logs:.3f}", f"{one.parent_cpu / logs:.4f}", f"{one.parent_memory:.0f}",
        f"{one.worker_memory:.0f}", outcomes,
    ]  # fmt: skip


def write_logs(folder: Path, count: int) -> None:
    """Writes `count` logs of ten vehicles."""
    pelican = Vehicle.shipped("pelican")
    flown = []
    for i in range(min(count, FLOWN)):
        path = folder / f"vehicle{i}" / "flight0.mcap"
        path.parent.mkdir(parents=True)
        write_mcap(path, fly(pelican, seconds=SECONDS, seed=i).recording)
        flown.append(path)
    for i in range(len(flown), count):
        source = flown[i % len(flown)]
        os.link(source, source.with_name(f"flight{i // len(flown)}.mcap"))


def run(folder: Path, out: Path, workers: int) -> Run:
    """Identifies the folder."""
    import psutil

    out.mkdir()
    jobs = find_jobs(folder, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, False).jobs
    outcomes: Counter[str] = Counter()
    seen = [0.0, 0.0]
    with open_store(out / "fleet.sqlite") as store, cluster(None, workers, "2GiB") as client:
        processes = list(client.run(os.getpid).values())
        done = threading.Event()
        watcher = threading.Thread(target=_watch, args=(processes, seen, done))
        watcher.start()
        begin, parent = time.perf_counter(), time.process_time()
        before = [sum(psutil.Process(number).cpu_times()[:2]) for number in processes]
        for row in results(client, jobs):
            store.put(row)
            outcomes[row["status"]] += 1
        seconds, parent = time.perf_counter() - begin, time.process_time() - parent
        busy = sum(sum(psutil.Process(number).cpu_times()[:2]) for number in processes) - sum(before)
        done.set()
        watcher.join()
    return Run(workers, seconds, parent, busy, seen[0], seen[1], outcomes)


def _watch(processes: list[int], seen: list[float], done: threading.Event) -> None:
    import psutil

    while not done.wait(0.5):
        seen[0] = max(seen[0], psutil.Process().memory_info().rss / 1e6)
        for number in processes:
            if psutil.pid_exists(number):
                seen[1] = max(seen[1], psutil.Process(number).memory_info().rss / 1e6)


if __name__ == "__main__":
    main()
