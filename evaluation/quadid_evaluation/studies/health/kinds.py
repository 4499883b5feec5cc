"""Propeller or glued weight: what the healthy spread allows, and what a slipstream adds to a weight.

A body under a rotor takes a download D from its thrust T.  Momentum theory (Glauert, in Durand's Aerodynamic Theory,
vol. IV, 1935) gives the air there c times the induced velocity v at the disc, c from 1 to 2, and the swirl u with
u r = Q / (rho A v) = 2 v Q / T.  Pushed along the air, the body takes the torque D u r / (c v) = (2 / c) Q D / T about
the hub: it lowers the rotor's reaction torque by 2 / c of the share that its thrust loses.  About the centre of gravity
the sideways force D u / (c v) has the lever r + L cos(p), L the arm, p the body's direction from outboard: yaw per lost
thrust is (2 / c) (1 + (L / r) cos(p)), of either sign, and a cut's, 1, is among them.

Tried in vain, as a further explanation: a weight below a rotor (four in ten of those within `REACH`) with a download of
5, 10 or 20 % (one sigma) and this yaw.  79, 79 and 78 of the 89 flights are right, 79 without it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from math import ceil

import numpy as np

from quadid.condition import Healthy
from quadid.condition.changes import compare, exact, hypotheses
from quadid.types import BoolArray, FloatArray
from quadid_evaluation.studies.health.limits import ASSESSED, DRAWS, Limits, spread_of
from quadid_evaluation.studies.health.recorded import CRAZYFLIE, Flown, Judged, is_large, kind_right

WANTED = 0.9
"""Share that the row wants."""
_YAW = 2
"""Place of yaw among the trims."""


def rotors_near(weight: str) -> list[int]:
    """Rotors that a weight's label names, from 0."""
    return [int(j) - 1 for j in re.findall(r"M(\d)", weight)]


def mass_effect(weight: str) -> FloatArray:
    """Change of trim, in `exact` numbers, per part of the loaded vehicle's mass that the weight is, shape (4,).

    The weight sits at the hub that its label names, or between those.
    """
    x, y = np.mean([CRAZYFLIE.rotors[j].position[:2] for j in rotors_near(weight)], axis=0) / CRAZYFLIE.arm
    return np.array([-y, x, 0.0, 1.0])


def weighed(flights: Sequence[Judged], healthy: Healthy) -> float:
    """A weight as a part of the loaded vehicle's mass, by its flights' roll, pitch and effort (least squares)."""
    effect = mass_effect(flights[0].flown.weight) / healthy.deviation
    change = np.mean([exact(j.health.trim - healthy.mean) for j in flights], axis=0) / healthy.deviation
    return float(effect @ change / (effect @ effect))


class Kinds:
    """Draws of all large damage: is a propeller told from a weight?

    Attributes:
        flights: the large damage.
        glued: its weights, by airframe and label.
        masses: of these, parts of the loaded vehicle's mass.
    """

    def __init__(self, judged: Sequence[Judged]) -> None:
        """Weighs the weights."""
        self.flights, self._limits = [j for j in judged if is_large(j.flown)], Limits(judged)
        self.glued: dict[tuple[str, str], list[Judged]] = {}
        for j in self.flights:
            if j.flown.weight:
                self.glued.setdefault((j.flown.airframe, j.flown.weight), []).append(j)
        self.masses = {key: weighed(flights, self._limits.healthy[key[0]]) for key, flights in self.glued.items()}

    def moved(self, flown: Flown, slipstream: bool) -> FloatArray:
        """Change of trim by a flight's cuts or weight, in `exact` numbers, shape (4,).

        Args:
            flown: the flight.
            slipstream: a weight under one rotor has the yaw of a cut that moves the other trims as far.
        """
        if not flown.weight:
            return self._limits.moved(flown)
        mass, near = self.masses[flown.airframe, flown.weight], rotors_near(flown.weight)
        out = mass_effect(flown.weight)
        if slipstream and len(near) == 1:
            out[_YAW] = CRAZYFLIE.rotors[near[0]].spin
        return np.asarray(mass * out)

    def deviation(self, airframe: str) -> float:
        """Standard deviation of a healthy flight's yaw from the healthy mean."""
        return float(self._limits.healthy[airframe].predictive(1)[_YAW])

    def counted(self, weights: bool, slipstream: bool = False) -> FloatArray:
        """How many of the weights, or of the cuts, are told for what they are, shape (draws,).

        Flights with one set of propellers, of an airframe with the same rotors cut or the same weight, share a draw.
        """
        rng, sets = np.random.default_rng(4), dict[tuple[object, ...], list[BoolArray]]()
        for f in (j.flown for j in self.flights if bool(j.flown.weight) == weights):
            right = self._answered(f.airframe, self.moved(f, slipstream)) != weights
            sets.setdefault(_set(f), []).append(right)
        return _together(rng, sets)

    def at_best(self) -> FloatArray:
        """How many flights are right by a test that knows spread and size of either, weights as likely, (draws,).

        A cut and a weight (mass alone) with its roll, pitch and effort differ in yaw, and half way is the limit.  No
        test of the trims to which weights are as likely is right more often.
        """
        rng, sets = np.random.default_rng(4), dict[tuple[object, ...], list[BoolArray]]()
        for f in (j.flown for j in self.flights):
            noise, near = self._limits.noise[f.airframe][:, _YAW], rotors_near(f.weight)
            shown = self.moved(f, False)[_YAW] + noise
            cut = self.moved(f, True)[_YAW]  # yaw of the cut that is one of the two, the weight's is 0
            told = (shown * np.sign(cut) > 0.5 * abs(cut)) == (not f.weight)
            right = rng.random(len(noise)) < 0.5 if len(near) > 1 else told
            sets.setdefault(_set(f), []).append(right)
        return _together(rng, sets)

    def _answered(self, airframe: str, moved: FloatArray) -> BoolArray:
        """Whether a propeller is the likeliest change, in draws that are moved by so much, shape (draws,)."""
        healthy = self._limits.healthy[airframe]
        offered = hypotheses(CRAZYFLIE, healthy.shares, healthy.mean)
        changes = exact(self._limits.noise[airframe][:ASSESSED]) + moved
        return np.array([compare(one, healthy, 1, offered)[0].hypothesis.kind == "weak_rotor" for one in changes])


