"""The recorded flights: 155 of two Crazyflies with cut propellers, tape and weights; by library, command and fleet."""

import csv
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from quadid_replay import open_log
from scipy.stats import spearmanr

import quadid
from quadid.app.health import has_changed
from quadid.condition import FlightTrim, Health, assess, flight_trim
from quadid.errors import QuadidError
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import QUADID, share, table

CRAZYFLIE = Vehicle.shipped("crazyflie")
LARGE = 3.0
"""Cuts from this size on [mm, both blades together] must be found."""


@dataclass(frozen=True)
class Flown:
    """One recorded flight: its file, airframe, kind of log by content, what was done to it, its trim."""

    file: str
    airframe: str
    kind: str
    condition: str
    cut: tuple[float, ...]
    weight: str
    trim: FlightTrim

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
        """Checks whether the flight shows a change, be it one without a name."""
        return has_changed(self.health.to_dict())

    @property
    def named(self) -> list[int]:
        """Weak rotors in the order of the answer; empty where another cause comes first."""
        changes = self.health.changes
        if not changes or changes[0].effect != "weak_rotor":
            return []
        return [int(c.parameters[0][2]) for c in changes if c.effect == "weak_rotor"]

    @property
    def of(self) -> str:
        """State of the rotors: ``healthy``, ``large`` (cuts from `LARGE` on, glued weights), ``small``, or nothing."""
        one = self.flown
        if one.condition == "cut" and one.total >= LARGE or (one.condition == "weight" and "glued" in one.weight):
            return "large"
        small = one.condition == "tape" or (one.condition == "cut" and one.total < LARGE)
        return "small" if small else one.condition


@cache
def read(folder: Path) -> list[Flown]:
    """All flights with a trim; a file whose bytes are those of another one is left out with its label."""
    seen: set[str] = set()
    out = []
    with (folder / "labels.csv").open(encoding="utf-8") as labels:
        for row in csv.DictReader(labels):
            recording = open_log(folder / row["file"])
            if recording.sha256 in seen:
                print(f"{row['file']}: the bytes of another file, left out")
                continue
            seen.add(recording.sha256)
            kind = "controller" if "mixer_input" in recording.channels else "motor"
            # Both blades of a propeller, as in "1.5+2".
            cut = tuple(sum(float(part) for part in row[f"cut_M{j}"].split("+")[:2] if part) for j in (1, 2, 3))
            trim = flight_trim(recording, CRAZYFLIE)
            out.append(Flown(row["file"], row["drone"], kind, row["condition"], cut, row["weight"], trim))
    return out


def judge(flights: Sequence[Flown]) -> list[Judged]:
    """Each flight against the healthy ones of its airframe, of both kinds of log, itself left out."""
    healthy = [f for f in flights if f.condition == "healthy"]
    return [
        Judged(
            one, assess([one.trim], [f.trim for f in healthy if f.airframe == one.airframe and f is not one], CRAZYFLIE)
        )
        for one in flights
    ]


def is_single(one: Judged, low: float, high: float) -> bool:
    """Checks whether one propeller was cut, by `low` [mm] or more and less than `high`."""
    return one.flown.condition == "cut" and len(one.flown.rotors) == 1 and low <= one.flown.total < high


def named_first(one: Judged) -> bool:
    """Checks whether the one cut propeller comes first in the answer."""
    return one.named[:1] == list(one.flown.rotors)


def kind_right(one: Judged) -> bool:
    """Checks whether a propeller is told from a weight."""
    return bool(one.named) == (one.flown.condition == "cut")


def order(judged: Sequence[Judged], airframe: str, kind: str) -> list[Judged]:
    """Cuts and healthy flights of an airframe in one kind of log."""
    own = [j for j in judged if (j.flown.airframe, j.flown.kind) == (airframe, kind)]
    return [j for j in own if j.flown.condition in ("cut", "healthy")]


class Question(NamedTuple):
    """A question about some of the flights, the wanted rate, and the check of an answer."""

    text: str
    wanted: str
    of: Callable[[Judged], bool]
    right: Callable[[Judged], bool]

    def answers(self, flights: Sequence[Judged]) -> list[bool]:
        """Right or wrong, of the flights in question."""
        return [self.right(one) for one in flights if self.of(one)]

    def figure(self, flights: Sequence[Judged]) -> float:
        """Share of right answers; NaN of no flight."""
        right = self.answers(flights)
        return float(np.mean(right)) if right else float("nan")


