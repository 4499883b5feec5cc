"""What the spread of healthy flights forbids: the same comparison when every cut does just what the mean cut does.

Healthy flights differ mostly by their propellers.  Of an airframe whose M3 was cut ever shorter three propellers
stayed, so its flights share a draw from the healthy spread; their counts are compared with counts of such draws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from quadid.health import FlightTrim, Health, Healthy, assess, healthy_spread
from quadid.health.changes import SIGNIFICANT
from quadid.health.hypotheses import rotor_effect
from quadid.types import BoolArray, FloatArray
from studies.health.recorded import CRAZYFLIE, LARGE, Judged, is_single, kind_right, named_first

AIRFRAMES = ("E8", "E9")
CUT = 2
"""The rotor whose propeller was cut alone, from 0."""
WEIGHT, NEIGHBOURS = 0.02, 0.2
"""A light weight on an arm, and what each of two neighbouring rotors loses: look-alikes of rotors and of a weight."""


class Power(NamedTuple):
    """Draws of one size: called changed, M3 named first, called a rotor and not a weight; each of shape (draws,)."""

    found: BoolArray
    named: BoolArray
    rotor: BoolArray


def loss_per_mm(judged: Sequence[Judged]) -> float:
    """Loss of thrust per millimetre cut from one propeller, least squares through zero over these single cuts.

    Each change of trim is projected on what a cut does, weighted with the healthy spread.
    """
    pairs = []
    for j in judged:
        healthy = j.health.healthy
        effect = _effect(healthy, next(iter(j.flown.rotors)) - 1) / healthy.deviation
        change = (j.health.trim - healthy.mean) / healthy.deviation
        pairs.append((j.flown.total, effect @ change / (effect @ effect)))
    sizes, losses = np.array(pairs).T
    return float(sizes @ losses / (sizes @ sizes))


def _effect(healthy: Healthy, rotor: int) -> FloatArray:
    """Change of trim per loss of thrust and as much drag torque of a rotor, shape (4,)."""
    return np.asarray(rotor_effect(CRAZYFLIE, rotor, float(healthy.shares[rotor]), healthy.mean).sum(axis=1))


def power(judged: Sequence[Judged], airframe: str, moved: Callable[[Healthy], FloatArray], draws: int) -> Power:
    """What is answered where `moved` shifts the trim of draws from the healthy spread of an airframe."""
    rng = np.random.default_rng(1)
    baseline = _baseline(judged, airframe)
    healthy = healthy_spread(baseline)
    out = []
    for noise in healthy.predictive(1) * rng.standard_t(healthy.freedom, size=(draws, 4)):
        mean = healthy.mean + moved(healthy) + noise
        found: Health = assess([baseline[0]._replace(mean=mean)], baseline, CRAZYFLIE)
        weak = bool(found.changes) and found.changes[0].effect == "weak_rotor"
        first = weak and found.changes[0].parameters[0][2] == CUT + 1.0
        out.append((found.p_value < SIGNIFICANT, first, weak))
    return Power(*np.array(out).T)


def _baseline(judged: Sequence[Judged], airframe: str) -> list[FlightTrim]:
    return [j.flown.trim for j in judged if j.flown.airframe == airframe and j.flown.condition == "healthy"]


Row = tuple[str, str, Callable[[Judged], bool], Callable[[Judged], bool], int]
ROWS: tuple[Row, ...] = (
    ("found, 3 mm and more", "≥ 95 %", lambda j: is_single(j, LARGE, 99.0), lambda j: j.changed, 0),
    ("found, less than 3 mm", "–", lambda j: is_single(j, 0.0, LARGE), lambda j: j.changed, 0),
    ("rotor named first, 3 mm and more", "≥ 95 %", lambda j: is_single(j, LARGE, 99.0), named_first, 1),
    ("rotor named first, 1 to 2.5 mm", "≥ 75 %", lambda j: is_single(j, 1.0, LARGE), named_first, 1),
    ("a propeller, not a weight, 3 mm and more", "≥ 90 %", lambda j: is_single(j, LARGE, 99.0), kind_right, 2),
)  # fmt: skip


def _expected(flown: Sequence[Judged], powers: dict[tuple[str, float], Power], column: int) -> str:
    """Mean and 95 % range of the count of these flights, where those of an airframe share a draw."""
    rng = np.random.default_rng(2)
    counts = np.zeros(4000)
    for airframe in AIRFRAMES:
        mine = sum(powers[airframe, j.flown.total][column].astype(float) for j in flown if j.flown.airframe == airframe)
        counts += rng.choice(mine, len(counts))
    low, high = np.quantile(counts, [0.025, 0.975])
    return f"{counts.mean():.1f} ({low:.0f} to {high:.0f})"


def text(judged: Sequence[Judged], draws: int = 50) -> str:
    """The limits as Markdown."""
    light, large = (
        loss_per_mm([j for j in judged if is_single(j, low, high)]) for low, high in ((0.0, LARGE), (LARGE, 99.0))
    )
    single = [j for j in judged if is_single(j, 0.0, 99.0) and j.flown.rotors == {CUT + 1}]
    sizes = sorted({j.flown.total for j in single})
    powers = {
        (a, size): power(judged, a, partial(_cut, size * (light if size < LARGE else large)), draws)
        for a in AIRFRAMES
        for size in sizes
    }
    lines = [
        f"A single cut below {LARGE:g} mm costs {100.0 * light:.1f} % of thrust per millimetre, a larger one "
        f"{100.0 * large:.1f} % (least squares). With exactly these losses and the spread of healthy flights:\n",
        "| single cuts | wanted | expected (95 % of draws) | measured |", "|---|---|---|---|",
    ]  # fmt: skip
    for what, wanted, chosen, right, column in ROWS:
        mine = [j for j in single if chosen(j)]
        got = f"{sum(right(j) for j in mine)} of {len(mine)}"
        lines.append(f"| {what} | {wanted} | {_expected(mine, powers, column)} | {got} |")
    spreads = [
        f"{airframe} {_shown(healthy_spread(_baseline(judged, airframe)).deviation)} (same propeller "
        f"{_shown(_again(judged, airframe))})" for airframe in AIRFRAMES
    ]  # fmt: skip
    lines += ["", f"Spread of roll, pitch, yaw and effort of healthy flights [%]: {'; '.join(spreads)}."]
    return "\n".join([*lines, "", _look_alikes(judged, draws), "", _doubles(judged), "", _outside(judged)])


def _look_alikes(judged: Sequence[Judged], draws: int) -> str:
    """How often a light weight on an arm and two neighbouring cuts are told from each other's like."""
    shares = [
        " and ".join(f"{100.0 * np.mean(rotor == power(judged, a, moved, draws).rotor):.0f} %" for a in AIRFRAMES)
        for moved, rotor in ((partial(_loaded, WEIGHT), False), (partial(_cut_both, NEIGHBOURS), True))
    ]
    frames = " and ".join(AIRFRAMES)
    return (
        f"A weight of {100.0 * WEIGHT:.0f} % at a hub is separated from that rotor in {shares[0]} of draws for "
        f"{frames}; losses of {100.0 * NEIGHBOURS:.0f} % of M1 and M2 from a weight between them in {shares[1]}."
    )


