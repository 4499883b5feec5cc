"""The recorded flights: 155 of two Crazyflies with cut propellers, tape and weights; every row of the wanted table."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binomtest, spearmanr

from quadid.app.health import has_changed
from quadid.app.logs import open_recording
from quadid.condition import FlightTrim, Health, assess, flight_trim
from quadid.data.window import Recording
from quadid.vehicle import Vehicle

CRAZYFLIE = Vehicle.shipped("crazyflie")
LARGE = 3.0
"""Cuts from this size on [mm, both blades together] must be found."""


@dataclass(frozen=True)
class Flown:
    """One recorded flight: its file, airframe, kind of log by content, what was done to it, its trim and the log.

    `uneven`: a propeller's two blades were cut unlike.
    """

    file: str
    airframe: str
    kind: str
    condition: str
    cut: tuple[float, float, float]
    uneven: bool
    weight: str
    trim: FlightTrim
    recording: Recording

    @property
    def total(self) -> float:
        """Millimetres cut in all."""
        return sum(self.cut)

    @property
    def rotors(self) -> set[int]:
        """Rotors with a cut propeller, from 1."""
        return {j + 1 for j, size in enumerate(self.cut) if size > 0.0}


@dataclass(frozen=True)
class Judged:
    """A flight and what the comparison with the healthy flights of its airframe says, itself left out."""

    flown: Flown
    health: Health

    @property
    def changed(self) -> bool:
        """Whether the flight shows a change, be it one without a name."""
        return has_changed(self.health.to_dict())

    @property
    def named(self) -> list[int]:
        """Weak rotors in the order of the answer; empty where another cause comes first."""
        changes = self.health.changes
        if not changes or changes[0].effect != "weak_rotor":
            return []
        return [int(c.parameters[0][2]) for c in changes if c.effect == "weak_rotor"]


def read(folder: Path) -> list[Flown]:
    """All flights with a trim; a file whose bytes are those of another one is left out with its label."""
    seen: set[str] = set()
    out = []
    with (folder / "labels.csv").open(encoding="utf-8") as table:
        for row in csv.DictReader(table):
            recording = open_recording(folder / row["file"])
            if recording.sha256 in seen:
                print(f"{row['file']}: the bytes of another file, left out")
                continue
            seen.add(recording.sha256)
            kind = "controller" if "mixer_input" in recording.channels else "motor"
            blades = [_blades(row[f"cut_M{j}"]) for j in (1, 2, 3)]
            first, second, third = (sum(pair) for pair in blades)
            trim, uneven = flight_trim(recording, CRAZYFLIE), any(a != b for a, b in blades)
            out.append(Flown(row["file"], row["drone"], kind, row["condition"], (first, second, third), uneven,
                             row["weight"], trim, recording))  # fmt: skip
    return out


def _blades(text: str) -> tuple[float, float]:
    """Millimetres cut from either blade."""
    one, other, *_ = [*(float(part) for part in text.split("+") if part), 0.0, 0.0]
    return one, other


def judge(flights: Sequence[Flown]) -> list[Judged]:
    """Each flight against the healthy ones of its airframe, of both kinds of log, itself left out."""
    out = []
    for one in flights:
        healthy = [
            f.trim for f in flights if f.airframe == one.airframe and f.condition == "healthy" and f.file != one.file
        ]
        out.append(Judged(one, assess([one.trim], healthy, CRAZYFLIE)))
    return out


def is_large(one: Flown) -> bool:
    """Whether a flight's damage must be found: cuts from `LARGE` on, glued weights."""
    return one.condition == "cut" and one.total >= LARGE or (one.condition == "weight" and "glued" in one.weight)


def _small(one: Judged) -> bool:
    return one.flown.condition == "tape" or (one.flown.condition == "cut" and one.flown.total < LARGE)


def is_single(one: Judged, low: float, high: float) -> bool:
    """Whether one propeller was cut, by `low` [mm] or more and less than `high`."""
    return one.flown.condition == "cut" and len(one.flown.rotors) == 1 and low <= one.flown.total < high


def _share(of: Sequence[Judged], right: Callable[[Judged], bool]) -> str:
    hits = sum(right(one) for one in of)
    if not of:
        return "none here"
    low, high = (100.0 * bound for bound in binomtest(hits, len(of)).proportion_ci())
    return f"{hits} of {len(of)} ({low:.0f} to {high:.0f} %)"


def _balanced(judged: Sequence[Judged]) -> str:
    large = [one.changed for one in judged if is_large(one.flown)]
    healthy = [not one.changed for one in judged if one.flown.condition == "healthy"]
    accuracy = 0.5 * (np.mean(large) + np.mean(healthy))
    alarms = len(healthy) - sum(healthy)
    return f"{accuracy:.3f}: {sum(large)} of {len(large)} found, {alarms} of {len(healthy)} false alarms"


def named_first(one: Judged) -> bool:
    """Whether the one cut propeller comes first in the answer."""
    return one.named[:1] == list(one.flown.rotors)


