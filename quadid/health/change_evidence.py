"""Healthy or changed, and by what: one Student-t likelihood for all explanations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, log_ndtr, ndtri, stdtr, stdtrit
from scipy.stats import qmc

from quadid.health.hypotheses import Hypothesis, hypotheses
from quadid.health.spread import Healthy
from quadid.health.trim_estimation import AXES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

_DRAWS = 8192
"""Healthy flights that are drawn to estimate how rare an evidence of change is among them."""
LEAST_CHANCE = 1.0 / (_DRAWS + 1)
"""The smallest `p_unchanged`: no drawn flight speaks for a change as much."""


class Explained(NamedTuple):
    """One explanation after the fact.

    Attributes:
        hypothesis: what may have changed.
        log_evidence: of the change of trim, with the prior odds.
        value: posterior mean of the parameters, shape (parameters,).
        covariance: posterior covariance.
        p_value: chance that healthy flights differ so much along this explanation.
    """

    hypothesis: Hypothesis
    log_evidence: float
    value: FloatArray
    covariance: FloatArray
    p_value: float


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


class _Fitted(NamedTuple):
    """Explanations with as many parameters each, of several changes of trim.

    Attributes:
        log_evidence: with the prior odds, shape (explanations, changes).
        value: posterior means, shape (explanations, changes, parameters).
        covariance: posterior covariances of the Gaussian case, shape (explanations, parameters, parameters).
        scale: what these are multiplied with, shape (explanations, changes).
    """

    log_evidence: FloatArray
    value: FloatArray
    covariance: FloatArray
    scale: FloatArray


def _log_student(quadratic: FloatArray, log_determinant: FloatArray, freedom: float) -> FloatArray:
    """Student-t density of `quadratic` in as many dimensions as a trim has, to a constant."""
    return np.asarray(-0.5 * (freedom + len(AXES)) * np.log1p(quadratic / freedom) - 0.5 * log_determinant)


def _fit(changes: FloatArray, deviation: FloatArray, freedom: float, alike: Sequence[Hypothesis]) -> _Fitted:
    """Evidence and posterior of explanations with as many parameters each, of changes of shape (changes, 4).

    A change is Student-t with the spread's mean degrees of freedom v and p = 4 dimensions:
    log t = -(v + p)/2 log(1 + Q/v) - log|S|/2, S = D + A P A', Q = r' S^-1 r with r the
    change beyond the prior mean's, to a constant.  Parameters that cannot
    be negative restrict the Gaussian posterior; the restriction's odds (posterior over prior) count.
    """
    a, p, centre = (
        np.stack(part) for part in zip(*((one.effect, one.prior, one.centre) for one in alike), strict=True)
    )
    log_odds = np.array([one.log_odds for one in alike])
    positive = np.array([[k in one.positive for k in range(p.shape[1])] for one in alike])
    spread = np.diag(deviation**2) + a @ p @ a.transpose(0, 2, 1)
    inverse = np.linalg.inv(spread)
    gain = inverse @ a @ p
    beyond = changes - np.einsum("hkj,hj->hk", a, centre)[:, None]
    value = centre[:, None] + beyond @ gain
    quadratic = (beyond @ inverse * beyond).sum(axis=-1)
    scale = (freedom + quadratic) / (freedom + len(AXES))
    covariance = p - p @ a.transpose(0, 2, 1) @ gain
    evidence = _log_student(quadratic, np.linalg.slogdet(spread)[1][:, None], freedom)
    deviations = np.sqrt(scale[..., None] * np.diagonal(covariance, axis1=1, axis2=2)[:, None])
    some = positive.any(axis=0)
    odds = (log_ndtr((value / deviations)[..., some]) + np.log(2.0)) * positive[:, None, some]
    return _Fitted(evidence + odds.sum(axis=-1) + log_odds[:, None], value, covariance, scale)


def _by_size(offered: Sequence[Hypothesis]) -> list[list[Hypothesis]]:
    """Explanations with as many parameters each, together."""
    sizes = sorted({len(one.centre) for one in offered})
    return [[one for one in offered if len(one.centre) == size] for size in sizes]


def _changed_over_unchanged(
    changes: FloatArray, healthy: Healthy, flights: int, offered: Sequence[Hypothesis]
) -> FloatArray:
    """Logarithm of the evidence that something changed over that nothing did, to a constant, shape (changes,)."""
    deviation, freedom = healthy.predictive(flights), float(healthy.freedom.mean())
    fitted = [_fit(changes, deviation, freedom, alike).log_evidence for alike in _by_size(offered)]
    quadratic, log_determinant = ((changes / deviation) ** 2).sum(axis=1), 2.0 * np.log(deviation).sum()
    unchanged = _log_student(quadratic, log_determinant, freedom)
    return np.asarray(np.logaddexp.reduce(np.vstack(fitted)) - unchanged)


def p_unchanged(change: FloatArray, healthy: Healthy, flights: int, vehicle: Vehicle) -> float:
    """Chance that healthy flights speak for a change as much as `change` of trim does; at least `LEAST_CHANCE`.

    What is compared is the evidence of all explanations together over that of no change: among all tests with as many
    false alarms, this one finds the most of what the priors expect (Neyman and Pearson).  Healthy flights are `_DRAWS`
    points of a Sobol sequence in the predictive distribution of the spread.
    """
    offered = hypotheses(vehicle, healthy.shares, healthy.mean)
    drawn = _evidence_of_draws(_Question(_bytes(healthy, offered), healthy, flights, tuple(offered)))
    own = _changed_over_unchanged(exact(change)[None], healthy, flights, offered)
    return float((1 + np.count_nonzero(drawn >= own)) / (len(drawn) + 1))


@dataclass(frozen=True)
class _Question:
    """What the evidence of draws follows from, and its bytes, the key of the cache."""

    key: tuple[bytes, ...]
    healthy: Healthy = field(compare=False)
    flights: int
    offered: tuple[Hypothesis, ...] = field(compare=False)


def _bytes(healthy: Healthy, offered: Sequence[Hypothesis]) -> tuple[bytes, ...]:
    numbers = [healthy.mean, healthy.deviation, healthy.freedom, healthy.predictive(1), healthy.shares]
    return tuple(part.tobytes() for part in (*numbers, *(one.effect for one in offered)))


@lru_cache(maxsize=32)
def _evidence_of_draws(question: _Question) -> FloatArray:
    """Evidence of change in draws of healthy flights, which all flights after one baseline share, shape (draws,)."""
    points = _healthy_points(*question.healthy.freedom) * question.healthy.predictive(question.flights)
    return _changed_over_unchanged(exact(points), question.healthy, question.flights, question.offered)


@cache
def _healthy_points(*freedom: float) -> FloatArray:
    """Draws of independent Student t of these degrees of freedom, shape (draws, axes); always the same."""
    points = qmc.Sobol(len(freedom), scramble=True, seed=0).random(_DRAWS)
    return np.column_stack([stdtrit(v, column) for v, column in zip(freedom, points.T, strict=True)])


def _explain(change: FloatArray, healthy: Healthy, flights: int, alike: Sequence[Hypothesis]) -> list[Explained]:
    """Explanations with as many parameters each, of one change."""
    deviation, freedom = healthy.predictive(flights), float(healthy.freedom.mean())
    fitted = _fit(change[None], deviation, freedom, alike)
    chances = _along(change / deviation, np.stack([one.effect for one in alike]) / deviation[:, None], freedom)
    value, covariance = fitted.value[:, 0], fitted.scale[:, 0, None, None] * fitted.covariance
    each = zip(alike, fitted.log_evidence[:, 0].tolist(), value, covariance, chances.tolist(), strict=True)
    return [Explained(*one) for one in each]


def _along(z: FloatArray, scaled: FloatArray, freedom: float) -> FloatArray:
    """F test of the part of the change that explanations' free parameters account for, shape (explanations,)."""
    basis, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    kept = sizes > 1e-9 * sizes[:, :1]
    part = (np.einsum("hkj,k->hj", basis, z) ** 2 * kept).sum(axis=1)
    count = kept.sum(axis=1)
    return np.asarray(fdtrc(count, freedom, part / count))


def compare(change: FloatArray, healthy: Healthy, flights: int, offered: Sequence[Hypothesis]) -> list[Explained]:
    """All explanations of an `exact` change, the most probable first.

    Those of one kind and rotors count as one, with the best's values.
    """
    groups: dict[tuple[str, tuple[int, ...]], list[Explained]] = {}
    for alike in _by_size(offered):
        for one in _explain(change, healthy, flights, alike):
            groups.setdefault((one.hypothesis.kind, one.hypothesis.rotors), []).append(one)
    found = []
    for group in groups.values():
        best = max(group, key=lambda one: one.log_evidence)
        found.append(best._replace(log_evidence=float(np.logaddexp.reduce([one.log_evidence for one in group]))))
    return sorted(found, key=lambda one: -one.log_evidence)
