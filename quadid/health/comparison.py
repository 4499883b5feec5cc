"""Healthy or changed, and by what: one Student-t likelihood for all explanations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, log_ndtr, ndtri, stdtr

from quadid.health.hypotheses import Hypothesis
from quadid.health.spread import Healthy
from quadid.types import FloatArray


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


def _explain(change: FloatArray, healthy: Healthy, flights: int, alike: Sequence[Hypothesis]) -> list[Explained]:
    """Evidence and posterior of explanations with as many parameters each.

    The change is Student-t with the spread's mean degrees of freedom v and p = 4 dimensions:
    log t = -(v + p)/2 log(1 + Q/v) - log|S|/2, S = D + A P A', Q = r' S^-1 r with r the
    change beyond the prior mean's, to a constant.  Parameters that cannot
    be negative restrict the Gaussian posterior; the restriction's odds (posterior over prior) count.
    """
    deviation, freedom = healthy.predictive(flights), float(healthy.freedom.mean())
    a, p, centre = (
        np.stack(part) for part in zip(*((one.effect, one.prior, one.centre) for one in alike), strict=True)
    )
    spread = np.diag(deviation**2) + a @ p @ a.transpose(0, 2, 1)
    gain = np.linalg.solve(spread, a @ p).transpose(0, 2, 1)
    beyond = change - np.einsum("hkj,hj->hk", a, centre)
    value = centre + np.einsum("hjk,hk->hj", gain, beyond)
    quadratic = (beyond * np.linalg.solve(spread, beyond[..., None])[..., 0]).sum(axis=1)
    scale = (freedom + quadratic) / (freedom + len(change))
    covariance = scale[:, None, None] * (p - gain @ a @ p)
    evidence = -0.5 * (freedom + len(change)) * np.log1p(quadratic / freedom) - 0.5 * np.linalg.slogdet(spread)[1]
    odds = log_ndtr(value / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))) + np.log(2.0)
    chances = _along(change / deviation, a / deviation[:, None], freedom)
    return [
        Explained(one, float(e + o[list(one.positive)].sum() + one.log_odds), v, c, float(chance))
        for one, e, o, v, c, chance in zip(alike, evidence, odds, value, covariance, chances, strict=True)
    ]


def _along(z: FloatArray, scaled: FloatArray, freedom: float) -> FloatArray:
    """F test of the part of the change that explanations' free parameters account for, shape (explanations,)."""
    basis, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    kept = sizes > 1e-9 * sizes[:, :1]
    part = (np.einsum("hkj,k->hj", basis, z) ** 2 * kept).sum(axis=1)
    count = kept.sum(axis=1)
    return np.asarray(fdtrc(count, freedom, part / count))


def compare(change: FloatArray, healthy: Healthy, flights: int, offered: Sequence[Hypothesis]) -> list[Explained]:
    """All explanations, the best first; those of one kind and rotors count as one, with the best's values.

    The best is the most probable one of the most probable kind: a kind is not worth less because it has many members.
    """
    by_size: dict[int, list[Hypothesis]] = {}
    for hypothesis in offered:
        by_size.setdefault(len(hypothesis.centre), []).append(hypothesis)
    groups: dict[tuple[str, tuple[int, ...]], list[Explained]] = {}
    for alike in by_size.values():
        for one in _explain(change, healthy, flights, alike):
            groups.setdefault((one.hypothesis.kind, one.hypothesis.rotors), []).append(one)
    found = []
    for group in groups.values():
        best = max(group, key=lambda one: one.log_evidence)
        total = float(np.logaddexp.reduce([one.log_evidence for one in group]))
        found.append(best._replace(log_evidence=total))
    kinds: dict[str, list[float]] = {}
    for one in found:
        kinds.setdefault(one.hypothesis.kind, []).append(one.log_evidence)
    probable = max(kinds, key=lambda kind: float(np.logaddexp.reduce(kinds[kind])))
    first = max((one for one in found if one.hypothesis.kind == probable), key=lambda one: one.log_evidence)
    return [first, *sorted((one for one in found if one is not first), key=lambda one: -one.log_evidence)]