def _loaded(mass: float, healthy: Healthy) -> FloatArray:
    """Change of trim by a mass (fraction of the vehicle's) at the cut rotor's hub, shape (4,)."""
    x, y = CRAZYFLIE.rotors[CUT].position[:2]
    return np.array([-y / CRAZYFLIE.arm * mass, x / CRAZYFLIE.arm * mass, 0.0, mass]) / (1.0 + mass)


def _cut_both(loss: float, healthy: Healthy) -> FloatArray:
    """Change of trim where the first two rotors lose as much, shape (4,)."""
    return loss * (_effect(healthy, 0) + _effect(healthy, 1))


def _cut(loss: float, healthy: Healthy) -> FloatArray:
    return loss * _effect(healthy, CUT)


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


def _outside(judged: Sequence[Judged]) -> str:
    """Flights that no spread accounts for: cuts that fly as healthy ones, weights that move the yaw trim."""
    uncut = [j for j in judged if is_single(j, LARGE, 99.0) and j.health.p_value > 0.5]
    weights = [j for j in judged if "glued" in j.flown.weight and abs(j.health.distance[2]) > 3.0]
    cuts = [f"{j.flown.file} ({j.flown.total:g} mm, p = {j.health.p_value:.2f})" for j in uncut]
    yawed = [f"{j.flown.file} ({j.health.distance[2]:+.1f} spreads of yaw)" for j in weights]
    return (
        f"Outliers: {' and '.join(cuts)} fly like healthy flights; {' and '.join(yawed)} carry a weight but yaw like a "
        "cut."
    )


def _doubles(judged: Sequence[Judged]) -> str:
    """Two cut propellers against the least cut ones of the same set, which differs from the healthy flights' set."""
    two = [j for j in judged if j.flown.condition == "cut" and j.flown.rotors == {1, 2}]
    least = [j.flown.trim for j in two if j.flown.total <= 1.5]
    again = [Judged(j.flown, assess([j.flown.trim], least, CRAZYFLIE)) for j in two if min(j.flown.cut[:2]) >= LARGE]
    three = sum(len(j.named) == 3 for j in again)
    both = sum(set(j.named) == {1, 2} for j in again)
    return (
        "Cuts of M1 and M2 are mostly answered with M3 too, because that set of propellers differs from the start. "
        f"Against its own {len(least)} least cut flights, {both} of {len(again)} are answered with the right two "
        f"rotors, {three} with three, the others with a weight between them."
    )
