"""Changes since healthy flights: hypotheses, their evidence, and the answer."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc, log_ndtr, ndtri, stdtr, stdtrit

from quadid.chi_square import Z95
from quadid.condition.trim import AXES, FlightTrim, Healthy, healthy_spread, trim_directions
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

# --- What may have changed, and what it would do to the trim: linear in its parameters, with priors from physics
#
# A rotor j with share s_j of the load that loses the fraction l of its thrust and q of its drag torque moves the trim
# by l s_j (G_kj - trim_k) in roll and pitch, by q s_j G_3j - l s_j trim_3 in yaw and by l s_j in effort.  A mass w at
# (x, y) from the centre, w the part of the loaded vehicle's, moves it by -w y / arm, w x / arm, 0 and w.


LOSS = 0.2
"""Prior standard deviation of a rotor's loss of thrust."""
DRAG_APART = ((0.02, 0.9), (0.15, 0.1))
"""Prior standard deviations of its loss of drag torque from that of thrust, with their probabilities: a tired motor
loses as much of both, a cut blade nearly so (R^4 and R^5 of its length; a tenth of `LOSS` apart), one with tape or a
bend may lose thrust and gain drag."""
MASS = 0.1
"""Prior standard deviation of an added mass, as a fraction."""
REACH = 0.7
"""An added mass sits this far from the centre, in arms (standard deviation of each coordinate)."""
SHIFT = 0.05
"""Prior standard deviation of a shift of the CG without mass, in arms: a battery that has slid."""
_KINDS = {"weak_rotor": 0.7, "payload": 0.2, "cg_offset": 0.06, "effort": 0.04}
"""Prior odds of the kinds of change; each further damaged rotor costs a factor of 0.3."""
_STEP = 0.15
_MASSES = tuple(float(mass) for mass in 0.01 * np.exp(2.0 * _STEP * np.arange(13)))
"""Added masses that are tried, from 1 % in steps of twice `_STEP` (relative), each with that standard deviation."""


class Hypothesis(NamedTuple):
    """One explanation of a change of trim.

    Attributes:
        kind: weak_rotor, payload (mass_change with cg_offset), cg_offset, effort (mass_change or thrust_drop).
        rotors: the damaged ones, from 0.
        effect: change of trim per parameter, shape (4, parameters).
        prior: covariance of the parameters, shape (parameters, parameters).
        centre: their prior mean, shape (parameters,).
        positive: which parameters cannot be negative.
    """

    kind: str
    rotors: tuple[int, ...]
    effect: FloatArray
    prior: FloatArray
    centre: FloatArray
    positive: tuple[int, ...]
    log_odds: float


def rotor_effect(vehicle: Vehicle, rotor: int, share: float, trim: FloatArray) -> FloatArray:
    """Change of trim per loss of thrust and per loss of drag torque of one rotor, shape (4, 2)."""
    g = trim_directions(vehicle)[:, rotor]
    return share * np.array([[g[0] - trim[0], 0.0], [g[1] - trim[1], 0.0], [-trim[2], g[2]], [1.0, 0.0]])


def hypotheses(vehicle: Vehicle, shares: FloatArray, trim: FloatArray) -> list[Hypothesis]:
    """Every explanation that is compared.

    Args:
        vehicle: geometry.
        shares: each rotor's share of the load in the flights in question, shape (rotors,).
        trim: healthy trim, shape (4,).
    """
    rotors = range(len(vehicle.rotors))
    single = [rotor_effect(vehicle, j, float(shares[j]), trim) for j in rotors]
    odds = {kind: float(np.log(p)) for kind, p in _KINDS.items()}
    out = []
    for count in range(1, min(3, len(rotors) - 1) + 1):  # rotors that are damaged at once
        chosen = list(combinations(rotors, count))
        each = odds["weak_rotor"] + (count - 1) * np.log(0.3) - np.log(len(chosen))
        centre, positive = np.zeros(2 * count), tuple(range(0, 2 * count, 2))
        for group in chosen:
            effect = np.hstack([single[j] for j in group])
            for apart, part in DRAG_APART:
                alike = np.array([[LOSS**2, LOSS**2], [LOSS**2, LOSS**2 + apart**2]])
                prior = np.asarray(np.kron(np.eye(count), alike), dtype=np.float64)
                log_odds = float(each + np.log(part))
                out.append(Hypothesis("weak_rotor", group, effect, prior, centre, positive, log_odds))
    # Added masses of several sizes at a place, a shifted CG, and more effort alone
    shift = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])  # per x and y of the CG, in arms
    effort = np.array([[0.0], [0.0], [0.0], [1.0]])
    weights = np.exp(-0.5 * (np.array(_MASSES) / MASS) ** 2)
    for mass, weight in zip(_MASSES, weights / weights.sum(), strict=True):
        prior = np.diag([(REACH * mass) ** 2, (REACH * mass) ** 2, (_STEP * mass) ** 2])
        centre = np.array([0.0, 0.0, mass])
        log_odds = odds["payload"] + float(np.log(weight))
        out.append(Hypothesis("payload", (), np.hstack([shift, effort]), prior, centre, (), log_odds))
    for kind, effect, size in (("cg_offset", shift, SHIFT), ("effort", effort, MASS)):
        none = np.zeros(effect.shape[1])
        out.append(Hypothesis(kind, (), effect, size**2 * np.eye(len(none)), none, (), odds[kind]))
    return out


