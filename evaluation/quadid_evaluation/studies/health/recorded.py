"""The recorded flights: 155 of two Crazyflies with cut propellers, tape and weights; by library, command and fleet."""

import csv
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from quadid_replay import open_log
from scipy.stats import spearmanr

import quadid
from quadid.app.health import has_changed
from quadid.condition import FlightTrim, Health, assess, flight_trim
from quadid.data.window import Recording
from quadid.errors import QuadidError
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import QUADID, share, table

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
        """Checks whether the flight shows a change, be it one without a name."""
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
            recording = open_log(folder / row["file"])
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
    """Checks whether a flight's damage must be found: cuts from `LARGE` on, glued weights."""
    return one.condition == "cut" and one.total >= LARGE or (one.condition == "weight" and "glued" in one.weight)


def _small(one: Judged) -> bool:
    return one.flown.condition == "tape" or (one.flown.condition == "cut" and one.flown.total < LARGE)


def is_single(one: Judged, low: float, high: float) -> bool:
    """Checks whether one propeller was cut, by `low` [mm] or more and less than `high`."""
    return one.flown.condition == "cut" and len(one.flown.rotors) == 1 and low <= one.flown.total < high


def named_first(one: Judged) -> bool:
    """Checks whether the one cut propeller comes first in the answer."""
    return one.named[:1] == list(one.flown.rotors)


def kind_right(one: Judged) -> bool:
    """Checks whether a propeller is told from a weight."""
    rotor = bool(one.health.changes) and one.health.changes[0].effect == "weak_rotor"
    return rotor == (one.flown.condition == "cut")


def order(judged: Sequence[Judged], airframe: str, kind: str) -> list[Judged]:
    """Cuts and healthy flights of an airframe in one kind of log."""
    return [
        j
        for j in judged
        if (j.flown.airframe, j.flown.kind) == (airframe, kind) and j.flown.condition in ("cut", "healthy")
    ]


@dataclass(frozen=True)
class Question:
    """A question about some of the flights, the wanted rate, and the check of an answer."""

    text: str
    wanted: str
    of: Callable[[Judged], bool]
    right: Callable[[Judged], bool]

    def figure(self, flights: Sequence[Judged]) -> float:
        """Share of right answers; NaN of no flight."""
        right = [self.right(one) for one in flights if self.of(one)]
        return float(np.mean(right)) if right else float("nan")

    def told(self, flights: Sequence[Judged]) -> str:
        """The share with its interval."""
        right = [self.right(one) for one in flights if self.of(one)]
        return share(sum(right), len(right))


QUESTIONS = (
    Question("healthy flights: unchanged", "all", lambda j: j.flown.condition == "healthy", lambda j: not j.changed),
    Question("cuts from 3 mm, glued weights: found", "≥ 95 %", lambda j: is_large(j.flown), lambda j: j.changed),
    Question("cuts below 3 mm and tape: found", "", _small, lambda j: j.changed),
    Question("one propeller, 3 mm or more: named first", "≥ 95 %", lambda j: is_single(j, LARGE, 99.0), named_first),
    Question("one propeller, 1 to 2.5 mm: named first", "≥ 75 %", lambda j: is_single(j, 1.0, LARGE), named_first),
    Question(
        "two propellers, 3 mm or more each: both named",
        "≥ 85 %",
        lambda j: min(j.flown.cut[:2]) >= LARGE,
        lambda j: j.flown.rotors <= set(j.named),
    ),
    Question("propeller told from glued weight", "≥ 90 %", lambda j: is_large(j.flown), kind_right),
    Question("the same, of those found", "", lambda j: is_large(j.flown) and j.changed, kind_right),
)


def balanced(judged: Sequence[Judged]) -> float:
    """Mean of the shares of healthy flights and of large damage that are answered rightly."""
    return 0.5 * sum(q.figure(judged) for q in QUESTIONS[:2])


def _order(cuts: Sequence[Judged]) -> float:
    """Rank correlation of score and millimetres cut; NaN of few flights or several airframes."""
    if len({j.flown.airframe for j in cuts}) != 1 or len(cuts) < 3:
        return float("nan")
    return float(spearmanr([j.flown.total for j in cuts], [j.health.score for j in cuts])[0])


def recorded(judged: Sequence[Judged], picture: Path | None) -> str:
    """Every flight against all other healthy ones of its airframe, as Markdown."""
    if picture is not None:
        curve(judged, picture)
    healthy = [j.flown.airframe for j in judged if j.flown.condition == "healthy"]
    each = " and ".join(f"{healthy.count(name)} of {name}" for name in sorted(set(healthy)))
    orders = []
    for airframe, kind in product(("E8", "E9"), ("controller", "motor")):
        cuts = order(judged, airframe, kind)
        both = (f"{_order(part):.2f}" for part in (cuts, [j for j in cuts if j.flown.total > 0.0]))
        orders.append(f"{airframe} {kind} {' / '.join(both)}")
    rows = [
        ("balanced accuracy of the next two", "≥ 0.95", f"{balanced(judged):.3f}"),
        *((q.text, q.wanted, q.told(judged)) for q in QUESTIONS),
        ("rank correlation of score and mm cut (with healthy flights / cuts alone)", "≥ 0.9", "; ".join(orders)),
    ]
    return "\n".join(
        [
            "## Recorded flights",
            f"`make health`; {len(judged)} flights of two Crazyflies, each against the other healthy flights of its "
            f"airframe ({each}). Brackets: exact binomial 95 % intervals.",
            "",
            *table(("question", "wanted", "measured"), rows),
            "",
            "![Score against millimetres cut](health-score.png)",
        ]
    )


BASELINES, SEED = 3, 3


