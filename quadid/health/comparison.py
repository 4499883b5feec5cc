"""Healthy or changed, and by what: one Student-t likelihood for all explanations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc, log_ndtr, ndtri, stdtr

from quadid.health.hypotheses import Hypothesis
from quadid.health.spread import Healthy

FloatArray = NDArray[np.float64]


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


def explain(change: FloatArray, healthy: Healthy, flights: int, hypothesis: Hypothesis) -> Explained:
    """Evidence and posterior of one explanation.

    The change is Student-t with the spread's mean degrees of freedom v and p = 4 dimensions:
    log t = -(v + p)/2 log(1 + Q/v) - log|S|/2, S = D + A P A', Q = r' S^-1 r with r the
    change beyond the prior mean's, to a constant.  Parameters that cannot
    be negative restrict the Gaussian posterior; the restriction's odds (posterior over prior) count.
    """
    deviation = healthy.predictive(flights)
    noise = np.diag(deviation**2)
    a, p, centre = hypothesis.effect, hypothesis.prior, hypothesis.centre
    freedom = float(healthy.freedom.mean())
    spread = noise + a @ p @ a.T
    gain = np.linalg.solve(spread, a @ p).T
    beyond = change - a @ centre
    value = centre + gain @ beyond
    quadratic = float(beyond @ np.linalg.solve(spread, beyond))
    tail = (freedom + len(change)) / 2.0
    scale = (freedom + quadratic) / (freedom + len(change))
    covariance = scale * (p - gain @ a @ p)
    evidence = -tail * np.log1p(quadratic / freedom) - 0.5 * float(np.linalg.slogdet(spread)[1])
    for k in hypothesis.positive:
        evidence += float(log_ndtr(value[k] / np.sqrt(covariance[k, k]))) + np.log(2.0)
    return Explained(
        hypothesis, evidence + hypothesis.log_odds, value, covariance, _along(change, deviation, a, freedom)
    )


def _along(change: FloatArray, deviation: FloatArray, a: FloatArray, freedom: float) -> float:
    """F test of the part of the change that an explanation's free parameters account for."""
    scaled, z = a / deviation[:, None], change / deviation
    basis, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    kept = basis[:, sizes > 1e-9 * sizes[0]]
    part = float(((kept.T @ z) ** 2).sum())
    return float(fdtrc(kept.shape[1], freedom, part / kept.shape[1]))


def compare(change: FloatArray, healthy: Healthy, flights: int, offered: Sequence[Hypothesis]) -> list[Explained]:
    """All explanations, the best first; those of one kind and rotors count as one, with the best's values.

    The best is the most probable one of the most probable kind: a kind is not worth less because it has many members.
    """
    groups: dict[tuple[str, tuple[int, ...]], list[Explained]] = {}
    for hypothesis in offered:
        mine = groups.setdefault((hypothesis.kind, hypothesis.rotors), [])
        mine.append(explain(change, healthy, flights, hypothesis))
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
