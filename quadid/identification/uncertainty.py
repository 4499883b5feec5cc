"""Uncertainty of a fit: autocorrelated residuals, scale of mass and arm; intervals and status."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.chi_square import Z95
from quadid.identification.elimination import eliminated
from quadid.identification.problem import Free, Linearised, Prior, posterior_covariance
from quadid.parameters import (
    MAY_VANISH,
    NOMINAL_NAMES,
    PRIOR_SHARE,
    Parameter,
    ParameterSet,
    Status,
    at_bound,
    unreliable,
)
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

# --- Covariance, corrected for autocorrelation, and status


LAG_SECONDS = 2.0
"""Scores of segments up to this far apart may be correlated."""
NOT_NOTHING = 1.0 / 3.0
"""Relative standard deviation above which what may vanish is not distinguished from zero."""
KNOWN = 0.03
"""A log-scale standard deviation below this is identified whatever its correlations."""
RATIO_SIGMA = 0.05
RATIO_GAIN = 0.25
"""A ratio is known when its standard deviation is below RATIO_SIGMA and below RATIO_GAIN of the parameter's own."""
SPREAD_LIMIT = 0.1
"""Spread of estimates of one parameter (log scale) beyond which none of them is to be used."""


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of the scaled parameters.

    Attributes:
        covariance: posterior with prior, corrected, shape (P, P).
        inflation: factor on each standard deviation from autocorrelated or excess residuals, shape (P,).
        prior_sigma: standard deviation of the prior, shape (P,).
        grown: factor on each standard deviation from what estimates differ by, see `reliability`, shape (P,); None: not
            compared.
        spread: what has to stay below `SPREAD_LIMIT`, shape (P,).
    """

    covariance: FloatArray
    inflation: FloatArray
    prior_sigma: FloatArray
    grown: FloatArray | None = None
    spread: FloatArray | None = None

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of each scaled parameter, shape (P,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def prior_share(self) -> FloatArray:
        """Share of the information on each parameter that the prior brings, shape (P,)."""
        return np.asarray(np.minimum((self.from_noise / (self.inflation * self.prior_sigma)) ** 2, 1.0))

    @property
    def from_noise(self) -> FloatArray:
        """Standard deviation of each scaled parameter without what estimates differ by, shape (P,)."""
        return self.sigma if self.grown is None else self.sigma / self.grown

    def differing(self, steps: Sequence[FloatArray]) -> Uncertainty:
        """Intervals that hold other estimates too, which lie `steps` away, each of shape (P,); they count as spread."""
        if not steps:
            return self
        farthest = np.max(np.abs(steps), axis=0)
        return self.widened(farthest, farthest)

    def widened(self, by: FloatArray, spread: FloatArray) -> Uncertainty:
        """With standard deviations `by` added, and `spread` to what has to stay below its limit, both shape (P,)."""
        grow = np.hypot(1.0, by / np.maximum(self.sigma, 1e-300))
        grown = grow if self.grown is None else grow * self.grown
        spread = spread if self.spread is None else np.hypot(self.spread, spread)
        return replace(self, covariance=self.covariance * np.outer(grow, grow), grown=grown, spread=spread)


def uncertainty(lin: Linearised, prior: Prior) -> Uncertainty:
    """Posterior covariance, widened where the segment scores are larger or more correlated than modelled.

    The widening is the ratio of the heteroscedasticity- and autocorrelation-consistent ("sandwich") variance (Newey and
    West, Econometrica 55 (1987) 703) to the model's; it is applied only where it exceeds its own sampling error, so
    that well-modelled data keep the efficient interval.

    Args:
        lin: linearisation at the optimum.
        prior: what is known of the parameters beforehand.
    """
    covariance = posterior_covariance(lin.information, prior)
    inflation = np.ones(len(prior.sigma))
    if len(lin.grad) >= 10:
        ratio, lags = variance_ratio(lin, covariance)
        sampling = math.sqrt(2.0 / len(lin.grad) * (1.0 + 4.0 / 3.0 * lags))
        inflation = np.where(ratio > 1.0 + 2.0 * sampling, np.sqrt(np.maximum(ratio, 1.0)), 1.0)
    return Uncertainty(covariance * np.outer(inflation, inflation), inflation, prior.sigma)


def variance_ratio(lin: Linearised, covariance: FloatArray) -> tuple[FloatArray, int]:
    """True variance of each parameter over that in `covariance` (P, P), shape (P,), and the number of lags used.

    The true one is the "sandwich" of `score_products`.
    """
    meat, lags = score_products(lin)
    return np.asarray(np.diag(covariance @ meat @ covariance) / np.diag(covariance)), lags


def score_products(lin: Linearised) -> tuple[FloatArray, int]:
    """Bartlett-weighted (P, P) sum of score products over segments of the same window, and the number of lags used."""
    # Newey and West: sum over lags l of (1 - l / (L + 1)) (s_t s_t-l' + s_t-l s_t'), s_t the score of segment t.
    step = lin.spacing
    lags = max(int(round(LAG_SECONDS / max(step, 1e-6))), 1)
    scores = lin.grad - lin.grad.mean(axis=0)
    meat = scores.T @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        near = (lin.window[lag:] == lin.window[:-lag]) & (lin.time[lag:] - lin.time[:-lag] < (lag + 0.5) * step)
        cross = scores[lag:][near].T @ scores[:-lag][near]
        meat += (1.0 - lag / (lags + 1.0)) * (cross + cross.T)
    return meat, lags


def parameter_set(free: Free, theta: FloatArray, initial: FloatArray, unc: Uncertainty) -> ParameterSet:
    """Parameters with units, intervals (log scale for nominal ones) and status.

    One that the data do not show, and nothing showed before, keeps its guess where its interval holds that.
    """
    scale, at = free.jacobian(theta), theta[free.index]
    sigma = unc.sigma * scale
    low, high = (free.shifted(at, z) for z in (-Z95 * unc.sigma, Z95 * unc.sigma))
    out = []
    for j, e in enumerate(free.entries):
        value, ci = float(at[j]), (float(low[j]), float(high[j]))
        status, partner = _status(j, free, unc, value, ci)
        guess = float(initial[e.index])
        loose = 0.98 * min(math.log(e.upper / guess), math.log(guess / e.lower)) if free.is_log[j] else 0.0
        measured = float(unc.prior_sigma[j]) < loose
        kept = status is Status.PRIOR_DOMINATED and not measured and ci[0] <= guess <= ci[1]
        out.append(
            Parameter(
                e.name,
                e.unit,
                guess if kept else value,
                float(sigma[j]),
                guess,
                (e.lower, e.upper),
                status,
                partner,
                ci,
                float(unc.prior_share[j]),
                measured,
            )
        )
    return ParameterSet(tuple(out), unc.covariance * np.outer(scale, scale))


def _status(j: int, free: Free, unc: Uncertainty, value: float, ci: tuple[float, float]) -> tuple[Status, str | None]:
    sigma, entry = unc.sigma, free.entries[j]
    if at_bound(value, entry.lower, entry.upper):
        return Status.UNRELIABLE, None
    if unc.from_noise[j] > PRIOR_SHARE * unc.prior_sigma[j] or (entry.name == MAY_VANISH and sigma[j] > NOT_NOTHING):
        return Status.PRIOR_DOMINATED, None
    if free.is_log[j] and not (entry.lower <= ci[0] and ci[1] <= entry.upper):  # then the bound affects the value
        return Status.UNRELIABLE, None
    limit = SPREAD_LIMIT if free.is_log[j] else SPREAD_LIMIT * max(1.0, abs(value) / entry.typical)
    if unc.spread is not None and unc.spread[j] > limit:
        return Status.UNRELIABLE, None
    if not free.is_log[j] or sigma[j] <= KNOWN:
        return Status.IDENTIFIED, None
    best, partner = math.inf, None
    for k in range(len(sigma)):
        if k == j or (free.is_log[k] and sigma[k] <= 0.3 * sigma[j]):
            continue
        if free.is_log[k]:
            left = unc.covariance[j, j] + unc.covariance[k, k] - 2.0 * unc.covariance[j, k]
        else:  # an effect's number, were it known
            left = unc.covariance[j, j] - unc.covariance[j, k] ** 2 / unc.covariance[k, k]
        spread = math.sqrt(max(left, 0.0))
        if spread < best:
            best, partner = spread, free.entries[k].name
    if best <= min(RATIO_SIGMA, RATIO_GAIN * sigma[j]):
        return Status.RATIO_ONLY, partner
    return Status.IDENTIFIED, None


# --- What a doubt about the log does to the result


def doubted(parameters: Sequence[Parameter], off: Mapping[str, float]) -> tuple[tuple[Parameter, ...], tuple[str, ...]]:
    """Parameters whose intervals hold the truth if a doubt about the log is right, too, and remarks on them.

    Args:
        parameters: as the log shows them.
        off: natural logarithm of estimate over truth by parameter if the doubt is right.
    """
    out = tuple(_off_by(p, off[p.name]) if off.get(p.name) else p for p in parameters)
    moved = {p.name: round(100.0 * math.expm1(off[p.name])) for p in parameters if p.name in off}
    listed = ", ".join(f"{name} {percent:+d} %" for name, percent in moved.items() if percent)
    told = (
        f"if the warnings about the log are right, these estimates are off, and their intervals allow for it: {listed}"
    )
    return out, (told,) if listed else ()


def _off_by(p: Parameter, step: float) -> Parameter:
    """The parameter with an interval that holds a step (log scale), which counts as spread; none is beyond bounds."""
    least, most = p.bounds
    step = min(abs(step), math.log(most / least))
    wide = math.hypot(p.sigma / p.value, step)
    ci = (p.value * math.exp(-Z95 * wide), p.value * math.exp(Z95 * wide))
    wider = replace(p, sigma=wide * p.value, ci95=ci)
    if step <= SPREAD_LIMIT and least <= ci[0] and ci[1] <= most:
        return wider
    return unreliable([wider], [p.name])[0]


# --- What an uncertain mass or arm does to the result
#
# Motion shows ratios only.  Scaling mass, b, d, all inertias and J_r by one factor leaves every motion as it is; so
# does scaling the arm, d, all inertias and J_r.  The logarithms of both factors are nuisance parameters with a known
# spread; they are marginalised from the Gaussian posterior, so that what is known of one inertia from elsewhere (CAD,
# a swing test) tightens the others and b as well.


def with_scale_uncertainty(
    vehicle: Vehicle, free: Free, prior: Prior, theta: FloatArray, unc: Uncertainty
) -> tuple[FloatArray, Uncertainty]:
    """Posterior of the parameters when mass and arm are known to `Vehicle.mass_sigma` and `Vehicle.arm_sigma` only.

    Args:
        vehicle: the vehicle file.
        free: free parameters.
        prior: their prior.
        theta: full vector at the posterior's mode for exact mass and arm.
        unc: its covariance (P, P), scaled parameters.

    Returns:
        Full vector and covariance; as given where mass and arm are taken for exact.
    """
    spread = np.array([vehicle.mass_sigma / vehicle.mass, vehicle.arm_sigma / vehicle.arm])
    some = spread > 0.0
    if not some.any():
        return theta, unc
    # Information of the data alone; the logarithms of mass and arm beside the parameters, then eliminated.
    directions = _directions(free, theta)[:, some]
    p = np.diag(prior.precision)
    values, vectors = np.linalg.eigh(np.linalg.inv(unc.covariance) - p)
    h = (vectors * np.maximum(values, 0.0)) @ vectors.T
    reach = h @ directions
    left = eliminated(h, reach, directions.T @ reach + np.diag(spread[some] ** -2.0))
    covariance = np.asarray(np.linalg.inv(left.h + p))
    start = theta.copy()
    start[free.index] = prior.mean
    pull = p @ free.step(theta, start)
    # At the mode the data pull exactly against the prior; the part of that pull along the scales is worth less now.
    step = covariance @ (left.gain @ (directions.T @ pull))
    return free.move(theta, step), replace(unc, covariance=covariance)


def _directions(free: Free, theta: FloatArray) -> FloatArray:
    """Exponents with which each scaled parameter goes with the logarithm of mass and of arm, shape (P, 2)."""
    out = np.zeros((len(free.entries), 2))
    for j, e in enumerate(free.entries):
        if e.name in NOMINAL_NAMES:
            out[j] = (1.0, 0.0 if e.name == "b" else 1.0)
        elif e.unit == "kg m^2":
            out[j] = theta[e.index] / e.typical
    return out
