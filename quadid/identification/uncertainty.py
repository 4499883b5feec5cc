"""Uncertainty of a fit: intervals and status, consistency of estimates, and what a flight can reveal at all."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadid.chi_square import Z95, exceeded
from quadid.data.window import Window
from quadid.errors import ParameterError
from quadid.identification.elimination import eliminated
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Free, Linearised, Prior, Shooting, posterior_covariance
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
from quadid.rotation import continuous_sign
from quadid.types import FloatArray, IndexArray
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

    def differing(self, steps: Sequence[FloatArray]) -> "Uncertainty":
        """Intervals that hold other estimates too, which lie `steps` away, each of shape (P,); they count as spread."""
        if not steps:
            return self
        farthest = np.max(np.abs(steps), axis=0)
        return self.widened(farthest, farthest)

    def widened(self, by: FloatArray, spread: FloatArray) -> "Uncertainty":
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
        ratio, lags = variance_ratio(covariance, lin.grad, lin.window, lin.time, lin.spacing)
        sampling = math.sqrt(2.0 / len(lin.grad) * (1.0 + 4.0 / 3.0 * lags))
        inflation = np.where(ratio > 1.0 + 2.0 * sampling, np.sqrt(np.maximum(ratio, 1.0)), 1.0)
    return Uncertainty(covariance * np.outer(inflation, inflation), inflation, prior.sigma)


def variance_ratio(
    covariance: FloatArray, scores: FloatArray, window: IndexArray, time: FloatArray, step: float
) -> tuple[FloatArray, int]:
    """True variance of each parameter over that in `covariance` (P, P), shape (P,), and the number of lags used.

    The true one is the "sandwich" of Bartlett-weighted sums of score products over segments of the same window.

    Args:
        covariance: by the information of the data.
        scores: of each segment, shape (segments, P).
        window: to which it belongs; time: when it begins [s].
        step: time from one segment to the next [s].
    """
    # Newey and West: sum over lags l of (1 - l / (L + 1)) (s_t s_t-l' + s_t-l s_t'), s_t the score of segment t.
    lags = max(int(round(LAG_SECONDS / max(step, 1e-6))), 1)
    scores = scores - scores.mean(axis=0)
    meat = scores.T @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        near = (window[lag:] == window[:-lag]) & (time[lag:] - time[:-lag] < (lag + 0.5) * step)
        cross = scores[lag:][near].T @ scores[:-lag][near]
        meat += (1.0 - lag / (lags + 1.0)) * (cross + cross.T)
    return np.asarray(np.diag(covariance @ meat @ covariance) / np.diag(covariance)), lags


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


# --- Consistency of estimates across parts of the data and models
#
# Blocks of time, every second row, and models with each cause added that the residual asks for, all estimate the same
# parameters.  What they differ by beyond chance belongs to the model, not to the noise:
# intervals are widened by it, between blocks as random effects (DerSimonian and Laird, Controlled Clinical Trials 7
# (1986) 177), and beyond `SPREAD_LIMIT` the number is not to be used.


# --- The same flight on a grid twice as coarse: how much a parameter depends on what the inputs do within a row
#
# A log holds one value of each input a row; what it does within the row is not known.  What that changes grows with the
# square of the row's length: feedback that runs on within held commands, behind a lag or a delay, looks like another
# inertia by that much.  Every second row of the same data therefore shows three times what the rows at hand may be off
# by (Richardson, Phil. Trans. R. Soc. A 210 (1911) 307).  Of readings, what turns too fast for them is at fault: every
# second row of a low-pass over all channels is without it.


SHARE = 1.0 / 3.0
"""Of the difference between two grids, of which one is twice as coarse, that the finer one is off by."""


SLOW, REACH = 1.0 / 6.0, 9
"""Cutoff of the low-pass before readings are halved, as a share of their rate, and the rows that it reaches."""


def coarse(window: Window) -> Window:
    """Every second row of `window`; forces and held speeds are means over the longer rows, readings low-passed."""
    window = window if window.sampling == "held" else _slow(window)
    n = len(window) // 2 * 2
    even: dict[str, Any] = {name: None if (x := getattr(window, name)) is None else x[:n:2] for name in _REFERENCES}
    even |= {name: None if (x := getattr(window, name)) is None else _every_second(x[:n]) for name in _INSTANTS}
    if window.attitude is not None:
        between = np.isnan(window.attitude[:n:2, 0])
        even["attitude"][between] /= np.linalg.norm(even["attitude"][between], axis=1, keepdims=True)
    accel = None if window.accel is None else _every_second(_smoothed(window.accel)[:n])
    speed, slope = window.rotor_speed[:n:2], None
    if window.sampling == "held":
        first, second = window.rotor_speed[:n:2], window.rotor_speed[1:n:2]
        speed = np.sqrt(0.5 * (first**2 + second**2))  # what thrust and drag torque are means of
        if window.rotor_slope is not None:
            own = window.rotor_slope[:n:2] + window.rotor_slope[1:n:2]
            slope = 0.75 * (second - first) / window.dt + 0.125 * own  # of the straight line with the same moment
    return replace(window, dt=2.0 * window.dt, rotor_speed=speed, rotor_slope=slope, accel=accel, **even)


def _slow(window: Window) -> Window:
    """Readings and all channels that are measured in every row, behind one low-pass without delay."""
    reach = min(REACH, len(window) - 1)
    taps = np.sinc(2.0 * SLOW * np.arange(-reach, reach + 1)) * np.hamming(2 * reach + 1)
    taps /= taps.sum()

    def passed(values: FloatArray) -> FloatArray:
        wide = np.pad(values, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
        return np.column_stack([np.convolve(column, taps, mode="valid") for column in wide.T])

    whole = {name: x for name in _INSTANTS if (x := getattr(window, name)) is not None and np.isfinite(x).all()}
    out: dict[str, Any] = {n: passed(continuous_sign(x) if n == "attitude" else x) for n, x in whole.items()}
    if "attitude" in out:
        out["attitude"] /= np.linalg.norm(out["attitude"], axis=1, keepdims=True)
    if window.accel is not None and np.isfinite(window.accel).all():
        out["accel"] = passed(window.accel)
    return replace(window, rotor_speed=np.sqrt(np.maximum(passed(window.rotor_speed**2), 0.0)), **out)


_INSTANTS = ("gyro", "attitude", "velocity", "position")
_REFERENCES = ("battery", "attitude_reference")


def _every_second(values: FloatArray) -> FloatArray:
    """Every second row; of a channel slower than the rows also what was measured between, on the line through it.

    Otherwise nothing may be left: 25 Hz on rows of 50 Hz can lie in the odd ones alone.
    """
    known = np.asarray(np.isfinite(values).all(axis=1))
    rows, out = np.flatnonzero(known), values[::2].copy()
    if 0 < 2 * len(rows) <= len(known):
        between = np.flatnonzero(~known[::2] & known[1::2])
        between = between[2 * between > rows[0]]
        for c, column in enumerate(values.T):
            out[between, c] = np.interp(2 * between, rows, column[rows])
    return out


def _smoothed(accel: FloatArray) -> FloatArray:
    """Means over two rows around each row, where both neighbours are known."""
    wide = np.pad(accel, ((1, 1), (0, 0)), constant_values=np.nan)
    mean = 0.25 * wide[:-2] + 0.5 * accel + 0.25 * wide[2:]
    return np.asarray(np.where(np.isnan(mean), accel, mean))


# --- Estimates compared


BLOCKS = 6
"""Blocks of time that are compared; enough that their spread is known to a third."""
CHANCE = 0.01
"""Probability with which a difference of right estimates is taken for one of the model."""
NEAR_BEST = 0.15
"""Share of what the best cause promises below which another is no rival to it."""
WIDE = 0.7
"""Standard deviation of a prior (scaled parameters) that leaves the data to themselves."""


@dataclass(frozen=True)
class Reliability:
    """Differences of estimates of the parameters, beyond chance.

    Attributes:
        spread: standard deviation between estimates, scaled parameters, shape (P,).
        widening: of the estimate itself, shape (P,): of many blocks their mean is known better than each.
        steps: from the fit to other estimates, shape (estimates, P); names: what was different.
        missed: it misses the flight by so much that no number is to be used.
    """

    spread: FloatArray
    widening: FloatArray
    steps: FloatArray
    names: tuple[str, ...]
    missed: bool

    def widened(self, unc: Uncertainty) -> Uncertainty:
        """Intervals that hold what the estimates differ by."""
        return unc.widened(self.widening, np.full(len(self.spread), np.inf) if self.missed else self.spread)

    def reasons(self, free: Free) -> tuple[str, ...]:
        """Sentences on the nominal parameters whose estimates differ too much."""
        if self.missed:
            return ("the model is so far from this flight that its numbers are not to be used",)
        why: dict[str, list[str]] = {}
        for j in np.flatnonzero((self.spread > SPREAD_LIMIT) & free.is_log):
            k = int(np.argmax(np.abs(self.steps[:, j]))) if len(self.steps) else -1
            close = k < 0 or abs(self.steps[k, j]) < self.spread[j]
            how = f"more than {SPREAD_LIMIT:.0%} different {'between parts of the flight' if close else self.names[k]}"
            why.setdefault(how, []).append(free.names[j])
        return tuple(f"{', '.join(n)}: {how}" for how, n in why.items())


def random_effects(steps: FloatArray, variances: FloatArray) -> FloatArray:
    """Standard deviation that differences between blocks, beyond chance, add to that of the estimate, shape (P,).

    An estimate of all blocks lies amid theirs, unless they differ in another parameter: then that one is a compromise,
    and what moves with it agrees between blocks on another value.  Where that lies beyond `SPREAD_LIMIT`, how far it
    lies off counts as well.

    Args:
        steps: from the estimate to that of each block, shape (blocks, P).
        variances: of these, shape (blocks, P).
    """
    # Variance between blocks from the excess of Q over its degrees of freedom.
    count, weight = len(steps), 1.0 / variances
    total = weight.sum(axis=0)
    q = np.sum(weight * (steps - np.sum(weight * steps, axis=0) / total) ** 2, axis=0)
    excess = np.maximum(q - (count - 1), 0.0) / (total - np.sum(weight**2, axis=0) / total)
    tau = np.where(q > exceeded(CHANCE, count - 1), np.sqrt(excess), 0.0)
    # Their mean with it, and where it lies off by more than chance and too far.
    weight = 1.0 / (variances + tau**2)
    mean, variance = np.sum(weight * steps, axis=0) / weight.sum(axis=0), 1.0 / weight.sum(axis=0)
    off = np.where(mean**2 > np.maximum(exceeded(CHANCE, 1) * variance, SPREAD_LIMIT**2), np.abs(mean), 0.0)
    return np.asarray(np.sqrt(np.maximum(variance - 1.0 / total, 0.0) + off**2))


def promised(
    best: Callable[[list[int]], tuple[FloatArray, float]], own: list[int], causes: Mapping[str, list[int]]
) -> list[tuple[str, float, FloatArray]]:
    """Each cause, how much of the cost it takes away, and the step of the parameters beside it.

    Args:
        best: step of the entries at these places, and how much of the cost it takes away.
        own: places of what is free already, shape (P,); both are beyond what these take away alone.
        causes: places of the entries of each.
    """
    none, start = best(own)
    out = []
    for name, entries in causes.items():
        step, gain = best([*own, *entries])
        out.append((name, gain - start, step[: len(own)] - none))
    return out


# --- Excitation: which parameters a window can reveal, from the Fisher information, before anything is fitted


SECONDS = 1.0
"""Length of the segments [s]."""


@dataclass(frozen=True)
class Excitation:
    """Cramer-Rao bounds from a window.

    Attributes:
        names: parameters.
        bound: smallest reachable relative standard deviation of each (absolute, in typical sizes, for effects),
            all others unknown too; infinite without information.
        alone: the same if all other parameters were known.
        information: Fisher information of the scaled parameters (P, P).
    """

    names: tuple[str, ...]
    bound: FloatArray
    alone: FloatArray
    information: FloatArray


def bounds_of(information: FloatArray) -> FloatArray:
    """Square roots of the diagonal of the inverse; infinite in directions without information."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    lost = values < 1e-10
    weight = vectors**2 @ np.where(lost, 0.0, 1.0 / np.maximum(values, 1e-300))
    hopeless = (vectors**2 @ lost.astype(np.float64)) > 1e-6
    return np.asarray(np.where(hopeless, np.inf, np.sqrt(weight) / scale))


