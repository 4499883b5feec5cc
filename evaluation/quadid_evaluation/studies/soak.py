"""Soak: a day of flight at accelerated time and an hour in real time; writes `soak.json` and `soak.md`.

python -m quadid_evaluation.studies.soak --out docs/results
python -m quadid_evaluation.studies.soak --parts live --seconds 3600 --out docs/results
"""

import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from quadid_node.history import KEPT, Store
from quadid_node.service import Service
from quadid_node.worker import InlineWorker, Trouble

from quadid.data.window import Block, Recording
from quadid.online import Publish, SessionSettings
from quadid.online.records import JobReply
from quadid_evaluation.benchmarks import ros_flight
from quadid_evaluation.benchmarks.online import PELICAN, flown, keep
from quadid_evaluation.harness import judged, options

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
) -> dict[str, Any]:
    """Takes in `hours` of flight.

    Args:
        refit: between two fits [s].
        diagnose: between two diagnoses [s].
        limit: stops after so much wall time [s] and says how far it came.
        kept: candidates and events that the history keeps; fewer than in service, so that the limit is reached.

    Returns:
        One entry an hour of flight: memory, files, time a sample and a fit, samples sent, taken and dropped.
    """
    flight = batches(flown(FLIGHT, 3).recording)
    samples = sum(len(block.t) * len(block.columns) for batch in flight for block in batch)
    begin, points, whole = time.monotonic(), list[dict[str, Any]](), FLIGHT + GROUND
    last = round(hours * 3600.0 / whole)
    every = max(round(min(hours / 12.0, 1.0) * 3600.0 / whole), 1)
    with tempfile.TemporaryDirectory() as folder:
        worker, sent, published, own = TimedWorker(), 0, 0, 0.0
        store = Store(Path(folder) / "history.sqlite", "pelican", {"candidates": kept, "events": kept})
        service = Service(PELICAN, SessionSettings(refit=refit, diagnose=diagnose), worker, store)
        before = {"sent": 0, "fits": 0, "spent": 0.0}  # at the last point
        for loop in range(last):
            # One flight, later than the recording; what the fits take is not the session's own time.
            start, fitted = time.thread_time(), worker.spent
            for batch in flight:
                for block in batch:
                    service.push(Block(block.t + loop * whole, block.columns))
                outputs = service.step()
                while service.session.running is not None:
                    outputs += service.step()
                published += sum(isinstance(o, Publish) and o.topic == "parameters" for o in outputs)
            sent, own = sent + samples, own + time.thread_time() - start - (worker.spent - fitted)
            over = time.monotonic() - begin > limit
            if (loop + 1) % every and loop + 1 != last and not over:
                continue
            buffer = service.session.resampler
            points.append(
                {
                    "memory_mib": ros_flight.resident(psutil.Process()),
                    "sent": sent,
                    "taken": sum(buffer.counts.values()),
                    "dropped": sum(buffer.faults.values()),
                    "us_a_sample": 1e6 * own / max(sent - before["sent"], 1),
                    "ms_a_fit": 1e3 * (worker.spent - before["spent"]) / max(worker.fits - before["fits"], 1),
                    "fits": worker.fits,
                    "published": published,
                    "hours": (loop + 1) * whole / 3600.0,
                    "files_mib": ros_flight.size_of(Path(folder)),
                }
            )
            own, before = 0.0, {"sent": sent, "fits": worker.fits, "spent": worker.spent}
            tell(f"{points[-1]['hours']:.1f} h of flight, {points[-1]['memory_mib']:.0f} MiB")
            if over:
                break
        service.close()
    given = {"asked_hours": hours, "refit": refit, "diagnose": diagnose, "kept": kept}
    return given | {"wall_seconds": time.monotonic() - begin, "points": points}


def batches(recording: Recording) -> list[tuple[Block, ...]]:
    """The recording as the node takes messages in: `BATCH` seconds of one channel, then of the next one."""
    channels = recording.channels
    begin, end = min(c.t[0] for c in channels.values()), max(c.t[-1] for c in channels.values())
    edges = np.arange(begin, end + BATCH, BATCH)
    places = {name: np.searchsorted(c.t, [*edges, np.inf]) for name, c in channels.items()}
    made = (
        tuple(
            Block(c.t[p[k] : p[k + 1]], ((name, c.values[p[k] : p[k + 1]]),))
            for (name, c), p in zip(channels.items(), places.values(), strict=True)
            if p[k + 1] > p[k]
        )
        for k in range(len(edges))
    )
    return [batch for batch in made if batch]


def slope(points: list[dict[str, Any]], name: str) -> float:
    """Least-squares slope of a column over the last three quarters [1/h]; NaN for fewer than three points."""
    late = [p for p in points if p["hours"] > 0.25 * points[-1]["hours"]]
    if len(late) < 3:
        return float("nan")
    return float(np.polyfit([p["hours"] for p in late], [p[name] for p in late], 1)[0])


