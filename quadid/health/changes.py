"""From trims to an answer: healthy or changed, which rotors, masses or shifts, how much, and how sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from quadid.chi_square import Z95
from quadid.health.change_evidence import Explained, compare, distance, exact, p_healthy, p_unchanged
from quadid.health.hypotheses import hypotheses
from quadid.health.spread import Healthy, healthy_spread
from quadid.health.trim_estimation import AXES, FlightTrim
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

SIGNIFICANT = 0.01
"""A change is one that healthy flights make less often than this."""
HEALTHY_SCORE = float(np.sqrt(chdtri(len(AXES), SIGNIFICANT)))
"""The score that one healthy flight in a hundred exceeds."""
_SURE = 0.75
"""A change is named with confidence where explanations that hold it have this much of the probability."""
_UNEXPLAINED = 1e-3
"""An explanation, be it that nothing changed, that leaves a rest less probable than this explains nothing."""
_RIVALS = 3
ENOUGH = 5
"""Baseline flights that a verdict of no change needs, unless it would be the same with as many."""


class Rival(NamedTuple):
    """An explanation that lost: names of the contract, rotors from 1, p-value, probability among all explanations."""

    effects: tuple[str, ...]
    rotors: tuple[int, ...]
    p_value: float
    share: float

    def to_dict(self) -> dict[str, Any]:
        """Plain data of contract form."""
        more = {"with": list(self.effects[1:])} if len(self.effects) > 1 else {}
        rotors = {"rotors": list(self.rotors)} if self.rotors else {}
        return {"effect": self.effects[0], **more, **rotors, "p_value": self.p_value, "probability": self.share}


@dataclass(frozen=True)
class Change:
    """One thing that changed.

    Attributes:
        effect: name of the contract.
        parameters: (name, unit, value, 95 % interval or None).
        p_value: chance that healthy flights differ so much along this explanation.
        share: probability of the explanations that hold it, among all.
        confident: whether it is certain enough to act on.
        rivals: other explanations, the most probable first.
        evidence: one sentence.
    """

    effect: str
    parameters: tuple[tuple[str, str, float, tuple[float, float] | None], ...]
    p_value: float
    share: float
    confident: bool
    rivals: tuple[Rival, ...]
    evidence: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data of contract form."""
        return {
            "effect": self.effect,
            "confident": self.confident,
            "p_value": self.p_value,
            "probability": self.share,
            "alternatives": [rival.to_dict() for rival in self.rivals],
            "evidence": self.evidence,
            "parameters": [
                {"name": n, "unit": u, "value": v if ci else int(v), "ci95": None if ci is None else list(ci)}
                for n, u, v, ci in self.parameters
            ],
        }


