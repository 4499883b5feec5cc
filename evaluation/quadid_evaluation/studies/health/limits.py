"""What the spread of healthy flights forbids: the same questions when every cut does just what the mean cut does.

Healthy flights differ mostly by their propellers.  Of an airframe whose M3 was cut ever shorter three propellers
stayed, so its flights share a draw from the healthy spread; their counts are compared with counts of such draws.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import ceil
from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr

from quadid.condition import FlightTrim, Health, Healthy, assess, healthy_spread
from quadid.condition.changes import SIGNIFICANT, distance, rotor_effect
from quadid.types import BoolArray, FloatArray
from quadid_evaluation.studies.health.recorded import (
    CRAZYFLIE,
    LARGE,
    Flown,
    Judged,
    is_large,
    is_single,
    kind_right,
    named_first,
    order,
)

AIRFRAMES = ("E8", "E9")
CUT = 2
"""The rotor whose propeller was cut alone, from 0."""
WANTED = 0.9
"""Rank correlation of score and size."""
DRAWS, ASSESSED = 4000, 50
"""Draws from the healthy spread, and the first of these that the comparison itself is asked about."""


class Answers(NamedTuple):
    """What draws of one size are answered: called changed, M3 first, a rotor and not a weight; shape (draws,) each."""

    changed: BoolArray
    first: BoolArray
    rotor: BoolArray


Row = tuple[str, float, Callable[[Judged], bool], Callable[[Judged], bool], str]
ROWS: tuple[Row, ...] = (
    ("found, 3 mm and more", 0.95, lambda j: is_single(j, LARGE, 99.0), lambda j: j.changed, "changed"),
    ("rotor named first, 3 mm and more", 0.95, lambda j: is_single(j, LARGE, 99.0), named_first, "first"),
    ("rotor named first, 1 to 2.5 mm", 0.75, lambda j: is_single(j, 1.0, LARGE), named_first, "first"),
    ("a propeller, not a weight, 3 mm and more", 0.9, lambda j: is_single(j, LARGE, 99.0), kind_right, "rotor"),
)  # fmt: skip


class Limits:
    """Draws from the healthy spread of every airframe, and what cuts of a mean size do.

    Attributes:
        light: loss of thrust per millimetre of a cut below `LARGE`.
        large: of a larger one.
        healthy: of each airframe.
        noise: what the trims of its flights differ from the healthy mean by, shape (draws, 4).
    """

    def __init__(self, judged: Sequence[Judged]) -> None:
        """Measures the loss, and draws."""
        self._judged = judged
        self.light, self.large = (
            loss_per_mm([j for j in judged if is_single(j, low, high)]) for low, high in ((0.0, LARGE), (LARGE, 99.0))
        )
        self.healthy = {name: healthy_spread(self.baseline(name)) for name in AIRFRAMES}
        rng = np.random.default_rng(1)
        self.noise = {
            name: one.predictive(1) * rng.standard_t(one.freedom, size=(DRAWS, 4)) for name, one in self.healthy.items()
        }

    def baseline(self, airframe: str) -> list[FlightTrim]:
        """Its healthy flights."""
        return [j.flown.trim for j in self._judged if j.flown.airframe == airframe and j.flown.condition == "healthy"]

    def loss(self, millimetres: float) -> float:
        """Of thrust, as the mean cut of this size has it."""
        return millimetres * (self.light if millimetres < LARGE else self.large)

    def moved(self, flown: Flown) -> FloatArray:
        """Change of trim that the flight's cuts make, shape (4,)."""
        healthy = self.healthy[flown.airframe]
        each = [self.loss(size) * cut_effect(healthy, j) for j, size in enumerate(flown.cut)]
        return np.asarray(np.sum(each, axis=0))

    def told(self, airframe: str, loss: float) -> BoolArray:
        """Whether M3 is likelier than any other rotor, with all of the spread and the loss known, shape (draws,).

        No test of the trims names it more often.
        """
        healthy = self.healthy[airframe]
        effects = loss * np.stack([cut_effect(healthy, j) for j in range(len(CRAZYFLIE.rotors))])
        rest = (self.noise[airframe] + effects[CUT])[:, None] - effects
        z, v = rest / healthy.predictive(1), healthy.freedom
        likelihood = (-0.5 * (v + 1.0) * np.log1p(z**2 / v)).sum(axis=2)
        return np.asarray(likelihood.argmax(axis=1) == CUT)

    def answered(self, airframe: str, moved: FloatArray) -> Answers:
        """What the comparison says of the first draws where all are moved by `moved`, shape (4,)."""
        baseline, mean = self.baseline(airframe), self.healthy[airframe].mean
        out = []
        for noise in self.noise[airframe][:ASSESSED]:
            found: Health = assess([baseline[0]._replace(mean=mean + moved + noise)], baseline, CRAZYFLIE)
            weak = bool(found.changes) and found.changes[0].effect == "weak_rotor"
            first = weak and found.changes[0].parameters[0][2] == CUT + 1.0
            out.append((found.p_value < SIGNIFICANT, first, weak))
        return Answers(*np.array(out).T)

    def orders(self, airframe: str, kind: str) -> FloatArray:
        """Rank correlations of score and size where every flight differs from the last by `_again` too, (draws,)."""
        flown = [j.flown for j in order(self._judged, airframe, kind)]
        healthy, rng = self.healthy[airframe], np.random.default_rng(3)
        again, own = _again(self._judged, airframe), np.array([f.condition == "healthy" for f in flown])
        sizes, moved = [f.total for f in flown], np.array([self.moved(f) for f in flown])
        out = []
        for shared in self.noise[airframe][:500]:
            apart = healthy.predictive(1) * rng.standard_t(healthy.freedom, size=moved.shape)
            change = moved + np.where(own[:, None], apart, shared + again * rng.normal(size=moved.shape))
            far = distance(change, healthy.predictive(1), healthy.freedom)
            out.append(spearmanr(sizes, np.sqrt((far**2).sum(axis=1)))[0])
        return np.array(out)