Result = Mapping[str, Any]


def page(results: Result) -> str:
    """Markdown of the parts that were measured."""
    out = [
        "# Soak",
        "",
        "`make soak`: session, fits, diagnoses and history in one process at accelerated time; the node over DDS with "
        "its fit process in real time. Points over time are in `soak.json`.",
        "",
    ]
    for name, title, write in (("accelerated", "At accelerated time", _accelerated), ("live", "In real time", _live)):
        found = results.get(name)
        out += [f"## {title}", "", *(write(found["result"]) if found else ["Not measured."]), ""]
        if found:
            out += [
                f"_{found['measured']}, load {found['machine'].partition('load ')[2].removeprefix('average ')}_",
                "",
            ]
    return "\n".join(out)


def _accelerated(r: Result) -> list[str]:
    points = r["points"]
    last = points[-1]
    short = (
        ""
        if last["hours"] > 0.99 * r["asked_hours"]
        else f", **stopped before the {r['asked_hours']:.0f} h asked for,**"
    )
    lines = [
        f"**{last['hours']:.1f} h of flight**{short} in {r['wall_seconds'] / 60:.0f} min: {FLIGHT:.0f} s flown, "
        f"{GROUND:.0f} s of silence, and again; {last['fits']} fits, a diagnosis every {r['diagnose']:.0f} s, "
        f"{last['published']} sets published. The history keeps the newest {r['kept']} candidates and events here (in "
        f"service {KEPT['candidates']} and {KEPT['events']}).",
        "",
        f"Samples sent {last['sent']:,}, taken {last['taken']:,}, dropped {last['dropped']:,}: "
        f"**{last['sent'] - last['taken'] - last['dropped']} lost**. Memory {last['memory_mib']:.0f} MiB at the end. "
        f"Slopes over the last three quarters: memory {slope(points, 'memory_mib'):+.3f} MiB/h, files "
        f"{slope(points, 'files_mib'):+.3f} MiB/h, processor time {slope(points, 'us_a_sample'):+.3f} us a sample per "
        "hour.",
    ]
    return lines


def _live(r: Result) -> list[str]:
    points, minutes = r["points"], r["minutes"]
    taken, sent = minutes[-1]["messages"], r["sent"]
    lost = {t: n - taken.get(t, 0) for t, n in sent.items()}
    p99 = np.array([m["p99"] for m in minutes if m["p99"] is not None])
    third = max(len(p99) // 3, 1)
    lines = [
        f"**{points[-1]['hours'] * 60:.0f} min**; all inputs at 100 Hz, a fit every second, a diagnosis every minute: "
        f"{minutes[-1]['fits']} fits, set {minutes[-1]['in_force']} in force at the end, exit code {r['exit_code']}, "
        f"{len(r['problems'])} warnings or errors.",
        "",
        f"Messages sent {sum(sent.values()):,}, taken {sum(taken.values()):,}; "
        f"**lost: {', '.join(f'{t} {n}' for t, n in lost.items() if n) or 'none'}**; samples dropped by the session: "
        f"{minutes[-1]['dropped'] or 'none'}. Slopes over the last three quarters: memory "
        f"{slope(points, 'memory_mib'):+.2f} MiB/h, fit process {slope(points, 'worker_mib'):+.2f} MiB/h, files "
        f"{slope(points, 'files_mib'):+.2f} MiB/h; handles {points[0]['handles']:.0f} → {points[-1]['handles']:.0f}. "
        f"IMU latency p99: first third {np.median(p99[:third]):.0f} ms, last third {np.median(p99[-third:]):.0f} ms "
        f"(load average {points[0]['load']:.0f} → {points[-1]['load']:.0f}).",
    ]
    if r["problems"]:
        lines += ["", "Warnings: " + "; ".join(f"`{p[:160]}`" for p in r["problems"][:8])]
    return lines


PARTS: Mapping[str, Callable[[Any], dict[str, Any]]] = {
    "accelerated": lambda g: day(g.hours, g.refit, g.diagnose, partial(print, flush=True), g.limit, g.kept),
    "live": lambda g: ros_flight.flown(g.seconds, 100.0, "excited", False, 60.0, partial(print, flush=True)),
}

if __name__ == "__main__":
    given = options(__doc__, PARTS, hours=24.0, refit=10.0, diagnose=1800.0, kept=2000, limit=1e9, seconds=3600.0)
    where = (given.out or Path("docs/results")) / "soak.md"
    for part in given.parts:
        found = keep(where.with_suffix(".json"), part, PARTS[part](given))
        where.write_text(page(found) + judged(where), encoding="utf-8")