def kind_right(one: Judged) -> bool:
    """Whether a propeller is told from a weight."""
    rotor = bool(one.health.changes) and one.health.changes[0].effect == "weak_rotor"
    return rotor == (one.flown.condition == "cut")


def order(judged: Sequence[Judged], airframe: str, kind: str) -> list[Judged]:
    """Cuts and healthy flights of an airframe in one kind of log."""
    return [
        j for j in judged
        if (j.flown.airframe, j.flown.kind) == (airframe, kind) and j.flown.condition in ("cut", "healthy")
    ]  # fmt: skip


def _orders(judged: Sequence[Judged]) -> str:
    parts = []
    for airframe in ("E8", "E9"):
        for kind in ("controller", "motor"):
            cuts = order(judged, airframe, kind)
            some = [j for j in cuts if j.flown.total > 0.0]
            both = (
                spearmanr([j.flown.total for j in part], [j.health.score for j in part])[0] for part in (cuts, some)
            )
            parts.append(f"{airframe} {kind} " + " / ".join(f"{value:.2f}" for value in both))
    return "; ".join(parts)


Row = tuple[str, str, Callable[[Sequence[Judged]], str]]
ROWS: tuple[Row, ...] = (
    ("cuts from 3 mm, glued weights: balanced accuracy", "≥ 0.95, no false alarm", _balanced),
    ("cuts below 3 mm and tape: found", "",
     lambda all_: _share([j for j in all_ if _small(j)], lambda j: j.changed)),
    ("one propeller, 3 mm or more: rotor named first", "≥ 95 %",
     lambda all_: _share([j for j in all_ if is_single(j, 3.0, 99.0)], named_first)),
    ("one propeller, 1 to 2.5 mm: rotor named first", "≥ 75 %",
     lambda all_: _share([j for j in all_ if is_single(j, 1.0, 3.0)], named_first)),
    ("two propellers, 3 mm or more each: both named", "≥ 85 %",
     lambda all_: _share([j for j in all_ if min(j.flown.cut[:2]) >= 3.0], lambda j: j.flown.rotors <= set(j.named))),
    ("propeller told from glued weight, all", "≥ 90 %",
     lambda all_: _share([j for j in all_ if is_large(j.flown)], kind_right)),
    ("the same, of those found", "",
     lambda all_: _share([j for j in all_ if is_large(j.flown) and j.changed], kind_right)),
    ("Spearman correlation of score and mm cut (with healthy flights / cuts alone)", "≥ 0.9", _orders),
)  # fmt: skip


def table(judged: Sequence[Judged]) -> str:
    """The wanted table as Markdown."""
    lines = ["| question | wanted | measured |", "|---|---|---|"]
    lines += [f"| {question} | {wanted} | {measure(judged)} |" for question, wanted, measure in ROWS]
    return "\n".join(lines)


def confusion(judged: Sequence[Judged]) -> str:
    """What was done against what is answered."""
    answers = ("unchanged", "M1", "M2", "M3", "M4", "two rotors", "three rotors", "weight or CG", "effort", "unknown",
               "too few baseline flights")  # fmt: skip
    count: dict[str, dict[str, int]] = {}
    for one in judged:
        done = _done(one.flown)
        row = count.setdefault(done, dict.fromkeys(answers, 0))
        row[_answer(one)] += 1
    lines = ["| done | answers |", "|---|---|"]
    for done in sorted(count):
        lines.append(f"| {done} | " + ", ".join(f"{number} {a}" for a, number in count[done].items() if number) + " |")
    return "\n".join(lines)


def _done(flown: Flown) -> str:
    if flown.condition == "cut":
        which = " and ".join(f"M{j}" for j in sorted(flown.rotors))
        return f"cut {which}, {'3 mm and more' if flown.total >= LARGE else 'less than 3 mm'}"
    return f"weight, {'glued' if 'glued' in flown.weight else 'on a string'}" if flown.weight else flown.condition


def _answer(one: Judged) -> str:
    if not one.changed:
        return "too few baseline flights" if one.health.lacking else "unchanged"
    if one.health.verdict == "unknown":
        return "unknown"
    if one.named:
        return f"M{one.named[0]}" if len(one.named) == 1 else ("two rotors", "three rotors")[len(one.named) - 2]
    return "effort" if one.health.changes[0].effect == "thrust_drop" else "weight or CG"


def curve(judged: Sequence[Judged], path: Path) -> None:
    """Draws score against millimetres cut, for both airframes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9.0, 3.6), sharey=True)
    for axis, airframe in zip(axes, ("E8", "E9"), strict=True):
        for kind, mark in (("controller", "o"), ("motor", "x")):
            cuts = order(judged, airframe, kind)
            axis.plot([j.flown.total for j in cuts], [j.health.score for j in cuts], mark, label=f"{kind} log")
        axis.set(xlabel="mm cut in all", title=airframe)
        axis.legend()
    axes[0].set_ylabel("score")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
