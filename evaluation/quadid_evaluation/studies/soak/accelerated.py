"""A day of flight as fast as it can be taken in: session, fits, diagnoses and history on disk, in one process."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from quadid_node.history import Store
from quadid_node.service import Service
from quadid_node.worker import InlineWorker, Trouble

from quadid.data.window import Block, Recording
from quadid.online import Publish, SessionSettings
from quadid.online.records import JobReply
from quadid_evaluation.benchmarks.online.accuracy import PELICAN, flown
from quadid_evaluation.benchmarks.online.memory import resident
from quadid_evaluation.studies.soak import memory

FLIGHT, GROUND = 120.0, 5.0
"""A flight of so long [s] over and over, with a pause of so long between two."""
BATCH = 0.4
"""Time between two looks at the session [s]: 20 messages at 50 Hz, as far as the node lets a topic run ahead."""


class TimedWorker(InlineWorker):
    """Fits inline, and keeps apart what the fits cost.

    Attributes:
        spent: processor time of all fits and diagnoses [s]; fits: how many.
    """

    def __init__(self) -> None:
        super().__init__()
        self.spent, self.fits = 0.0, 0

    def poll(self) -> list[JobReply | Trouble]:
        """Does what waits, and times it."""
        begin = time.thread_time()
        done = super().poll()
        if done:
            self.spent += time.thread_time() - begin
            self.fits += len(done)
        return done

    def sibling(self) -> InlineWorker:
        """Diagnoses count with the fits."""
        return self


def day(
    hours: float, refit: float, diagnose: float, tell: Callable[[str], None], limit: float, kept: int
) -> dict[str, Any]:  # fmt: skip
    """Takes in `hours` of flight.

    Args:
        hours: flight time, pauses included.
        refit: between two fits [s].
        diagnose: between two diagnoses [s].
        tell: takes a line now and then.
        limit: stops after so much wall time [s] and says how far it came.
        kept: candidates and events that the history keeps; fewer than in service, so that the limit is reached.

    Returns:
        One entry an hour of flight: memory, files, time a sample and a fit, samples sent, taken and dropped.
    """
    flight = batches(flown(FLIGHT, 3).recording)
    begin, points = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        worker = TimedWorker()
        store = Store(Path(folder) / "history.sqlite", "pelican", {"candidates": kept, "events": kept})
        service = Service(PELICAN, SessionSettings(refit=refit, diagnose=diagnose), worker, store)
        tally = _Tally(service, worker, flight)
        last = round(hours * 3600.0 / (FLIGHT + GROUND))
        every = max(round(min(hours / 12.0, 1.0) * 3600.0 / (FLIGHT + GROUND)), 1)
        for loop in range(last):
            tally.fly(loop * (FLIGHT + GROUND))
            over = time.monotonic() - begin > limit
            if (loop + 1) % every and loop + 1 != last and not over:
                continue
            points.append(
                {**tally.point(), "hours": (loop + 1) * (FLIGHT + GROUND) / 3600.0, "files_mib": _size(folder)}
            )
            tell(f"{points[-1]['hours']:.1f} h of flight, {points[-1]['memory_mib']:.0f} MiB")
            if over:
                break
        service.close()
    return {
        "asked_hours": hours,
        "refit": refit,
        "diagnose": diagnose,
        "kept": kept,
        "wall_seconds": time.monotonic() - begin,
        "points": points,
    }


def batches(recording: Recording) -> list[tuple[Block, ...]]:
    """The recording as the node takes messages in: `BATCH` seconds of one channel, then of the next one."""
    channels = recording.channels
    begin, end = min(c.t[0] for c in channels.values()), max(c.t[-1] for c in channels.values())
    edges = np.arange(begin, end + BATCH, BATCH)
    places = {name: np.searchsorted(c.t, [*edges, np.inf]) for name, c in channels.items()}
    made = (
        tuple(
            Block(c.t[p[k] : p[k + 1]], ((name, c.values[p[k] : p[k + 1]]),))
            for (name, c), p in zip(channels.items(), places.values(), strict=True) if p[k + 1] > p[k]
        )
        for k in range(len(edges))
    )  # fmt: skip
    return [batch for batch in made if batch]


class _Tally:
    """Flies, and counts since the last point."""

    def __init__(self, service: Service, worker: TimedWorker, flight: list[tuple[Block, ...]]) -> None:
        self._service, self._worker, self._flight = service, worker, flight
        self._size = sum(len(block.t) * len(block.columns) for batch in flight for block in batch)
        self._sent = self._published = 0
        self._sent_before = self._fits_before = 0
        self._own = self._fits_spent = 0.0

    def fly(self, shift: float) -> None:
        """One flight, `shift` [s] later than the recording."""
        service, spent = self._service, self._worker.spent
        begin = time.thread_time()
        for batch in self._flight:
            for block in batch:
                service.push(Block(block.t + shift, block.columns))
            self._note(service.step())
            while service.session.running is not None:
                self._note(service.step())
        self._sent += self._size
        self._own += time.thread_time() - begin - (self._worker.spent - spent)

    def _note(self, outputs: list[Any]) -> None:
        self._published += sum(isinstance(o, Publish) and o.topic == "parameters" for o in outputs)

    def point(self) -> dict[str, Any]:
        """What was counted since the last point, and memory now."""
        buffer, worker = self._service.session.resampler, self._worker
        taken, dropped = sum(buffer.counts.values()), sum(buffer.faults.values())
        out = {
            "memory_mib": resident(), "sent": self._sent, "taken": taken, "dropped": dropped,
            "us_a_sample": 1e6 * self._own / max(self._sent - self._sent_before, 1),
            "ms_a_fit": 1e3 * (worker.spent - self._fits_spent) / max(worker.fits - self._fits_before, 1),
            "fits": worker.fits, "published": self._published, "parts": memory.parts(),
        }  # fmt: skip
        self._sent_before, self._fits_before = self._sent, worker.fits
        self._own, self._fits_spent = 0.0, worker.spent
        return out


def slope(points: list[dict[str, Any]], name: str) -> float:
    """Least-squares slope of a column over the last three quarters [1/h]; NaN for fewer than three points."""
    late = [p for p in points if p["hours"] > 0.25 * points[-1]["hours"]]
    if len(late) < 3:
        return float("nan")
    return float(np.polyfit([p["hours"] for p in late], [p[name] for p in late], 1)[0])


def _size(folder: str) -> float:
    return sum(f.stat().st_size for f in Path(folder).rglob("*") if f.is_file()) / 2**20
