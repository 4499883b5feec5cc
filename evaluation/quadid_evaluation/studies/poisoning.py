"""Poisoning: one channel of a flight wrong by a factor, at once or slowly, and other faults: what is published?

    python -m quadid_evaluation.studies.poisoning --out docs/results [--minutes 60] [--only "first flight"] [--fresh]

A run goes on where the last one stopped after `--minutes`; `--fresh` forgets what earlier runs have flown.
"""

import copy
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from quadid_replay.columns import from_euler
from scipy.signal import butter, sosfiltfilt

from quadid.data.window import Block, Channel, Recording
from quadid.flight import Flight, fly
from quadid.online import Job, Publish, Session, SessionSettings
from quadid.online.records import OnlineSet
from quadid.rotation import euler
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import judged, options, table

Spoil = Callable[[Recording], Recording]
MUST = ("b", "J_xx", "J_yy")
STEP = 0.1
"""Data are handed over in pieces of this length [s]."""


@dataclass(frozen=True)
class Poison:
    """One channel wrong by a factor.

    Attributes:
        channel: name of the channel; column: which of it, None for all (of the attitude: roll and pitch).
        factor: what it is multiplied by in the end.
        begin: when it begins [s]; ramp: how long it grows [s], 0 for a step.
    """

    channel: str
    column: int | None
    factor: float
    begin: float
    ramp: float

    def factors(self, t: FloatArray) -> FloatArray:
        """Factor at times `t` [s], shape (n,)."""
        share = np.clip((t - self.begin) / self.ramp, 0.0, 1.0) if self.ramp else (t >= self.begin).astype(float)
        return np.asarray(1.0 + (self.factor - 1.0) * share)

    def spoil(self, recording: Recording) -> Recording:
        """The recording with the poison in it."""
        channel = recording.channels[self.channel]
        factor = self.factors(channel.t)
        if self.channel == "attitude":
            # Roll and pitch are multiplied, the heading is as it was.
            values = from_euler(euler(channel.values) * np.column_stack([factor, factor, np.ones(len(factor))]))
        else:
            values = channel.values.copy()
            values.T[slice(None) if self.column is None else self.column] *= factor
        return with_channel(recording, replace(channel, values=values))


def with_channel(recording: Recording, channel: Channel) -> Recording:
    """The recording with one channel changed."""
    return replace(recording, channels={**recording.channels, channel.name: channel})


def scaled(channel: str, factor: float, column: int | None = None) -> Spoil:
    """A channel, or one column of it, wrong by a factor from the beginning."""
    return Poison(channel, column, factor, -np.inf, 0.0).spoil


def changed(channel: str, change: Callable[[FloatArray], FloatArray]) -> Spoil:
    """A channel whose values, shape (n, k), something was done to."""

    def spoil(recording: Recording) -> Recording:
        old = recording.channels[channel]
        return with_channel(recording, replace(old, values=np.asarray(change(old.values))))

    return spoil


def supported(newtons: float, b: float) -> Spoil:
    """Something holds the vehicle up by a force [N], down where negative; it flies the same motion."""

    def less(speed: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.maximum(speed**2 - newtons / speed.shape[1] / b, 1.0)))

    return changed("rotor_speed", less)


def leaking(source: int, into: int, share: float) -> Spoil:
    """A share of one axis of the gyro is in another."""

    def mixed(gyro: FloatArray) -> FloatArray:
        out = gyro.copy()
        out[:, into] += share * gyro[:, source]
        return out

    return changed("gyro", mixed)


def about_the_mean(factor: float, channel: str = "accel") -> Spoil:
    """A scale that a bias hides at the mean: at 1 g, at hover."""
    return changed(channel, lambda values: values.mean(axis=0) + factor * (values - values.mean(axis=0)))


def smoothed(cutoff: float, rate: float = 50.0) -> Spoil:
    """A gyro smoothed forwards and backwards below a frequency [Hz]."""
    return changed("gyro", lambda g: sosfiltfilt(butter(2, cutoff, fs=rate, output="sos"), g, axis=0))