QUESTIONS = (
    Question("healthy flights: unchanged", "all", lambda j: j.of == "healthy", lambda j: not j.changed),
    Question("cuts from 3 mm, glued weights: found", "≥ 95 %", lambda j: j.of == "large", lambda j: j.changed),
    Question("cuts below 3 mm and tape: found", "", lambda j: j.of == "small", lambda j: j.changed),
    Question("one propeller, 3 mm or more: named first", "≥ 95 %", lambda j: is_single(j, LARGE, 99.0), named_first),
    Question("one propeller, 1 to 2.5 mm: named first", "≥ 75 %", lambda j: is_single(j, 1.0, LARGE), named_first),
    Question(
        "two propellers, 3 mm or more each: both named",
        "≥ 85 %",
        lambda j: min(j.flown.cut[:2]) >= LARGE,
        lambda j: j.flown.rotors <= set(j.named),
    ),
    Question("propeller told from glued weight", "≥ 90 %", lambda j: j.of == "large", kind_right),
    Question("the same, of those found", "", lambda j: j.of == "large" and j.changed, kind_right),
)


def balanced(judged: Sequence[Judged]) -> float:
    """Mean of the shares of healthy flights and of large damage that are answered rightly."""
    return 0.5 * sum(q.figure(judged) for q in QUESTIONS[:2])


def _order(cuts: Sequence[Judged]) -> float:
    """Rank correlation of score and millimetres cut; NaN of few flights or several airframes."""
    if len({j.flown.airframe for j in cuts}) != 1 or len(cuts) < 3:
        return float("nan")
    return float(spearmanr([j.flown.total for j in cuts], [j.health.score for j in cuts])[0])


def recorded(folder: Path, picture: Path | None) -> list[str]:
    """Every flight against all other healthy ones of its airframe, as Markdown."""
    judged = judge(read(folder))
    if picture is not None:
        curve(judged, picture)
    healthy = [j.flown.airframe for j in judged if j.flown.condition == "healthy"]
    each = " and ".join(f"{healthy.count(name)} of {name}" for name in sorted(set(healthy)))
    orders = []
    for airframe, kind in product(("E8", "E9"), ("controller", "motor")):
        cuts = order(judged, airframe, kind)
        both = (f"{_order(part):.2f}" for part in (cuts, [j for j in cuts if j.flown.total > 0.0]))
        orders.append(f"{airframe} {kind} {' / '.join(both)}")
    answers = [(q, q.answers(judged)) for q in QUESTIONS]
    rows = [
        ("balanced accuracy of the next two", "≥ 0.95", f"{balanced(judged):.3f}"),
        *((q.text, q.wanted, share(sum(right), len(right))) for q, right in answers),
        ("rank correlation of score and mm cut (with healthy flights / cuts alone)", "≥ 0.9", "; ".join(orders)),
    ]
    return [
        "## Recorded flights",
        f"`make health`; {len(judged)} flights of two Crazyflies, each against the other healthy flights of its "
        f"airframe ({each}). Brackets: exact binomial 95 % intervals.",
        "",
        *table(("question", "wanted", "measured"), rows),
        "",
        "![Score against millimetres cut](health-score.png)",
    ]


BASELINES, SEED = 3, 3


