"""Consistency of estimates across parts of the data and models.

Blocks of time, short segments beside long ones, every second row, and models with each cause added that the residual
asks for, all estimate the same parameters.  What they differ by beyond chance belongs to the model, not to the noise:
intervals are widened by it, between blocks as random effects (DerSimonian and Laird, Controlled Clinical Trials 7
(1986) 177), and beyond `SPREAD_LIMIT` the number is not to be used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadid.chi_square import exceeded
from quadid.data.window import Window
from quadid.identification.gauss_newton import Polished, bounded_step, polish
from quadid.identification.initial_states import InitialStates
from quadid.identification.noise_fit import flexible_names
from quadid.identification.problem import Free, Prior, Shooting, default_prior, normal_equations, posterior_covariance
from quadid.identification.uncertainty import SPREAD_LIMIT, Uncertainty, uncertainty
from quadid.types import FloatArray

# --- The same flight on a grid twice as coarse: how much a parameter depends on what the inputs do within a row
#
# A log holds one value of each input a row; what it does within the row is not known.  What that changes grows with the
# square of the row's length: feedback that runs on within held commands, behind a lag or a delay, looks like another
# inertia by that much, and so does a straight line between readings that turn.  Every second row of the same data
# therefore shows three times what the rows at hand may be off by (Richardson, Phil. Trans. R. Soc. A 210 (1911) 307).


SHARE = 1.0 / 3.0
"""Of the difference between two grids, of which one is twice as coarse, that the finer one is off by."""


def on_coarse_grid(problem: Shooting, found: Polished, free: Free, prior: Prior) -> Polished | None:
    """The fit to every second row, from the optimum of all; None where no segment fits.

    Args:
        problem: of the fit to all rows.
        found: its optimum.
        free: its parameters.
        prior: of those.
    """
    windows = [coarse(rollout.window) for rollout in problem.rollouts]
    noise = replace(problem.noise, shape=None)
    cut = Shooting.cut(windows, problem.vehicle, problem.seconds, noise, problem.layout).leaving_out(problem.left_out)
    if not cut.count or cut.channels != problem.channels:
        return None
    return polish(cut, found.theta, free, prior, iterations=4)


def coarse(window: Window) -> Window:
    """Every second row of `window`; forces and held speeds are means over the longer rows."""
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
FEWEST_SEGMENTS = 10
"""Segments that make a block."""
CHANCE = 0.01
"""Probability with which a difference of right estimates is taken for one of the model."""
MISFIT = 1.1
"""Cost per row above which the model misses something: then its own interval counts as a difference too."""
MISSED = 10.0
"""Cost per row, with the best cause added, beyond which no cause can be trusted to show what the numbers are worth."""
LEAST_GAIN = 15.0
"""Fall of the cost, in units of the cost per row, that a cause must promise: one in ten thousand by chance."""
NEAR_BEST = 0.15
"""Share of what the best cause promises below which another is no rival to it."""
MOST_CAUSES = 4
"""Causes that are fitted: the one that promises most, and those that would move the parameters most."""
MOST_SEGMENTS = 150
"""Segments that causes are fitted to: differences of that size need no more."""
WIDE = 0.7
"""Standard deviation of a prior (scaled parameters) that leaves the data to themselves."""


@dataclass(frozen=True)
class Reliability:
    """Differences of estimates of the parameters, beyond chance.

    Attributes:
        spread: standard deviation between estimates, scaled parameters, shape (P,).
        widening: of the estimate itself, shape (P,): of many blocks their mean is known better than each.
        steps: from the fit to other estimates, shape (estimates, P); names: what was different.
        misfit: the model misses something.
        missed: it misses the flight by so much that no number is to be used.
    """

    spread: FloatArray
    widening: FloatArray
    steps: FloatArray
    names: tuple[str, ...]
    misfit: bool
    missed: bool

    def widened(self, unc: Uncertainty) -> Uncertainty:
        """Intervals that hold what the estimates differ by."""
        return unc.widened(self.widening, self._counted(unc))

    def _counted(self, unc: Uncertainty) -> FloatArray:
        """Spread that has to stay below `SPREAD_LIMIT`, shape (P,)."""
        return np.full(len(self.spread), np.inf) if self.missed else np.hypot(self.spread, self.misfit * unc.sigma)

    def reasons(self, free: Free, unc: Uncertainty) -> tuple[str, ...]:
        """Sentences on the nominal parameters whose estimates differ too much, with `unc` as it is without that."""
        if self.missed:
            return ("the model misses this flight by so much that its numbers are not to be used",)
        why: dict[str, list[str]] = {}
        for j in np.flatnonzero((self._counted(unc) > SPREAD_LIMIT) & free.is_log):
            k = int(np.argmax(np.abs(self.steps[:, j]))) if len(self.steps) else -1
            close = k < 0 or abs(self.steps[k, j]) < self.spread[j]
            how = f"changes by more than {SPREAD_LIMIT:.0%} {'between parts of the flight' if close else self.names[k]}"
            if self.spread[j] <= SPREAD_LIMIT:
                how = f"is uncertain by more than {SPREAD_LIMIT:.0%}, and the model misses something"
            why.setdefault(how, []).append(free.names[j])
        return tuple(f"{', '.join(n)}: {how}" for how, n in why.items())


def reliability(problem: Shooting, found: Polished, free: Free, prior: Prior, short: Polished) -> Reliability:
    """Compares estimates of the parameters.

    Args:
        problem: the problem of the final fit.
        found: its optimum.
        free: its parameters.
        prior: of those.
        short: the fit to short segments, which see faster motion only.
    """
    if problem.vehicle.mass_sigma > 0.0 or problem.vehicle.arm_sigma > 0.0:
        # Sharp priors pull against a wrong mass or arm; that is settled by `with_scale_uncertainty`, and no misfit.
        prior = Prior(prior.mean, np.maximum(prior.sigma, WIDE))
        found = polish(problem, found.theta, free, prior, found.states, settled=True)
    # Parts of the flight: steps of blocks of time from the optimum of all.
    own = uncertainty(found.lin, prior)
    between, mean = _between_blocks(found, prior, own)
    left = found.lin.reduced_chi_square
    misfit = left > MISFIT
    # The same data in short segments, on a coarser grid, and in models with causes that the residual asks for.
    steps, names = [_beyond_chance(found, free, own, short, prior)], ["when shorter pieces of the flight are fitted"]
    if (rows := on_coarse_grid(problem, found, free, prior)) is not None:
        steps.append(SHARE * _beyond_chance(found, free, own, rows, prior))
        names.append("when the flight is fitted on a finer grid")
    for name, step, remains in _with_causes(problem, found, free, prior):
        steps.append(step)
        names.append(f"when {name} is in the model")
        left = min(left, remains)
    farthest = np.max(np.abs(steps), axis=0)
    return Reliability(
        np.maximum(between, farthest), np.hypot(mean, farthest), np.array(steps), tuple(names), misfit, left > MISSED
    )


def _between_blocks(found: Polished, prior: Prior, own: Uncertainty) -> tuple[FloatArray, FloatArray]:
    """Standard deviation between blocks of time, and what it adds to that of their mean, shapes (P,)."""
    lin, p = found.lin, len(prior.mean)
    count = min(BLOCKS, len(lin.cost) // FEWEST_SEGMENTS)
    if count < 3:
        return np.zeros(p), np.zeros(p)
    steps, variances = np.empty((count, p)), np.empty((count, p))
    thin = Prior(prior.mean, np.sqrt(count) * prior.sigma)
    # Each block's own step, and its variance.
    for k, part in enumerate(np.array_split(np.arange(len(lin.cost)), count)):
        covariance = posterior_covariance(lin.gram[part].sum(axis=0), thin)
        steps[k] = -covariance @ (lin.grad[part].sum(axis=0) - lin.gradient / count)
        variances[k] = np.diag(covariance) * own.inflation**2
    return random_effects(steps, variances)


def random_effects(steps: FloatArray, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Standard deviation between blocks beyond chance, and what it adds to that of their mean, shapes (P,).

    Args:
        steps: estimate of each block, shape (blocks, P).
        variances: of these, shape (blocks, P).
    """
    # Variance between blocks from the excess of Q over its degrees of freedom.
    count, weight = len(steps), 1.0 / variances
    total = weight.sum(axis=0)
    q = np.sum(weight * (steps - np.sum(weight * steps, axis=0) / total) ** 2, axis=0)
    excess = np.maximum(q - (count - 1), 0.0) / (total - np.sum(weight**2, axis=0) / total)
    tau = np.where(q > exceeded(CHANCE, count - 1), np.sqrt(excess), 0.0)
    mean = 1.0 / np.sum(1.0 / (variances + tau**2), axis=0) - 1.0 / total
    return tau, np.sqrt(np.maximum(mean, 0.0))