def late(channel: str, seconds: float) -> Spoil:
    """A channel whose stamps are late [s]."""

    def spoil(recording: Recording) -> Recording:
        old = recording.channels[channel]
        return with_channel(recording, replace(old, t=old.t + seconds))

    return spoil


def fly_online(session: Session, recording: Recording, start: float, stop: float) -> list[OnlineSet]:
    """Sets that a session puts on the parameter topic while it hears a stretch of a recording, every job done at once.

    Args:
        session: it hears, and is changed.
        recording: times in seconds.
        start: first time heard [s].
        stop: last one [s].
    """
    sets: list[OnlineSet] = []
    edges = np.arange(start, stop + 0.5 * STEP, STEP)
    places = {n: np.searchsorted(c.t, edges - 1e-6) for n, c in recording.channels.items()}
    for k in range(len(edges) - 1):
        for name, place in places.items():
            a, b = int(place[k]), int(place[k + 1])
            channel = recording.channels[name]
            if b > a:
                session.push(Block(channel.t[a:b], ((name, channel.values[a:b]),)))
        _answer(session, sets)
    return sets


def _answer(session: Session, sets: list[OnlineSet]) -> None:
    while True:
        for action in session.poll():
            if isinstance(action, Publish) and action.topic == "parameters":
                sets.append(action.item)
            elif isinstance(action, Job) and action.background:
                session.deliver(action.run())
        if session.running is None:
            return
        session.deliver(session.running.run())


CHANNELS: dict[str, tuple[str, int | None]] = {
    "gyro p": ("gyro", 0),
    "gyro q": ("gyro", 1),
    "gyro r": ("gyro", 2),
    "accelerometer": ("accel", None),
    "attitude": ("attitude", None),
    "all rotor speeds": ("rotor_speed", None),
    "rotor 1": ("rotor_speed", 0),
    "rotor 2": ("rotor_speed", 1),
}
"""Rotors 3 and 4 are the mirror images of 1 and 2."""
FACTORS, STEPS = (0.8, 0.9, 1.1, 1.25), (0.5, 1.5)
RAMPS = (0.0, 120.0, 30.0, 300.0)
LEARNT = 60.0
"""Healthy flight before the poison sets in [s]: a set is in force by then."""
AFTER = 45.0
"""Flight after the poison is whole [s]."""
WEIGHT, B = 1.3 * 9.80665, 2.33e-5
"""Of the flown vehicle [N], [N s^2/rad^2]."""
SINGLE: dict[str, Spoil] = {
    **{f"support {f:+.0%} of weight": supported(f * WEIGHT, B) for f in (0.04, 0.08, 0.15, -0.08, -0.15)},
    **{f"accelerometer scale {f:g} under a bias": about_the_mean(f) for f in (0.9, 1.06, 1.12, 1.17, 1.3)},
    **{f"changes of rotor speed x {f:g}": about_the_mean(f, "rotor_speed") for f in (0.9, 1.05, 1.1, 1.2)},
    "leak p to q 15 %": leaking(0, 1, 0.15),
    "leak q to p 5 %": leaking(1, 0, 0.05),
    "leak r to p 15 %": leaking(2, 0, 0.15),
    **{f"gyro smoothed {f:g} Hz": smoothed(f) for f in (3.0, 4.0, 4.5, 5.0)},
    "attitude 100 ms late": late("attitude", 0.1),
    "attitude 50 ms late": late("attitude", 0.05),
    "rotor 1 x 0.95": scaled("rotor_speed", 0.95, 0),
    "rotor 1 x 0.9": scaled("rotor_speed", 0.9, 0),
    "rotor 3 x 1.1": scaled("rotor_speed", 1.1, 2),
}
"""Faults from take-off of a first flight, one at a time."""
PARTS: dict[str, Spoil] = {
    "accel 1.03": scaled("accel", 1.03),
    "accel 0.97": scaled("accel", 0.97),
    "gyro 0.975": scaled("gyro", 0.975),
    "gyro 1.025": scaled("gyro", 1.025),
    "support 4 %": supported(0.04 * WEIGHT, B),
    "leak 3 %": leaking(0, 1, 0.03),
    "accel scale 1.04": about_the_mean(1.04),
    "rotor 1 x 0.97": scaled("rotor_speed", 0.97, 0),
    "attitude 40 ms late": late("attitude", 0.04),
}
"""Faults that are small enough to pass alone: in pairs and triples."""
TOGETHER = [c for n in (2, 3) for c in combinations(PARTS, n) if len({p.split()[0] for p in c}) == n]
HIDING = [
    ("support +8% of weight", "accelerometer scale 1.06 under a bias"),
    ("support +15% of weight", "accelerometer scale 1.12 under a bias"),
    ("support +15% of weight", "accelerometer scale 1.17 under a bias"),
    ("support -8% of weight", "accelerometer scale 0.9 under a bias"),
]
"""Faults that hide each other where thrust is compared: by no sensor of this flight can they be told."""
SEED = 3
SETTINGS = SessionSettings(refit=2.0)
Cell = dict[str, Any]


