"""The command as a user runs it: three healthy flights of the airframe as baseline, every other flight in question.

Figures stand for each airframe by itself, and for what they become when one set of propellers (flights of one airframe
with the same rotors damaged in the same way) is left out: flights of one set share their propellers, so that they are
not independent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

import quadid
from quadid.errors import QuadidError
from quadid_evaluation.studies.health.recorded import Flown, Judged, is_large, is_single, named_first

BASELINES = 3
SEED = 3
Figure = Callable[[Sequence[Judged]], float]


def judge(flights: Sequence[Flown], folder: Path) -> tuple[list[Judged], list[str]]:
    """Answers of the command to all flights but the baselines, and what was refused."""
    rng = np.random.default_rng(SEED)
    out, refused = [], []
    for airframe in sorted({f.airframe for f in flights}):
        own = [f for f in flights if f.airframe == airframe]
        healthy = [f for f in own if f.condition == "healthy"]
        chosen = [healthy[k] for k in sorted(rng.permutation(len(healthy))[:BASELINES])]
        baseline = [folder / f.file for f in chosen]
        for one in own:
            if one in chosen:
                continue
            try:
                out.append(Judged(one, quadid.health(folder / one.file, baseline, vehicle="crazyflie").found))
            except QuadidError as error:
                refused.append(f"{one.file}: {error}")
    return out, refused


def _set_of(one: Judged) -> tuple[str, str, tuple[int, ...]]:
    return one.flown.airframe, one.flown.condition, tuple(sorted(one.flown.rotors))


def _share(wanted: Callable[[Judged], bool], right: Callable[[Judged], bool]) -> Figure:
    def figure(judged: Sequence[Judged]) -> float:
        of = [right(one) for one in judged if wanted(one)]
        return float(np.mean(of)) if of else float("nan")

    return figure


def _balanced(judged: Sequence[Judged]) -> float:
    large = _share(lambda j: is_large(j.flown), lambda j: j.changed)(judged)
    healthy = _share(lambda j: j.flown.condition == "healthy", lambda j: not j.changed)(judged)
    return 0.5 * (large + healthy)


def _order(judged: Sequence[Judged]) -> float:
    cuts = [j for j in judged if j.flown.condition == "cut"]
    if len({j.flown.airframe for j in cuts}) != 1 or len(cuts) < 3:
        return float("nan")
    return float(spearmanr([j.flown.total for j in cuts], [j.health.score for j in cuts])[0])


FIGURES: tuple[tuple[str, Callable[[Judged], bool], Figure], ...] = (
    ("balanced accuracy", lambda j: is_large(j.flown) or j.flown.condition == "healthy", _balanced),
    ("cuts from 3 mm and glued weights found", lambda j: is_large(j.flown),
     _share(lambda j: is_large(j.flown), lambda j: j.changed)),
    ("one propeller, 3 mm or more: named first", lambda j: is_single(j, 3.0, 99.0),
     _share(lambda j: is_single(j, 3.0, 99.0), named_first)),
    ("one propeller, 1 to 2.5 mm: named first", lambda j: is_single(j, 1.0, 3.0),
     _share(lambda j: is_single(j, 1.0, 3.0), named_first)),
    ("two propellers, 3 mm or more each: both named", lambda j: min(j.flown.cut[:2]) >= 3.0,
     _share(lambda j: min(j.flown.cut[:2]) >= 3.0, lambda j: j.flown.rotors <= set(j.named))),
    ("order of cuts by score (Spearman)", lambda j: j.flown.condition == "cut", _order),
)  # fmt: skip


def text(flights: Sequence[Flown], folder: Path) -> str:
    """The table: each airframe, and the range when one set of propellers is left out."""
    judged, refused = judge(flights, folder)
    airframes = sorted({j.flown.airframe for j in judged})
    lines = [f"| question | {' | '.join(airframes)} |", "|---" * (len(airframes) + 1) + "|"]
    for name, of, figure in FIGURES:
        cells = []
        for airframe in airframes:
            own = [j for j in judged if j.flown.airframe == airframe]
            sets = sorted({_set_of(j) for j in own if of(j) and j.flown.condition != "healthy"})
            without = [figure([j for j in own if _set_of(j) != left]) for left in sets]
            known = [value for value in without if np.isfinite(value)]
            spread = f" ({min(known):.2f} to {max(known):.2f} without one of {len(sets)} sets)" if known else ""
            cells.append(f"{figure(own):.2f} of {sum(map(of, own))}{spread}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    told = f"Refused: {len(refused)} of {len(judged) + len(refused)}" + ("." if not refused else f": {refused[0]} …")
    return "\n".join([*lines, "", told])
