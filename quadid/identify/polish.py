"""Gauss-Newton with Levenberg damping on the scaled parameters; initial states are stepped along exactly."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from quadid.identify.shooting import Free, Linearised, Shooting

FloatArray = NDArray[np.float64]

PRIOR_SIGMA_LINEAR = 10.0
"""Weak prior of an effect parameter: this many typical sizes."""
HUBER = 4.0
"""Residuals beyond this many sigma are down-weighted (Huber); Gaussian data lose nothing measurable."""


class Convergence(StrEnum):
    """How a polish ended; the values read as sentences."""

    CONVERGED = "the step fell below the statistical resolution"
    BUDGET = "the iteration limit was reached before the step was small"
    STUCK = "no step reduced the cost any further"


LONGEST_STEP = 3.0
"""No scaled parameter moves farther than this in one step."""


@dataclass(frozen=True)
class Prior:
    """Gaussian prior on the scaled parameters: ``mean`` of the parameter, ``sigma`` in scaled units."""

    mean: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Polished:
    """Result of a polish.

    Attributes:
        theta: full parameter vector.
        lin: linearisation at `theta`.
        cost: total cost with prior; iterations: linearisations spent.
        outcome: how it ended.
    """

    theta: FloatArray
    lin: Linearised
    cost: float
    iterations: int
    outcome: Convergence


def default_prior(shooting: Shooting, free: Free) -> Prior:
    """Prior of each free parameter: the vehicle file's sigma, else half of its bounds on the log scale."""
    mean, sigma = [], []
    for e in free.entries:
        if e.name in shooting.vehicle.parameters:
            p = shooting.vehicle.parameters[e.name]
            low, high = p.limits
            mean.append(p.initial)
            sigma.append(p.sigma / p.initial if p.sigma else 0.5 * np.log(high / low))
        else:
            mean.append(e.neutral)
            sigma.append(PRIOR_SIGMA_LINEAR)
    return Prior(np.array(mean), np.array(sigma))


def prior_terms(free: Free, prior: Prior, theta: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Precision (P,), gradient (P,) and cost of the prior at `theta`, in scaled parameters."""
    value = theta[free.index]
    z = np.where(
        free.is_log,
        np.log(np.maximum(value, 1e-300) / np.maximum(prior.mean, 1e-300)),
        (value - prior.mean) / free.scale,
    )
    precision = 1.0 / prior.sigma**2
    return precision, precision * z, float(np.sum(precision * z * z))


def robust_weights(shooting: Shooting, lin: Linearised) -> list[FloatArray]:
    """Huber weights of every sample (square roots of the row weights), per window."""
    white = np.abs(lin.residuals) / np.sqrt(shooting.noise.variance)
    weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(white, HUBER)))
    out, place = [], 0
    for segments in shooting.segments:
        out.append(weight[place : place + len(segments.starts)])
        place += len(segments.starts)
    return out


def polish(
    shooting: Shooting, theta: FloatArray, free: Free, prior: Prior | None = None, iterations: int = 12,
    robust: bool = False, tolerance: float = 0.02,
) -> Polished:  # fmt: skip
    """Refines `theta` to the local optimum.

    Args:
        shooting: the problem; its initial states are advanced.
        theta: start, full vector.
        free: parameters to move.
        prior: weak by default.
        iterations: most linearisations to spend.
        robust: down-weight outliers (weights are renewed at each accepted step).
        tolerance: stop when every step is below this fraction of the parameter's standard deviation.
    """
    prior = prior or default_prior(shooting, free)
    lin = shooting.linearise(theta, free)
    if robust:
        shooting.robust = list(robust_weights(shooting, lin))
        lin = shooting.linearise(theta, free)
    damping, spent, outcome, settled = 0.0, 1, Convergence.BUDGET, False
    cost = float(lin.cost.sum()) + prior_terms(free, prior, theta)[2]
    while spent < iterations:
        precision, pull, _ = prior_terms(free, prior, theta)
        h = lin.gram.sum(axis=0) + np.diag(precision)
        g = lin.grad.sum(axis=0) + pull
        z = bounded_step(free, theta, h + damping * np.diag(np.diag(h)), g)
        z *= min(1.0, LONGEST_STEP / max(float(np.max(np.abs(z), initial=0.0)), 1e-12))
        moved = free.move(theta, z)
        actual = scaled_difference(free, theta, moved)
        kept = shooting.snapshot()
        shooting.adopt(moved, free, shooting.step_states(theta, free, lin, actual))
        trial = shooting.linearise(moved, free)
        spent += 1
        trial_cost = float(trial.cost.sum()) + prior_terms(free, prior, moved)[2]
        # The first step also moves the initial states away from single noisy samples; it may cost a little.
        if not trial_cost <= cost * (1.0 + 1e-9 if settled else 1.05) + 1e-9:
            shooting.restore(kept)
            damping = max(4.0 * damping, 1e-2)
            if damping > 1e6:
                outcome = Convergence.STUCK
                break
            continue
        gain, sigma = cost - trial_cost, 1.0 / np.sqrt(np.diag(h))
        small = bool(np.all(np.abs(actual) <= tolerance * sigma)) or 0.0 <= gain < tolerance**2
        theta, lin, cost, damping = moved, trial, trial_cost, (damping * 0.2 if damping > 1e-4 else 0.0)
        if settled and small:
            outcome = Convergence.CONVERGED
            break
        settled = True
        if robust:
            shooting.robust = list(robust_weights(shooting, lin))
    return Polished(theta, lin, cost, spent, outcome)


def bounded_step(free: Free, theta: FloatArray, h: FloatArray, g: FloatArray) -> FloatArray:
    """Minimises ``2 g z + z h z`` over steps that keep every parameter within its bounds (active set).

    Parameters whose step would leave the bounds are fixed there and the others solved again.
    """
    low, high = np.empty(len(g)), np.empty(len(g))
    for j, e in enumerate(free.entries):
        value = theta[e.index]
        if free.is_log[j]:
            low[j], high[j] = np.log(e.lower / value), np.log(e.upper / value)
        else:
            low[j], high[j] = (e.lower - value) / e.typical, (e.upper - value) / e.typical
    fixed = np.zeros(len(g), dtype=bool)
    z = np.zeros(len(g))
    for _ in range(len(g) + 1):
        loose = ~fixed
        if not loose.any():
            break
        rhs = g[loose] + h[np.ix_(loose, fixed)] @ z[fixed]
        z[loose] = -np.linalg.solve(h[np.ix_(loose, loose)], rhs)
        out = loose & ((z < low - 1e-12) | (z > high + 1e-12))
        if not out.any():
            break
        z[out] = np.clip(z[out], low[out], high[out])
        fixed |= out
    return np.clip(z, low, high)


def scaled_difference(free: Free, theta: FloatArray, moved: FloatArray) -> FloatArray:
    """The scaled step that leads from `theta` to `moved`, shape (P,)."""
    old, new = theta[free.index], moved[free.index]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(free.is_log, np.log(new / old), (new - old) / free.scale)