def excitation(
    windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray | None = None, noise: NoiseModel | None = None
) -> Excitation:
    """Computes the bounds for `windows` at `theta` (default: the vehicle's initial guess).

    Args:
        windows: data; only inputs and measured states matter.
        vehicle: the vehicle.
        theta: full parameter vector.
        noise: sensor noise; typical MEMS noise by default.
    """
    shooting = Shooting.cut(windows, vehicle, SECONDS, noise)
    free = shooting.free(NOMINAL_NAMES)
    point = shooting.layout.initial(vehicle) if theta is None else theta
    information = shooting.linearise(point, free).information
    diagonal = np.maximum(np.diag(information), 0.0)
    with np.errstate(divide="ignore"):
        alone = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), np.inf)
    return Excitation(free.names, bounds_of(information), alone, information)


# --- Which movements to fly: blocks of a manoeuvre chosen so that the parameters' joint interval shrinks most
#
# D-optimal design: the determinant of the Fisher information is maximised by adding the best block again and again and
# then exchanging blocks while that helps.  Wynn, Ann. Math. Statist. 41 (1970) 1655; Fedorov, *Theory of Optimal
# Experiments* (1972).


def d_optimal(information: FloatArray, known: FloatArray, blocks: int) -> list[int]:
    """Chooses blocks, with repetition, whose summed information has the largest determinant.

    Args:
        information: Fisher information of the scaled parameters that each candidate brings, shape (candidates, P, P).
        known: information there already is, prior included; positive definite, shape (P, P).
        blocks: how many to choose.

    Returns:
        Indices of the chosen candidates, best first.

    Raises:
        ParameterError: nothing to choose from, or no block to choose.
    """
    if len(information) == 0 or blocks < 1:
        raise ParameterError(f"{blocks} blocks out of {len(information)} candidates", "at least one of each")
    chosen: list[int] = []
    total = known.copy()
    for _ in range(blocks):
        best = int(np.argmax(np.linalg.slogdet(total + information)[1]))
        chosen.append(best)
        total = total + information[best]
    for _ in range(10):
        before = list(chosen)
        for place, index in enumerate(chosen):
            rest = total - information[index]
            best = int(np.argmax(np.linalg.slogdet(rest + information)[1]))
            chosen[place], total = best, rest + information[best]
        if chosen == before:
            break
    return chosen


def halfwidths(information: FloatArray) -> FloatArray:
    """Relative 95 % half-width of each log parameter, all others unknown too, shape (P,): exp(1.96 sigma) - 1."""
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    return np.asarray(np.expm1(np.minimum(Z95 * sigma, 50.0)))
