"""Many logs: how long `quadid fleet` takes with one and with more workers, and what its processes need of memory.

    python -m benchmarks.fleet --logs 1000 --workers 1 2

Flies a few vehicles, writes that many logs of 10 s of them, and runs the command's own cluster over all.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

from quadid_cli.fleet_cluster import cluster, results
from quadid_cli.fleet_folder import find_jobs
from quadid_cli.fleet_store import open_store
from quadid_replay import write_mcap

from quadid.flight import fly
from quadid.vehicle import Vehicle

SECONDS = 10.0
FLOWN = 10
"""Different flights; more logs are copies of them."""


def main() -> None:
    """Measures and prints one line for each number of workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=1000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    print(f"{options.logs} logs of {SECONDS:g} s on {os.cpu_count()} cores, load before {os.getloadavg()[0]:.1f}")
    print("workers  seconds  logs/s  speed-up  peak of parent [MB]  peak of a worker [MB]  outcomes")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "logs"
        write_logs(folder, options.logs)
        alone = None
        for workers in options.workers:
            seconds, parent, worker, outcomes = run(folder, Path(place) / f"out{workers}", workers)
            alone = seconds if alone is None else alone
            print(
                f"{workers:7}  {seconds:7.1f}  {options.logs / seconds:6.2f}  {alone / seconds:8.2f}  {parent:19.0f}"
                f"  {worker:21.0f}  {dict(outcomes)}",
                flush=True,
            )


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


def run(folder: Path, out: Path, workers: int) -> tuple[float, float, float, Counter[str]]:
    """Identifies the folder; returns seconds, peak memory of this process and of a worker [MB], and the outcomes."""
    out.mkdir()
    jobs = find_jobs(folder, Vehicle.shipped("pelican").to_yaml(), 50.0, 1, False).jobs
    outcomes: Counter[str] = Counter()
    seen = [0.0, 0.0]
    with open_store(out / "fleet.sqlite") as store, cluster(None, workers, "2GiB") as client:
        processes = list(client.run(os.getpid).values())
        done = threading.Event()
        watcher = threading.Thread(target=_watch, args=(processes, seen, done))
        watcher.start()
        begin = time.perf_counter()
        for row in results(client, jobs):
            store.put(row)
            outcomes[row["status"]] += 1
        seconds = time.perf_counter() - begin
        done.set()
        watcher.join()
    return seconds, seen[0], seen[1], outcomes


def _watch(processes: list[int], seen: list[float], done: threading.Event) -> None:
    import psutil

    while not done.wait(0.5):
        seen[0] = max(seen[0], psutil.Process().memory_info().rss / 1e6)
        for number in processes:
            if psutil.pid_exists(number):
                seen[1] = max(seen[1], psutil.Process(number).memory_info().rss / 1e6)


if __name__ == "__main__":
    main()