def loss_per_mm(judged: Sequence[Judged]) -> float:
    """Loss of thrust per millimetre cut from one propeller, least squares through zero over these single cuts.

    Each change of trim is projected on what a cut does, weighted with the healthy spread.
    """
    pairs = []
    for j in judged:
        healthy = j.health.healthy
        effect = cut_effect(healthy, next(iter(j.flown.rotors)) - 1) / healthy.deviation
        change = (j.health.trim - healthy.mean) / healthy.deviation
        pairs.append((j.flown.total, effect @ change / (effect @ effect)))
    sizes, losses = np.array(pairs).T
    return float(sizes @ losses / (sizes @ sizes))


def cut_effect(healthy: Healthy, rotor: int) -> FloatArray:
    """Change of trim per loss of thrust and as much drag torque of a rotor, shape (4,)."""
    return np.asarray(rotor_effect(CRAZYFLIE, rotor, float(healthy.shares[rotor]), healthy.mean).sum(axis=1))


def _counted(flown: Sequence[Flown], right: Callable[[str, float], BoolArray]) -> FloatArray:
    """How many of these flights are right in draws, where those of an airframe share a draw, shape (draws,)."""
    rng = np.random.default_rng(2)
    counts = np.zeros(DRAWS)
    for airframe in AIRFRAMES:
        mine = np.sum([right(airframe, f.total) for f in flown if f.airframe == airframe], axis=0)
        counts += rng.choice(mine, len(counts))
    return counts


def spread_of(values: FloatArray, mean: str, bounds: str) -> str:
    """Mean and 95 % of draws in words."""
    low, high = np.quantile(values, [0.025, 0.975])
    return f"{values.mean():{mean}} ({low:{bounds}} to {high:{bounds}})"


def _answer(answers: Mapping[tuple[str, float], Answers], column: str, airframe: str, size: float) -> BoolArray:
    """One of the answers to cuts of a size, shape (draws,)."""
    chosen: BoolArray = getattr(answers[airframe, size], column)
    return chosen