def _set(flown: Flown) -> tuple[object, ...]:
    """What flights with one set of propellers have in common."""
    return flown.airframe, *flown.rotors, flown.weight


def _together(rng: np.random.Generator, sets: Mapping[tuple[object, ...], Sequence[BoolArray]]) -> FloatArray:
    """How many flights are right, where each set draws once, shape (draws,)."""
    return np.asarray(np.sum([rng.choice(np.sum(flags, axis=0), DRAWS) for flags in sets.values()], axis=0))


def text(judged: Sequence[Judged]) -> str:
    """The limit as Markdown."""
    kinds = Kinds(judged)
    count, cuts = len(kinds.flights), kinds.counted(weights=False)
    glued = sum(len(flights) for flights in kinds.glued.values())
    wanted, right = ceil(WANTED * count), [j for j in kinds.flights if kind_right(j)]
    lines = [
        "A loss of one rotor has the trims of a weight at its hub but for yaw, equal losses of two neighbours those of "
        "a weight between them. Draws from the healthy spread, cuts with the mean loss, weights as their roll, pitch "
        f"and effort weigh them ({_masses(kinds)}); flights with one set of propellers share a draw (mean, 95 %):\n",
        f"| weights | told, of {glued} | right, of {count} | {wanted} are reached in | at best in |",
        "|---|---|---|---|---|",
    ]
    named, few = sum(bool(j.flown.weight) for j in right), []
    for name, slipstream in (("mass alone", False), ("under one rotor: a cut's yaw", True)):
        told = kinds.counted(True, slipstream)
        few.append(f"{100.0 * np.mean(told <= named):.0f} %")
        both, best = cuts + told, "–" if slipstream else f"{100.0 * np.mean(kinds.at_best() >= wanted):.0f} %"
        reached = f"{100.0 * np.mean(both >= wanted):.0f} %"
        lines.append(
            f"| {name} | {spread_of(told, '.1f', '.0f')} | {spread_of(both, '.1f', '.0f')} | {reached} | {best} |"
        )
    lines.append(f"| measured | {named} (chance of as few: {', '.join(few)}) | {len(right)} | | |")
    return "\n".join([*lines, "", _WHY.format(always=count - glued, count=count, far=_farthest(kinds))])


def _masses(kinds: Kinds) -> str:
    return ", ".join(f"{a} {w.replace(' glued', '')} {100.0 * m:.1f} %" for (a, w), m in sorted(kinds.masses.items()))


def _farthest(kinds: Kinds) -> str:
    """The weight whose yaw is the farthest from a mass'."""
    yaw = {key: np.mean([j.health.trim - j.health.healthy.mean for j in on], axis=0)[_YAW]
           for key, on in kinds.glued.items()}  # fmt: skip
    far = {key: abs(value) / kinds.deviation(key[0]) for key, value in yaw.items()}
    key = max(far, key=far.__getitem__)
    name = key[1].replace(" glued", "")
    return f"{name} moves yaw by {100.0 * abs(yaw[key]):.0f} %, {far[key]:.0f} standard deviations"


_WHY = """At best: a test that knows spread and sizes, to which weights are as likely as cuts. Who always says
propeller is right in {always} of {count}.

{far}: mass alone does not. The slipstream on a body takes reaction torque too, on either side of a
cut's (`evaluation/quadid_evaluation/studies/health/kinds.py`); as a further explanation this names no more of them."""
