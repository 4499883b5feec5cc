"""Memory and time of the service over an accelerated day: data of 24 h as fast as they can be taken in."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from quadid_node.history import Store
from quadid_node.service import Service
from quadid_node.worker import InlineWorker

from quadid.data.window import Sample
from quadid.online import FitRequest, Job, JobReply, Session, SessionSettings
from quadid.online.records import Action
from quadid_evaluation.benchmarks.online.accuracy import PELICAN, flown
from quadid_evaluation.benchmarks.online.driving import drive, samples

LOOP, PAUSE = 120.0, 5.0
"""Flight of so long [s] over and over, with a pause on the ground between."""
PAGE = os.sysconf("SC_PAGE_SIZE")


def resident() -> float:
    """Memory of this process [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE / 2**20


def day(hours: float, refit: float, progress: bool = False) -> dict[str, Any]:
    """Takes in `hours` of flight with a refit every `refit` [s], history on disk; memory as it goes."""
    flight = list(samples(flown(LOOP, 3).recording))
    begin, points, fits = time.monotonic(), [], 0
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / "history.sqlite", "pelican")
        service = Service(PELICAN, SessionSettings(refit=refit), InlineWorker(), store)
        for loop in range(round(hours * 3600.0 / (LOOP + PAUSE))):
            _take(service, flight, loop * (LOOP + PAUSE))
            points.append(((loop + 1) * (LOOP + PAUSE) / 3600.0, resident()))
            if progress and loop % 20 == 0:
                print(f"{points[-1][0]:.1f} h: {points[-1][1]:.0f} MiB, {time.monotonic() - begin:.0f} s", flush=True)
        fits = service.session.status().fits
        service.close()
        history = sum(f.stat().st_size for f in Path(folder).iterdir()) / 2**20
    t, memory = np.array(points).T
    late = t > 0.25 * t[-1]
    slope = float(np.polyfit(t[late], memory[late], 1)[0]) if late.sum() > 2 else float("nan")
    return {
        "hours": float(t[-1]), "refit": refit, "fits": fits, "wall_seconds": time.monotonic() - begin,
        "memory_after_an_hour": float(memory[np.searchsorted(t, min(1.0, t[-1]))]), "memory_at_end": float(memory[-1]),
        "slope_per_hour": slope, "history_mib": history,
    }  # fmt: skip


def _take(service: Service, flight: list[Sample], shift: float) -> None:
    for k, sample in enumerate(flight):
        service.push(Sample(sample.t + shift, sample.channel, sample.values))
        if k % 50 == 0:
            service.step()
            while service.session.running is not None:
                service.step()


def refits(seconds: float) -> dict[str, Any]:
    """Time of warm refits of a 10 s window: of the processor, and by the clock."""

    spent: list[tuple[bool, float, float]] = []

    def timed(job: Job) -> JobReply:
        wall, cpu = time.perf_counter(), time.process_time()
        reply = job.run()
        if isinstance(job, FitRequest):
            spent.append((job.search, time.process_time() - cpu, time.perf_counter() - wall))
        return reply

    _count: list[Action] = list(drive(Session(PELICAN), samples(flown(seconds, 4).recording), timed))
    warm = np.array([(cpu, wall) for search, cpu, wall in spent if not search]) * 1e3
    cold = [1e3 * cpu for search, cpu, _ in spent if search]
    return {
        "refits": len(warm), "cpu_ms": _spread(warm[:, 0]), "wall_ms": _spread(warm[:, 1]), "first_ms": cold[:1],
        "load_average": os.getloadavg()[0],
    }  # fmt: skip


def _spread(values: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, float]:
    return {"p50": float(np.median(values)), "p99": float(np.quantile(values, 0.99)), "max": float(values.max())}