def text(judged: Sequence[Judged]) -> str:
    """The limits as Markdown."""
    limits = Limits(judged)
    single = [j for j in judged if is_single(j, 0.0, 99.0) and j.flown.rotors == {CUT + 1}]
    cuts = {(j.flown.airframe, j.flown.total): limits.moved(j.flown) for j in single}
    answers = {(airframe, size): limits.answered(airframe, moved) for (airframe, size), moved in cuts.items()}
    lines = [
        f"A single cut below {LARGE:g} mm costs {100.0 * limits.light:.1f} % of thrust per millimetre, a larger one "
        f"{100.0 * limits.large:.1f} % (least squares). With exactly these losses and the spread of healthy flights "
        "(means, 95 % of draws):\n",
        "| single cuts | wanted | this comparison | at best | wanted is reached in | measured (chance of as few) |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    reached = {}
    for what, share, chosen, right, column in ROWS:
        mine = [j for j in single if chosen(j)]
        flown, wanted = [j.flown for j in mine], ceil(share * len(mine))
        ours = _counted(flown, partial(_answer, answers, column))
        best = _counted(flown, lambda airframe, size: limits.told(airframe, limits.loss(size)))
        reached[what] = float(np.mean(best >= wanted))
        told = (spread_of(best, ".1f", ".0f"), f"{100.0 * reached[what]:.0f} %")
        told = told if column == "first" else ("–", "–")
        count = sum(right(j) for j in mine)
        few = f"{count} of {len(mine)} ({100.0 * np.mean(ours <= count):.0f} %)"
        lines.append(f"| {what} | {wanted} | {spread_of(ours, '.1f', '.0f')} | {told[0]} | {told[1]} | {few} |")
    lines += [
        "\nAt best: the likeliest rotor where the spread, that one was cut, and by how much are known; no test of the "
        "trims is right more often.",
    ]  # fmt: skip
    orders = []
    for airframe in AIRFRAMES:
        for kind in ("controller", "motor"):
            name, drawn = f"{airframe} {kind}", limits.orders(airframe, kind)
            reached[name] = float(np.mean(drawn >= WANTED))
            orders.append(f"{name} {spread_of(drawn, '.2f', '.2f')}, {100.0 * reached[name]:.0f} %")
    lines.append(
        f"\nOrder of score against mm cut, expected (95 % of draws), and how often {WANTED:g} is reached: "
        f"{'; '.join(orders)}."
    )
    spreads = [
        f"{name} {_shown(one.deviation)} (same propeller {_shown(_again(judged, name))})"
        for name, one in limits.healthy.items()
    ]
    lines += ["", f"Spread of roll, pitch, yaw and effort of healthy flights [%]: {'; '.join(spreads)}."]
    return "\n".join([*lines, "", _doubles(judged), "", _not_reached(judged, reached)])


def _shown(values: FloatArray) -> str:
    return ", ".join(f"{100.0 * v:.2f}" for v in values)


def _again(judged: Sequence[Judged], airframe: str) -> FloatArray:
    """Standard deviation of flights with the same damage, for either kind of log one."""
    by: dict[object, list[FloatArray]] = {}
    for j in judged:
        if j.flown.airframe == airframe and j.flown.condition == "cut":
            by.setdefault(j.flown.cut, []).append(j.flown.trim.mean)
    pairs = np.array([a - b for a, b, *more in (v for v in by.values() if len(v) == 2) if not more])
    return np.asarray(np.median(np.abs(pairs), axis=0) / 0.6745 / np.sqrt(2.0))


def untraced(judged: Sequence[Judged]) -> list[Judged]:
    """Large single cuts that fly as the common healthy flight does."""
    return [j for j in judged if is_single(j, LARGE, 99.0) and j.health.p_value > 0.5]


def _not_reached(judged: Sequence[Judged], reached: Mapping[str, float]) -> str:
    """What forbids the rows that are not reached, or that nothing does.

    Tried in vain: `quadid_evaluation.studies.health.features`; the likeliest kind of change before the likeliest
    change; angular acceleration beside velocity; a rotor that keeps its thrust as an explanation (one false alarm).
    """
    single, uncut = [j for j in judged if is_single(j, LARGE, 99.0)], untraced(judged)
    flat = " and ".join(f"{j.flown.file} ({j.flown.total:g} mm)" for j in uncut)
    missed = [j.health.p_value for j in judged if is_large(j.flown) and not j.changed]
    healthy = [j.health.p_value for j in judged if j.flown.condition == "healthy"]
    small, order_ = (100.0 * (1.0 - reached[name]) for name in ("rotor named first, 1 to 2.5 mm", "E8 motor"))
    return (
        "### Rows not reached\n"
        f"* One propeller, 3 mm or more: the spread does not forbid it. {flat} fly like healthy flights in every "
        f"channel, which leaves {len(single) - len(uncut)} of {len(single)}.\n"
        f"* One propeller, 1 to 2.5 mm: the spread forbids it in {small:.0f} % of draws, to any test of the trims.\n"
        f"* Order of E8's motor logs: missed in {order_:.0f} % of draws.\n\n"
        f"Large damage that is answered `unchanged`: {len(missed)} flights with p from {min(missed):.3f}, healthy "
        f"ones from {min(healthy):.3f}: a wider `unknown` would catch a healthy flight first."
    )


def _doubles(judged: Sequence[Judged]) -> str:
    """Two cut propellers against the least cut ones of the same set, which differs from the healthy flights' set."""
    two = [j for j in judged if j.flown.condition == "cut" and j.flown.rotors == {1, 2}]
    least = [j.flown.trim for j in two if j.flown.total <= 1.5]
    again = [Judged(j.flown, assess([j.flown.trim], least, CRAZYFLIE)) for j in two if min(j.flown.cut[:2]) >= LARGE]
    three = sum(len(j.named) == 3 for j in again)
    both = sum(set(j.named) == {1, 2} for j in again)
    return (
        "Cuts of M1 and M2 are mostly answered with M3 too: that set of propellers differs from the start. Against "
        f"its own {len(least)} least cut flights, {both} of {len(again)} are answered with both, {three} with three "
        "rotors, the others with a weight between them."
    )