# --- Healthy or changed, and by what: one Student-t likelihood for all explanations


_DRAWS = 8192
"""Healthy flights that are drawn to estimate how rare an evidence of change is among them."""
LEAST_CHANCE = 1.0 / (_DRAWS + 1)
"""The smallest `p_unchanged`: no drawn flight speaks for a change as much."""


def distance(change: FloatArray, deviation: FloatArray, freedom: FloatArray) -> FloatArray:
    """Each trim's change as a standard normal deviate of the same probability as its Student t, shape (4,)."""
    z = np.abs(change) / deviation
    far = -ndtri(np.maximum(stdtr(freedom, -z), 1e-300))
    return np.asarray(np.sign(change) * far)


def p_healthy(change: FloatArray, deviation: FloatArray, freedom: FloatArray) -> float:
    """Chance that healthy flights differ by `change` or more: chi-square of its `distance`."""
    return float(chdtrc(len(change), (distance(change, deviation, freedom) ** 2).sum()))


def exact(change: FloatArray) -> FloatArray:
    """A change of trim (…, 4) with effort as the part of thrust per command that is missing, 1 - exp(-effort).

    In these numbers every explanation is linear whatever its size: lost thrust adds up rotor by rotor, and a mass
    counts as a part of the loaded vehicle's.
    """
    return np.concatenate([change[..., :3], -np.expm1(-change[..., 3:])], axis=-1)


def log_student(
    quadratic: FloatArray, log_determinant: FloatArray, freedom: float, dimensions: int = len(AXES)
) -> FloatArray:
    """Logarithm of a Student-t density, to a constant; by default in as many dimensions as a trim has."""
    return np.asarray(-0.5 * (freedom + dimensions) * np.log1p(quadratic / freedom) - 0.5 * log_determinant)