def command(flights: Sequence[Flown], folder: Path) -> str:
    """`quadid health` as a user runs it, three healthy flights as baseline, all others in question, as Markdown.

    Flights of one set (an airframe with the same rotors damaged in the same way) share their propellers, so that they
    are not independent: figures stand for each airframe, and for what they become without one of its sets.
    """
    rng = np.random.default_rng(SEED)
    judged, refused = list[Judged](), list[str]()
    airframes = sorted({f.airframe for f in flights})
    for airframe in airframes:
        own = [f for f in flights if f.airframe == airframe]
        healthy = [f for f in own if f.condition == "healthy"]
        chosen = [healthy[k] for k in sorted(rng.permutation(len(healthy))[:BASELINES])]
        for one in (f for f in own if f not in chosen):
            try:
                found = quadid.health(folder / one.file, [folder / f.file for f in chosen], vehicle="crazyflie").found
                judged.append(Judged(one, found))
            except QuadidError as error:
                refused.append(f"{one.file}: {error}")
    figures: list[tuple[str, Callable[[Judged], bool], Callable[[Sequence[Judged]], float]]] = [
        ("balanced accuracy", lambda j: is_large(j.flown) or j.flown.condition == "healthy", balanced),
        *((q.text, q.of, q.figure) for q in QUESTIONS),
        (
            "rank correlation of score and mm cut",
            lambda j: j.flown.condition == "cut",
            lambda some: _order([j for j in some if j.flown.condition == "cut"]),
        ),
    ]
    rows = []
    for name, of, figure in figures:
        cells = [name]
        for airframe in airframes:
            mine = [j for j in judged if j.flown.airframe == airframe]
            sets = {(j.flown.condition, *sorted(j.flown.rotors)) for j in mine if of(j)}
            sets = {one for one in sets if one[0] != "healthy"}
            without = [figure([j for j in mine if (j.flown.condition, *sorted(j.flown.rotors)) != s]) for s in sets]
            known = [value for value in without if np.isfinite(value)]
            spread = f" ({min(known):.2f} to {max(known):.2f} without one of {len(sets)} sets)" if known else ""
            asked = sum(map(of, mine))
            cells.append(f"{figure(mine):.2f} of {asked}{spread}" if asked else "–")
        rows.append(cells)
    return "\n".join(
        [
            "## The command, three baseline flights",
            f"`quadid health` with the shipped vehicle and {BASELINES} healthy flights of the airframe, drawn once; "
            "all other flights are in question. The comparison's priors were chosen with both airframes at hand: "
            "neither row is of an airframe that nobody had seen.",
            "",
            *table(("question", *airframes), rows),
            "",
            f"Refused: {len(refused)} of {len(judged) + len(refused)}" + (f": {refused[0]} …" if refused else "."),
        ]
    )


SERIES: tuple[tuple[str, str, frozenset[int]], ...] = (
    ("E8, M3", "E8", frozenset({3})),
    ("E9, M3", "E9", frozenset({3})),
    ("E9, M1 and M2", "E9", frozenset({1, 2})),
)
"""Vehicles of the fleet: name, airframe and the rotors that are cut ever shorter."""
_DAY, _FIRST = 86400.0, 1.7e9


def fleet(flights: Sequence[Flown], data: Path) -> str:
    """The trend that `quadid fleet` shows an owner: healthy flights of an airframe first, then cuts by size."""
    with TemporaryDirectory() as place:
        logs, out = Path(place) / "logs", Path(place) / "out"
        out.mkdir()
        for name, airframe, rotors in SERIES:
            (logs / name).mkdir(parents=True)
            mine = [f for f in flights if f.airframe == airframe and f.condition in ("healthy", "cut")]
            mine = [f for f in mine if f.condition == "healthy" or f.rotors == rotors]
            for k, flown in enumerate(sorted(mine, key=lambda f: (f.total, f.file))):
                copy = shutil.copy(data / flown.file, logs / name)
                os.utime(copy, (_FIRST + _DAY * k, _FIRST + _DAY * k))
        command = [QUADID, "fleet", str(logs), "--vehicle", "crazyflie"]
        subprocess.run(
            [*command, "--out", str(out), "--json", str(out / "fleet.json")], check=True, stdout=subprocess.DEVNULL
        )
        found = json.loads((out / "fleet.json").read_text(encoding="utf-8"))["health"]
    millimetres, rows = {f.file: f.total for f in flights}, []
    for name, *_ in SERIES:
        of_unit = [row for row in found if row["unit"] == name]
        later = [(millimetres[Path(row["log"]).name], row) for row in of_unit if not row["baseline"]]
        changed = [(mm, has_changed(row)) for mm, row in later]
        groups = (
            [c for mm, c in changed if low <= mm < high] for low, high in ((0.0, 0.1), (0.1, LARGE), (LARGE, 99.0))
        )
        missed = max((mm for mm, c in changed if not c), default=-1.0)
        first = next((f"{mm:g}" for mm, c in changed if c), "none")
        after = next((f"{mm:g}" for mm, _ in changed if mm > missed), "none")
        correlation = spearmanr([mm for mm, _ in later], [row["score"] for _, row in later])[0]
        rows.append(
            (
                name,
                f"{len(of_unit)} ({len(of_unit) - len(later)})",
                ", ".join(f"{sum(g)} of {len(g)}" for g in groups),
                f"{first}, {after}",
                f"{correlation:.2f}",
            )
        )
    heads = (
        "vehicle",
        "flights (baseline)",
        "changed: healthy, below 3 mm, from 3 mm",
        "first, all from [mm]",
        "order",
    )
    return "\n".join(
        [
            "## Trend of a fleet",
            "`quadid fleet`, called by `make health`: the first five flights are the baseline, the others follow by "
            "millimetres cut; order: Spearman correlation of score and cut.",
            "",
            *table(heads, rows),
        ]
    )


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