def _beyond_chance(found: Polished, free: Free, own: Uncertainty, other: Polished, prior: Prior) -> FloatArray:
    """Scaled step to another estimate of the same data, zero where chance explains it, shape (P,)."""
    if not np.isfinite(other.cost):
        return np.zeros(len(free.entries))
    step = free.difference(other.theta[free.index], found.theta[free.index])
    chance = exceeded(CHANCE, 1) * (uncertainty(other.lin, prior).sigma ** 2 + own.sigma**2)
    return np.where(step**2 > chance, step, 0.0)


def _with_causes(
    problem: Shooting, found: Polished, free: Free, prior: Prior
) -> Iterator[tuple[str, FloatArray, float]]:
    """Name, scaled step of the parameters, and cost per row of the model with each cause that the residual asks for."""
    places = problem.places(MOST_SEGMENTS)
    few = problem.taking(places)
    states = found.states.taking(places)
    asked = _asked_for(few, found.theta, states, free) if np.isfinite(found.cost) else []
    base = polish(few, found.theta, free, prior, states, iterations=4, settled=True) if asked else found
    cost = base.lin.total_cost
    for name, names in asked:
        extended = few.free([*free.names, *names])
        wide = default_prior(few, extended)
        wide = Prior(wide.mean, np.concatenate([prior.sigma, wide.sigma[len(prior.sigma) :]]))
        trial = polish(few, base.theta, extended, wide, base.states, iterations=8)
        after = trial.lin.total_cost
        if cost - after > LEAST_GAIN * cost / base.lin.total_rows:
            yield name, free.step(base.theta, trial.theta), after / trial.lin.total_rows


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