@dataclass(frozen=True)
class Health:
    """What changed since the baseline flights.

    Attributes:
        verdict: unchanged, changed or unknown.
        lacking: baseline flights that are lacking: with so many more that differ no more, this would be a change; the
            verdict is unknown then.  Else 0.
        changes: the most probable explanation; with confidence only where the verdict is changed.
        score: how far the flights are from healthy ones, in standard deviations of these.
        p_value: chance that a healthy flight looks as changed; where nothing explains a change, that one is as far
            from what explains best.
        trim: of the flights in question, shape (4,), see `trims.AXES`.
        distance: of each trim from healthy, in standard deviations, shape (4,).
        healthy: the baseline's trim and spread.
        flights: trims of the flights in question.
        baseline: trims of the baseline flights.
    """

    verdict: str
    lacking: int
    changes: tuple[Change, ...]
    score: float
    p_value: float
    trim: FloatArray
    distance: FloatArray
    healthy: Healthy
    flights: tuple[FlightTrim, ...]
    baseline: tuple[FlightTrim, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data of the form ``quadid.health/1``, without the names of files."""
        origin = np.where(np.array(AXES) == "effort", self.healthy.mean, 0.0)  # effort counts from the baseline's
        trims = self.trim - origin, self.healthy.mean - origin
        each = zip(AXES, *trims, self.healthy.deviation, self.distance, strict=True)
        return {
            "schema": "quadid.health/1",
            "verdict": self.verdict,
            "baseline_lacking": self.lacking,
            "changes": [change.to_dict() for change in self.changes],
            "score": self.score,
            "p_value": self.p_value,
            "trim": [
                {"name": n, "value": v, "baseline": m, "spread": s, "distance": d} for n, v, m, s, d in each
            ],
        }  # fmt: skip


def assess(flights: Sequence[FlightTrim], baseline: Sequence[FlightTrim], vehicle: Vehicle) -> Health:
    """Compares flights with healthy ones of the same vehicle.

    Args:
        flights: trims of the flights in question, which share what changed.
        baseline: trims of healthy flights.
        vehicle: geometry.
    """
    healthy = healthy_spread(baseline)
    trim = np.mean([flight.mean for flight in flights], axis=0)
    shares = np.mean([flight.shares for flight in flights], axis=0)
    change, deviation = trim - healthy.mean, healthy.predictive(len(flights))
    far = distance(change, deviation, healthy.freedom)
    p_value = p_unchanged(change, healthy, len(flights), vehicle)
    found = compare(exact(change), healthy, len(flights), hypotheses(vehicle, shares, healthy.mean))
    named = p_value < SIGNIFICANT
    rest = exact(change) - (found[0].hypothesis.effect @ found[0].value if named else 0.0)
    p_rest = p_healthy(rest, deviation, healthy.freedom)
    unexplained = p_rest < _UNEXPLAINED
    lacking = 0 if named or unexplained else _lacking(change, healthy, len(flights), vehicle)
    verdict = "unknown" if unexplained or lacking else "changed" if named else "unchanged"
    changes = () if unexplained else _changes(found, vehicle, verdict == "changed")
    score = float(np.sqrt((far**2).sum()))
    return Health(
        verdict, lacking, changes, score, p_rest if unexplained else p_value, trim, far, healthy, tuple(flights),
        tuple(baseline),
    )  # fmt: skip


def _lacking(change: FloatArray, healthy: Healthy, flights: int, vehicle: Vehicle) -> int:
    """How many more baseline flights of the same spread would make this a change, up to `ENOUGH` in all; 0: none do."""
    for count in range(healthy.flights + 1, ENOUGH + 1):
        if p_unchanged(change, healthy.known_from(count), flights, vehicle) < SIGNIFICANT:
            return count - healthy.flights
    return 0


def changes_of(
    change: FloatArray, healthy: Healthy, flights: int, vehicle: Vehicle, shares: FloatArray, changed: bool
) -> tuple[Change, ...]:
    """The best explanation of a change of trim.

    Args:
        change: of trim, shape (4,).
        healthy: what it counts from, and the spread.
        flights: number of flights that the change is the mean of.
        vehicle: geometry.
        shares: each rotor's share of the load with the change, shape (rotors,).
        changed: whether it is one; else nothing is named with confidence.
    """
    offered = hypotheses(vehicle, shares, healthy.mean)
    return _changes(compare(exact(change), healthy, flights, offered), vehicle, changed)


def _changes(found: Sequence[Explained], vehicle: Vehicle, changed: bool) -> tuple[Change, ...]:
    """The best explanation as changes, largest first, with the explanations that lost."""
    shares = np.exp([one.log_evidence - found[0].log_evidence for one in found])
    shares /= shares.sum()
    best, lost = found[0], _rivals(found, shares)
    if best.hypothesis.kind == "weak_rotor":
        out = []
        for k, rotor in enumerate(best.hypothesis.rotors):
            sure = float(sum(s for one, s in zip(found, shares, strict=True) if rotor in one.hypothesis.rotors))
            out.append(_weak_rotor(best, k, sure, changed, lost))
        return tuple(sorted(out, key=lambda c: -abs(c.parameters[1][2])))
    return _of_mass(best, vehicle, float(shares[0]), changed, lost)


def _rivals(found: Sequence[Explained], shares: FloatArray) -> tuple[Rival, ...]:
    """Explanations other than the first, the most probable ones."""
    others = zip(found[1 : _RIVALS + 1], shares[1 : _RIVALS + 1], strict=True)
    return tuple(Rival(*_names(one), one.p_value, float(share)) for one, share in others)


def _names(one: Explained) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """An explanation in names of the contract, and its rotors from 1."""
    kind = one.hypothesis.kind
    if kind == "effort":
        return ("thrust_drop" if one.value[0] > 0.0 else "mass_change",), ()  # alike but for the command's kind
    effects = ("cg_offset", "mass_change") if kind == "payload" else (kind,)
    return effects, tuple(j + 1 for j in one.hypothesis.rotors)


def _interval(one: Explained, k: int, scale: float = 1.0) -> tuple[float, tuple[float, float]]:
    value, half = float(one.value[k]) * scale, Z95 * float(np.sqrt(one.covariance[k, k])) * scale
    return value, (value - half, value + half)


def _added(one: Explained, k: int) -> tuple[float, tuple[float, float]]:
    """A part of the loaded vehicle's mass as a fraction of the vehicle's without it, with its interval."""
    value, (low, high) = _interval(one, k)
    return value / (1.0 - value), (low / (1.0 - low), high / (1.0 - high))


def _weak_rotor(one: Explained, k: int, share: float, changed: bool, lost: tuple[Rival, ...]) -> Change:
    rotor = one.hypothesis.rotors[k] + 1
    loss, loss_ci = _interval(one, 2 * k)
    drag, drag_ci = _interval(one, 2 * k + 1)
    sentence = (
        f"For the same command rotor {rotor} produces {_less(loss)} thrust and {_less(drag)} drag torque than in the "
        "baseline."
    )
    parameters = (
        ("rotor", "", float(rotor), None), ("loss", "", loss, loss_ci), ("drag_loss", "", drag, drag_ci),
    )  # fmt: skip
    return Change("weak_rotor", parameters, one.p_value, share, changed and share > _SURE, lost, sentence)


def _less(share: float) -> str:
    """A loss in words: ``22 % less``."""
    return f"{100.0 * abs(share):.0f} % {'less' if share >= 0.0 else 'more'}"


def _of_mass(
    one: Explained, vehicle: Vehicle, share: float, changed: bool, lost: tuple[Rival, ...]
) -> tuple[Change, ...]:
    """A payload as mass_change and cg_offset, a shifted CG, or effort alone."""
    kind, sure = one.hypothesis.kind, changed and share > _SURE

    def change(effect: str, parameters: Any, sentence: str, rivals: Any = lost) -> Change:
        return Change(effect, tuple(parameters), one.p_value, share, sure, rivals, sentence)

    if kind == "effort":
        value, (low, high) = _added(one, 0)
        more = (
            f"All rotors together need {100.0 * value:+.1f} % command for the same force, their balance is as it was."
        )
        # Of measured speeds rather a mass; of commands rather the battery, which they do not show.
        thrust = value > 0.0 and vehicle.command.kind != "rotor_speed"
        rival = Rival(("mass_change" if thrust else "thrust_drop",), (), one.p_value, share)
        if thrust:
            return (change("thrust_drop", [("fraction", "", *_interval(one, 0))], more, (rival, *lost)),)
        return (change("mass_change", [("fraction", "", value, (low, high))], more, (rival, *lost)),)
    arm = vehicle.arm
    place = [(name, "m", *_interval(one, k, arm)) for k, name in enumerate("xy")]
    where = ", ".join(f"{1e3 * p[2]:+.1f} mm along {p[0]}" for p in place)
    shift = change("cg_offset", place, f"The centre of gravity moved by {where}; the yaw trim stayed.")
    if kind == "cg_offset":
        return (shift,)
    mass, interval = _added(one, 2)
    more = f"The rotors carry {100.0 * mass:.1f} % more, off centre."
    return (change("mass_change", [("fraction", "", mass, interval)], more), shift)