def cells() -> list[Cell]:
    """All cells of both tables: steps first, because they take the shortest flights."""
    out: list[tuple[str, str, float, float]] = []
    for ramp, name in product(RAMPS, CHANNELS):
        for factor in FACTORS + (STEPS if ramp == 0.0 else ()):
            out.append(("in flight", name, factor, ramp))
            if ramp == 0.0 or name == "all rotor speeds":
                out.append(("from take-off", name, factor, ramp))
    out += [("first flight", name, 1.0, 0.0) for name in (*SINGLE, *(" + ".join(c) for c in TOGETHER + HIDING))]
    return [dict(zip(("when", "channel", "factor", "ramp"), cell, strict=True)) for cell in out]


class Study:
    """One flight, a session that knows its first minute, and the set an earlier flight left."""

    def __init__(self) -> None:
        self.vehicle = Vehicle.shipped("pelican")
        self.flight: Flight = fly(self.vehicle, seconds=LEARNT + RAMPS[-1] + AFTER, seed=SEED)
        self.begin = min(float(c.t[0]) for c in self.flight.recording.channels.values())
        self.session = Session(self.vehicle, SETTINGS)
        self.healthy = fly_online(self.session, self.flight.recording, self.begin, LEARNT)

    def error(self, item: OnlineSet) -> dict[str, float]:
        """Relative errors of what must be known."""
        return {n: item.parameters[n].value / getattr(self.flight.truth.parameters, n) - 1.0 for n in MUST}

    def run(self, cell: Cell) -> Cell:
        """Flies a cell and notes the errors of what was published after the poison had begun."""
        recording, begin, end, known = self.flight.recording, self.begin, LEARNT, 0
        if cell["when"] == "first flight":
            session = Session(self.vehicle, SETTINGS)
            for name in cell["channel"].split(" + "):
                recording = (SINGLE | PARTS)[name](recording)
        else:
            if cell["when"] == "in flight":
                begin, session = LEARNT, copy.deepcopy(self.session)
            else:
                session = Session(self.vehicle, SETTINGS, self.healthy[-1], 100)
            channel, column = CHANNELS[cell["channel"]]
            recording = Poison(channel, column, cell["factor"], begin, cell["ramp"]).spoil(recording)
            known, end = len(session.poll()), begin + cell["ramp"] + AFTER
        sets = fly_online(session, recording, begin, end)
        fresh = [s for s in sets if not s.outdated and s.state.value in ("accepted", "rolled_back")]
        truth = {n: float(getattr(self.flight.truth.parameters, n)) for n in MUST}
        intervals = [(n, s.parameters[n].ci95) for s in fresh for n in MUST]
        return {
            **cell,
            "flown": time.strftime("%Y-%m-%d"),
            "sets": len(fresh),
            "worst": {n: max((self.error(s)[n] for s in fresh), key=abs, default=None) for n in MUST},
            "held": all(low <= truth[n] <= high for n, (low, high) in intervals),
            "says": session.status().reason,
            "known": known,
        }