def _asked_for(few: Shooting, theta: FloatArray, states: InitialStates, free: Free) -> list[tuple[str, list[str]]]:
    """Causes by a linearisation of the whole catalogue: the one that promises most, and those that move most."""
    everything = few.free(list(dict.fromkeys([*free.names, *flexible_names(few.layout, few)])))
    lin = few.linearise(theta, everything, few.linearise(theta, everything, states).stepped())
    h, g = normal_equations(lin, everything, default_prior(few, everything), theta)

    def best(place: list[int]) -> tuple[FloatArray, float]:
        """Step within bounds with these entries free, and how much of the cost it takes away."""
        at = np.ix_(place, place)
        z = bounded_step(Free(tuple(everything.entries[i] for i in place)), theta, h[at], g[place])
        return z, -float(2.0 * g[place] @ z + z @ h[at] @ z)

    # Entries of a cause are freed together; rotors are causes by themselves.
    own = list(range(len(free.entries)))
    causes: dict[str, list[int]] = {}
    for i, name in enumerate(everything.names[len(own) :], len(own)):
        causes.setdefault(name if "loss" in name else name.split(".")[0], []).append(i)
    least = LEAST_GAIN * max(lin.reduced_chi_square, 1.0)
    promises = [
        (gain, float(np.max(np.abs(step))), name) for name, gain, step in promised(best, own, causes) if gain > least
    ]
    promises.sort(key=lambda p: -p[0])
    rest = sorted((p for p in promises[1:] if p[0] > NEAR_BEST * promises[0][0]), key=lambda p: -p[1])
    chosen = [name for *_, name in (*promises[:1], *rest[: MOST_CAUSES - 1])]
    return [(name, [everything.names[i] for i in causes[name]]) for name in chosen]