def _evidence(
    one: Hypothesis, changes: FloatArray, deviation: FloatArray, freedom: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log evidence of changes (changes, 4) with the prior odds, posterior mean of the parameters, and its covariance.

    A change is Student-t with the spread's mean degrees of freedom v and p = 4 dimensions:
    log t = -(v + p)/2 log(1 + Q/v) - log|S|/2, S = D + A P A', Q = r' S^-1 r with r the change beyond the prior
    mean's, to a constant.  Parameters that cannot be negative restrict the Gaussian posterior; the restriction's odds
    (posterior over prior) count.

    Returns:
        Shapes (changes,), (changes, parameters), (changes, parameters, parameters).
    """
    spread = np.diag(deviation**2) + one.effect @ one.prior @ one.effect.T
    inverse = np.linalg.inv(spread)
    gain = inverse @ one.effect @ one.prior
    beyond = changes - one.effect @ one.centre
    value = one.centre + beyond @ gain
    quadratic = (beyond @ inverse * beyond).sum(axis=1)
    scale = (freedom + quadratic) / (freedom + len(AXES))
    covariance = scale[:, None, None] * (one.prior - one.prior @ one.effect.T @ gain)
    evidence = log_student(quadratic, np.linalg.slogdet(spread)[1], freedom) + one.log_odds
    for k in one.positive:
        evidence += log_ndtr(value[:, k] / np.sqrt(covariance[:, k, k])) + np.log(2.0)
    return evidence, value, covariance


def _changed_over_unchanged(
    changes: FloatArray, healthy: Healthy, flights: int, offered: Sequence[Hypothesis]
) -> FloatArray:
    """Logarithm of the evidence that something changed over that nothing did, to a constant, shape (changes,)."""
    deviation, freedom = healthy.predictive(flights), float(healthy.freedom.mean())
    changed = np.logaddexp.reduce([_evidence(one, changes, deviation, freedom)[0] for one in offered])
    quadratic, log_determinant = ((changes / deviation) ** 2).sum(axis=1), 2.0 * np.log(deviation).sum()
    return np.asarray(changed - log_student(quadratic, log_determinant, freedom))


def p_unchanged(change: FloatArray, healthy: Healthy, flights: int, vehicle: Vehicle) -> float:
    """Chance that healthy flights speak for a change as much as `change` of trim does; at least `LEAST_CHANCE`.

    What is compared is the evidence of all explanations together over that of no change: among all tests with as many
    false alarms, this one finds the most of what the priors expect (Neyman and Pearson).  Healthy flights are `_DRAWS`
    points of a Sobol sequence in the predictive distribution of the spread.
    """
    offered = hypotheses(vehicle, healthy.shares, healthy.mean)
    numbers = [healthy.mean, healthy.deviation, healthy.freedom, healthy.predictive(1), healthy.shares]
    key = tuple(part.tobytes() for part in (*numbers, *(one.effect for one in offered)))
    drawn = _evidence_of_draws(_Question(key, healthy, flights, tuple(offered)))
    own = _changed_over_unchanged(exact(change)[None], healthy, flights, offered)
    return float((1 + np.count_nonzero(drawn >= own)) / (len(drawn) + 1))


@dataclass(frozen=True)
class _Question:
    """Data that the evidence of draws follows from, and their bytes, the key of the cache."""

    key: tuple[bytes, ...]
    healthy: Healthy = field(compare=False)
    flights: int
    offered: tuple[Hypothesis, ...] = field(compare=False)


@lru_cache(maxsize=32)
def _evidence_of_draws(question: _Question) -> FloatArray:
    """Evidence of change in draws of healthy flights, which all flights after one baseline share, shape (draws,)."""
    points = _healthy_points(*question.healthy.freedom) * question.healthy.predictive(question.flights)
    return _changed_over_unchanged(exact(points), question.healthy, question.flights, question.offered)


@cache
def _healthy_points(*freedom: float) -> FloatArray:
    """Draws of independent Student t of these degrees of freedom, shape (draws, axes); always the same."""
    from scipy.stats import qmc  # two seconds to import, and few flights are compared with healthy ones

    points = qmc.Sobol(len(freedom), scramble=True, seed=0).random(_DRAWS)
    return np.column_stack([stdtrit(v, column) for v, column in zip(freedom, points.T, strict=True)])


class Explained(NamedTuple):
    """One explanation after the fact.

    Attributes:
        log_evidence: of the change of trim, with the prior odds.
        value: posterior mean of the parameters, shape (parameters,).
        p_value: chance that healthy flights differ so much along this explanation.
    """

    hypothesis: Hypothesis
    log_evidence: float
    value: FloatArray
    covariance: FloatArray
    p_value: float

    def number(self, k: int, scale: float = 1.0) -> tuple[float, tuple[float, float]]:
        """A parameter times a scale, and its 95 % interval."""
        value, half = float(self.value[k]) * scale, Z95 * float(np.sqrt(self.covariance[k, k])) * scale
        return value, (value - half, value + half)

    def added(self, k: int) -> tuple[float, tuple[float, float]]:
        """A part of the loaded vehicle's mass as a fraction of the vehicle's without it, with its interval."""
        value, (low, high) = self.number(k)
        return value / (1.0 - value), (low / (1.0 - low), high / (1.0 - high))

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Names of the contract, and the rotors from 1."""
        kind = self.hypothesis.kind
        if kind == "effort":
            return ("thrust_drop" if self.value[0] > 0.0 else "mass_change",), ()  # alike but for the command's kind
        effects = ("cg_offset", "mass_change") if kind == "payload" else (kind,)
        return effects, tuple(j + 1 for j in self.hypothesis.rotors)


def compare(change: FloatArray, healthy: Healthy, flights: int, offered: Sequence[Hypothesis]) -> list[Explained]:
    """All explanations of an `exact` change, the most probable first.

    Those of one kind and rotors count as one, with the best's values.
    """
    deviation, freedom = healthy.predictive(flights), float(healthy.freedom.mean())
    groups: dict[tuple[str, tuple[int, ...]], list[Explained]] = {}
    for one in offered:
        evidence, value, covariance = _evidence(one, change[None], deviation, freedom)
        # F test of the part of the change that the explanation's free parameters account for
        basis, sizes, _ = np.linalg.svd(one.effect / deviation[:, None], full_matrices=False)
        kept = sizes > 1e-9 * sizes[0]
        count, part = int(np.count_nonzero(kept)), float((((change / deviation) @ basis) ** 2 * kept).sum())
        chance = float(fdtrc(count, freedom, part / max(count, 1)))
        explained = Explained(one, float(evidence[0]), value[0], covariance[0], chance)
        groups.setdefault((one.kind, one.rotors), []).append(explained)
    found = []
    for group in groups.values():
        best = max(group, key=lambda one: one.log_evidence)
        found.append(best._replace(log_evidence=float(np.logaddexp.reduce([one.log_evidence for one in group]))))
    return sorted(found, key=lambda one: -one.log_evidence)


# --- From trims to an answer: healthy or changed, which rotors, masses or shifts, how much, and how sure


SIGNIFICANT = 0.01
"""A change is one that healthy flights make less often than this."""
HEALTHY_SCORE = float(np.sqrt(chdtri(len(AXES), SIGNIFICANT)))
"""The score that one healthy flight in a hundred exceeds."""
_SURE = 0.75
"""A change is named with confidence where explanations that hold it have this much of the probability."""
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


Number = tuple[str, str, float, tuple[float, float] | None]
"""Name, unit, value and 95 % interval of a parameter, or None."""


@dataclass(frozen=True)
class Change:
    """One thing that changed.

    Attributes:
        p_value: chance that healthy flights differ so much along this explanation.
        share: probability of the explanations that hold it, among all.
        confident: whether it is certain enough to act on.
        rivals: other explanations, the most probable first.
    """

    effect: str
    parameters: tuple[Number, ...]
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
    """Changes since the baseline flights.

    Attributes:
        verdict: unchanged, changed or unknown.
        lacking: baseline flights that are lacking: with so many more that differ no more, this would be a change; the
            verdict is unknown then.  Else 0.
        changes: the most probable explanation; with confidence only where the verdict is changed.
        score: how far the flights are from healthy ones, in standard deviations of these.
        p_value: chance that a healthy flight looks as changed; where nothing explains a change, that one is as far
            from what explains best.
        trim: of the flights in question, shape (4,), see `AXES`.
        distance: of each trim from healthy, in standard deviations, shape (4,).
        healthy: the baseline's trim and spread.
        unfamiliar: why the flights are of a kind that no baseline flight is; the verdict is unknown then.  Else empty.
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
    unfamiliar: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain data of the form ``quadid.health/1``, without the names of files."""
        origin = np.where(np.array(AXES) == "effort", self.healthy.mean, 0.0)  # effort counts from the baseline's
        trims = self.trim - origin, self.healthy.mean - origin
        each = zip(AXES, *trims, self.healthy.deviation, self.distance, strict=True)
        return {
            "schema": "quadid.health/1",
            "verdict": self.verdict,
            "baseline_lacking": self.lacking,
            "unfamiliar": self.unfamiliar,
            "changes": [change.to_dict() for change in self.changes],
            "score": self.score,
            "p_value": self.p_value,
            "trim": [{"name": n, "value": v, "baseline": m, "spread": s, "distance": d} for n, v, m, s, d in each],
        }


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
    unexplained = p_rest < 1e-3
    # Flights of a kind that no baseline flight is: they turn much more, where rates are known
    now, usual = (max(flight.turning for flight in part) for part in (flights, baseline))
    unfamiliar = ""
    if now > max(3.0 * usual, 0.3):  # not of NaN
        unfamiliar = f"these flights turn by {now:.2g} rad/s (rms), the baseline flights by {usual:.2g} rad/s at most"
    # Baseline flights of the same spread that would make this a change if added, up to `ENOUGH` in all
    lacking = 0
    for count in () if named or unexplained or unfamiliar else range(healthy.flights + 1, ENOUGH + 1):
        if p_unchanged(change, healthy.known_from(count), len(flights), vehicle) < SIGNIFICANT:
            lacking = count - healthy.flights
            break
    verdict = "unknown" if unexplained or lacking or unfamiliar else "changed" if named else "unchanged"
    changes = () if unexplained else changes_of(found, vehicle, verdict == "changed", not unfamiliar)
    score, p_value = float(np.sqrt((far**2).sum())), p_rest if unexplained else p_value
    known = healthy, tuple(flights), tuple(baseline)
    return Health(verdict, lacking, changes, score, p_value, trim, far, *known, unfamiliar)


def changes_of(found: Sequence[Explained], vehicle: Vehicle, changed: bool, steady: bool = True) -> tuple[Change, ...]:
    """The best of the explanations of `compare` as changes, largest first, with the explanations that lost.

    Of two rotors on one axis only the yaw trim tells which one is weak; where it does not, or the flights are no
    `steady` ones, as motion moves that trim most, both are named.  Unless `changed`, nothing is named with confidence.
    """
    shares = np.exp([one.log_evidence - found[0].log_evidence for one in found])
    shares /= shares.sum()
    others = zip(found[1:4], shares[1:4], strict=True)
    best, lost = found[0], tuple(Rival(*one.names, one.p_value, float(share)) for one, share in others)
    kind, whole = best.hypothesis.kind, float(shares[0])

    def held(*rotors: int) -> float:
        """Probability of the explanations that hold one of these rotors."""
        return float(sum(s for e, s in zip(found, shares, strict=True) if {*rotors} & {*e.hypothesis.rotors}))

    def change(effect: str, numbers: Sequence[Number], evidence: str, *rivals: Rival, share: float = whole) -> Change:
        sure = changed and share > _SURE
        return Change(effect, tuple(numbers), best.p_value, share, sure, (*rivals, *lost), evidence)

    if kind == "weak_rotor":
        out = []
        for k, rotor in enumerate(best.hypothesis.rotors):
            # The rotor above or below this one; none for none
            away = np.linalg.norm(vehicle.rotor_positions[:, :2] - vehicle.rotor_positions[rotor, :2], axis=1)
            near = [k for k in np.flatnonzero(away < 0.1 * vehicle.arm).tolist() if k != rotor][:1]
            if set(near) & {*best.hypothesis.rotors} or steady and held(rotor) > _SURE:
                near = []
            which = " or ".join(str(j + 1) for j in (rotor, *near))
            loss, drag = best.number(2 * k), best.number(2 * k + 1)
            less, dragged = (f"{100.0 * abs(v):.0f} % {'less' if v >= 0.0 else 'more'}" for v, _ in (loss, drag))
            sentence = f"For the same command rotor {which} produces {less} thrust and {dragged} drag torque"
            numbers: list[Number] = [
                ("rotor", "", float(rotor + 1), None),
                ("loss", "", *loss),
                ("drag_loss", "", *drag),
            ]
            numbers += [("or_rotor", "", float(j + 1), None) for j in near]
            out.append(change(kind, numbers, f"{sentence} than in the baseline.", share=held(rotor, *near)))
        return tuple(sorted(out, key=lambda c: -abs(c.parameters[1][2])))
    if kind == "effort":
        value, interval = best.added(0)
        command = f"All rotors together need {100.0 * value:+.1f} % command for the same force"
        # Of measured speeds rather a mass; of commands rather the battery, which they do not show.
        effects, number = ("mass_change", "thrust_drop"), (value, interval)
        if value > 0.0 and vehicle.command.kind != "rotor_speed":
            effects, number = ("thrust_drop", "mass_change"), best.number(0)
        rival = Rival(effects[1:], (), best.p_value, whole)
        text = f"{command}, their balance is as it was."
        return (change(effects[0], [("fraction", "", *number)], text, rival),)
    # A shifted CG, alone or with the payload that shifts it
    place = [(name, "m", *best.number(k, vehicle.arm)) for k, name in enumerate("xy")]
    where = ", ".join(f"{1e3 * p[2]:+.1f} mm along {p[0]}" for p in place)
    shift = change("cg_offset", place, f"The centre of gravity moved by {where}; the yaw trim stayed.")
    if kind == "cg_offset":
        return (shift,)
    mass, interval = best.added(2)
    more = f"The rotors carry {100.0 * mass:.1f} % more, off centre."
    return (change("mass_change", [("fraction", "", mass, interval)], more), shift)