def main() -> None:
    """Flies the cells that no earlier run has flown, until the time is over, and writes the page."""
    given = options(__doc__, minutes=240.0, only="", fresh=False)
    where = (given.out or Path("docs/results")) / "poisoning.md"
    kept = where.with_suffix(".json")
    done: list[Cell] = json.loads(kept.read_text()) if kept.exists() and not given.fresh else []
    study, until = Study(), time.monotonic() + 60.0 * given.minutes
    for cell in cells():
        known = any(all(d[k] == v for k, v in cell.items()) for d in done)
        if known or given.only not in f"{cell['when']} {cell['channel']}" or time.monotonic() > until:
            continue
        done.append(study.run(cell))
        print(done[-1], flush=True)
        kept.write_text("[\n" + ",\n".join(json.dumps(d) for d in done) + "\n]\n")
    healthy = [(s.stop, study.error(s)) for s in study.healthy]
    where.write_text(page(cells(), done, healthy, SEED) + judged(where))


GOAL = 0.05


def page(cells: list[Cell], done: list[Cell], healthy: list[tuple[float, dict[str, float]]], seed: int) -> str:
    """Markdown: what was asked, both tables, what the sessions said."""
    worst = [max((abs(v) for v in d["worst"].values() if v is not None), default=0.0) for d in done]
    held = sum(w <= GOAL for w in worst)
    first = healthy[0] if healthy else (float("nan"), {})
    lines = [
        "# Poisoned sensors",
        "",
        f"`make poisoning` (`python -m quadid_evaluation.studies.poisoning`), {time.strftime('%Y-%m-%d')}, "
        f"flight of seed {seed}, "
        f"{os.cpu_count()} cores: a simulated Pelican with one channel multiplied by a factor, at once or over a ramp, "
        "or with other faults from take-off, and an online session with default settings but a fit every 2 s.",
        "",
        f"* Cases with no published error of b, J_xx or J_yy above {GOAL:.0%}: **{held} of {len(done)}** flown "
        f"({len(cells)} in all); largest error: **{max(worst, default=0.0):.1%}**. In {sum(w > 0.0 for w in worst)} "
        "something was accepted.",
        f"* Beyond {GOAL:.0%}: **{sum(d.get('held', False) for d, w in zip(done, worst, strict=True) if w > GOAL)} of "
        f"{len(done) - held}** have the truth in the 95 % intervals that were published.",
        f"* Without poison: {len(healthy)} sets in the first 60 s, the first after {first[0]:.0f} s of flight.",
        "",
        "Largest error [%] of b, J_xx and J_yy among sets accepted after the poison began, over all factors; `–`: none "
        "was accepted. Channels without an accepted set are left out; `poisoning.json` has every case.",
        "",
    ]
    titles = {
        "in flight": "Poison after 60 s, with a set in force; the vehicle file has bare guesses",
        "from take-off": "Poison from take-off; the history has a set of a healthy flight",
        "first flight": "Faults from take-off of a first flight: nothing to compare with; alone, in pairs and triples",
    }
    for when, title in titles.items():
        asked, flown = ([c for c in part if c["when"] == when] for part in (cells, done))
        days = sorted({d.get("flown", "2026-11-24") for d in flown})
        told = f"{len(flown)} of {len(asked)} cases flown, {' to '.join(dict.fromkeys(days[:1] + days[-1:]))}."
        lines += [f"## {title}", "", told, "", *_table(asked, done), ""]
    return "\n".join(lines) + "\n"


def _table(cells: list[Cell], done: list[Cell]) -> list[str]:
    ramps, rows = sorted({c["ramp"] for c in cells}), []
    for channel in sorted({c["channel"] for c in cells}):
        key = (cells[0]["when"], channel)
        entries = [_entry([d for d in done if (d["when"], d["channel"]) == key and d["ramp"] == r]) for r in ramps]
        if set(entries) - {"", "–"}:
            rows.append((channel, *entries))
    return table(("channel", *(f"{r:g} s" if r else "at once" for r in ramps)), rows)


def _entry(flown: list[Cell]) -> str:
    """Largest error of the cases of one channel and ramp."""
    errors = [abs(v) for d in flown for v in d["worst"].values() if v is not None]
    if not errors:
        return "–" if flown else ""
    return f"**{100.0 * max(errors):.1f}**" if max(errors) > GOAL else f"{100.0 * max(errors):.1f}"


if __name__ == "__main__":
    main()