def command(folder: Path) -> list[str]:
    """`quadid health` as a user runs it, three healthy flights as baseline, all others in question, as Markdown.

    Flights of one set (an airframe with the same rotors damaged in the same way) share their propellers, so that they
    are not independent: figures stand for each airframe, and for what they become without one of its sets.
    """
    flights, rng = read(folder), np.random.default_rng(SEED)
    judged, refused = dict[str, list[Judged]](), list[str]()
    for airframe in sorted({f.airframe for f in flights}):
        own, judged[airframe] = [f for f in flights if f.airframe == airframe], []
        healthy = [f for f in own if f.condition == "healthy"]
        chosen = [healthy[k] for k in sorted(rng.permutation(len(healthy))[:BASELINES])]
        for one in (f for f in own if f not in chosen):
            try:
                found = quadid.health(folder / one.file, [folder / f.file for f in chosen], vehicle="crazyflie").found
                judged[airframe].append(Judged(one, found))
            except QuadidError as error:
                refused.append(f"{one.file}: {error}")

    def cell(mine: Sequence[Judged], of: Callable[[Judged], bool], figure: Callable[[Sequence[Judged]], float]) -> str:
        groups = {id(j): (j.flown.condition, *sorted(j.flown.rotors)) for j in mine}
        sets = {groups[id(j)] for j in mine if of(j) and j.flown.condition != "healthy"}
        without = [figure([j for j in mine if groups[id(j)] != one]) for one in sets]
        known = [value for value in without if np.isfinite(value)]
        spread = f" ({min(known):.2f} to {max(known):.2f} without one of {len(sets)} sets)" if known else ""
        asked = sum(map(of, mine))
        return f"{figure(mine):.2f} of {asked}{spread}" if asked else "–"

    def ordered(some: Sequence[Judged]) -> float:
        return _order([j for j in some if j.flown.condition == "cut"])

    figures: list[tuple[str, Callable[[Judged], bool], Callable[[Sequence[Judged]], float]]] = [
        ("balanced accuracy", lambda j: j.of in ("large", "healthy"), balanced),
        *((q.text, q.of, q.figure) for q in QUESTIONS),
        ("rank correlation of score and mm cut", lambda j: j.flown.condition == "cut", ordered),
    ]
    rows = [(name, *(cell(mine, of, figure) for mine in judged.values())) for name, of, figure in figures]
    whole = len(refused) + sum(map(len, judged.values()))
    return [
        "## The command, three baseline flights",
        f"`quadid health` with the shipped vehicle and {BASELINES} healthy flights of the airframe, drawn once; all "
        "other flights are in question. The comparison's priors were chosen with both airframes at hand: neither row "
        "is of an airframe that nobody had seen.",
        "",
        *table(("question", *judged), rows),
        "",
        f"Refused: {len(refused)} of {whole}" + (f": {refused[0]} …" if refused else "."),
    ]


SERIES: tuple[tuple[str, str, frozenset[int]], ...] = (
    ("E8, M3", "E8", frozenset({3})),
    ("E9, M3", "E9", frozenset({3})),
    ("E9, M1 and M2", "E9", frozenset({1, 2})),
)
"""Vehicles of the fleet: name, airframe and the rotors that are cut ever shorter."""
_DAY, _FIRST = 86400.0, 1.7e9


def fleet(data: Path) -> list[str]:
    """The trend that `quadid fleet` shows an owner: healthy flights of an airframe first, then cuts by size."""
    flights = read(data)
    with TemporaryDirectory() as place:
        logs, out = Path(place) / "logs", Path(place) / "out"
        out.mkdir()
        for name, airframe, rotors in SERIES:
            (logs / name).mkdir(parents=True)
            mine = [f for f in flights if f.airframe == airframe]
            mine = [f for f in mine if f.condition == "healthy" or f.condition == "cut" and f.rotors == rotors]
            for k, flown in enumerate(sorted(mine, key=lambda f: (f.total, f.file))):
                copy = shutil.copy(data / flown.file, logs / name)
                os.utime(copy, (_FIRST + _DAY * k, _FIRST + _DAY * k))
        command = [QUADID, "fleet", logs, "--vehicle", "crazyflie", "--out", out, "--json", out / "fleet.json"]
        subprocess.run([*map(str, command)], check=True, stdout=subprocess.DEVNULL)
        found = json.loads((out / "fleet.json").read_text(encoding="utf-8"))["health"]
    millimetres, rows = {f.file: f.total for f in flights}, []
    for name, *_ in SERIES:
        of_unit = [row for row in found if row["unit"] == name]
        later = [(millimetres[Path(r["log"]).name], has_changed(r), r["score"]) for r in of_unit if not r["baseline"]]
        groups = (
            [c for mm, c, _ in later if low <= mm < high] for low, high in ((0.0, 0.1), (0.1, LARGE), (LARGE, 99.0))
        )
        missed = max((mm for mm, c, _ in later if not c), default=-1.0)
        first = next((f"{mm:g}" for mm, c, _ in later if c), "none")
        after = next((f"{mm:g}" for mm, *_ in later if mm > missed), "none")
        correlation = spearmanr([mm for mm, *_ in later], [score for *_, score in later])[0]
        counts = f"{len(of_unit)} ({len(of_unit) - len(later)})", ", ".join(f"{sum(g)} of {len(g)}" for g in groups)
        rows.append((name, *counts, f"{first}, {after}", f"{correlation:.2f}"))
    changed = "changed: healthy, below 3 mm, from 3 mm"
    return [
        "## Trend of a fleet",
        "`quadid fleet`, called by `make health`: the first five flights are the baseline, the others follow by "
        "millimetres cut; order: Spearman correlation of score and cut.",
        "",
        *table(("vehicle", "flights (baseline)", changed, "first, all from [mm]", "order"), rows),
    ]


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
