"""Gauss-Newton with Levenberg damping, within bounds, on the scaled parameters; initial states step along exactly."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from quadid.errors import NotIdentifiableError
from quadid.identification.elimination import InitialStates
from quadid.identification.problem import (
    MEASURED,
    Free,
    Linearised,
    Prior,
    Shooting,
    default_prior,
    normal_equations,
    prior_terms,
)
from quadid.types import FloatArray

# --- A small quadratic problem with bounds, by an active set
#
# The library's own solver does the same, but its import takes longer than a short fit.


FLAT = 1e-14
"""Curvature, relative to the largest, below which a direction is flat: no step is made along it."""
_ROUNDING = 1e-11
"""Pull at a bound, relative to the largest of all, that counts as none."""


def least_within(h: FloatArray, g: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Minimises ``2 g z + z h z`` for low <= z <= high.

    Bounded-variable least squares, Stark & Parker, Computational Statistics 10 (1995) 129: parameters rest on bounds or
    are free; the free ones go to their own optimum or to the first bound on the way; one that the optimum would have
    leave its bound is set free.

    Args:
        h: positive semi-definite with a diagonal of about 1, shape (P, P).
        g: shape (P,).
        low: shape (P,), at most 0.
        high: shape (P,), at least 0.
    """
    z = _least(h, g)
    if np.all((z >= low) & (z <= high)):
        return z
    z = np.clip(z, low, high)
    free = (z > low) & (z < high)
    for _ in range(20 * len(g)):
        place = np.flatnonzero(free)
        wanted = _least(h[np.ix_(place, place)], g[place] + h[np.ix_(place, np.flatnonzero(~free))] @ z[~free])
        step = wanted - z[place]
        room = np.where(step > 0.0, high[place] - z[place], z[place] - low[place])
        blocked = np.abs(step) > room
        if blocked.any():
            share = np.min(room[blocked] / np.abs(step[blocked]))
            z[place] = np.clip(z[place] + share * step, low[place], high[place])
            first = blocked & (room <= share * np.abs(step) * (1.0 + 1e-12))
            z[place[first]] = np.where(step[first] > 0.0, high[place[first]], low[place[first]])
            free[place[first]] = False
            continue
        # Rounding would leave some beyond their bounds, where there is less than no room and no step.
        z[place] = np.clip(wanted, low[place], high[place])
        pull = -(h @ z + g)
        outward = np.where(free | (low == high), 0.0, np.where(z <= low, pull, -pull))
        best = int(np.argmax(outward))
        if outward[best] <= _ROUNDING * max(float(np.max(np.abs(g))), 1e-300):
            break
        free[best] = True
    return z


def _least(h: FloatArray, g: FloatArray) -> FloatArray:
    """Shortest step to the optimum without bounds."""
    if not len(g):
        return np.zeros(0)
    values, vectors = np.linalg.eigh(h)
    seen = values > FLAT * max(float(values[-1]), 0.0)
    return np.asarray(-vectors[:, seen] @ ((vectors[:, seen].T @ g) / values[seen]))


# --- The descent


HUBER = 4.0
"""Residuals beyond this many sigma are down-weighted (Huber); Gaussian data lose nothing measurable."""


class Convergence(StrEnum):
    """End of a polish; the values read as sentences."""

    CONVERGED = "the step fell below the statistical resolution"
    BUDGET = "the iteration limit was reached before the step was small"
    STUCK = "no step reduced the cost any further"
    ASTRAY = "the initial states diverged from what a linear step can follow"


LONGEST_STEP = 3.0
"""No scaled parameter moves farther than this in one step."""
_REFUSALS, _SETTLED = 3, 0.01
"""Steps refused in a row after which initial states are looked at alone, and the share of the cost by which their own
step may miss what it promised.  Beyond, they have gone where linearisation, and its cost, is worth nothing."""
_STEADY_WEIGHT = 0.01
"""Robust weights are renewed while any of them changes by more than this."""


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

    @property
    def states(self) -> InitialStates:
        """Initial states of the optimum."""
        return self.lin.states

    @property
    def simulated(self) -> int:
        """Parameter vectors simulated for it: with one, each direction of the parameters and nine of initial states."""
        return self.iterations * (len(self.lin.gradient) + 10)


def robust_weights(shooting: Shooting, lin: Linearised) -> FloatArray:
    """Huber weights of every sample (square roots of the row weights), 0 where nothing was measured, as `Linearised`.

    Shape (segments, length, channels).
    """
    weight = lin.residuals / np.sqrt(shooting.noise.variance)
    np.maximum(np.abs(weight, out=weight), HUBER, out=weight)
    np.sqrt(np.divide(HUBER, weight, out=weight), out=weight)
    weight[lin.weights == 0.0] = 0.0
    return weight


def polish(
    shooting: Shooting,
    theta: FloatArray,
    free: Free,
    prior: Prior | None = None,
    states: InitialStates | None = None,
    iterations: int = 12,
    robust: bool = False,
    tolerance: float = 0.02,
    settled: bool = False,
) -> Polished:
    """Refines `theta` to the local optimum, once more from measured initial states where those at hand went astray.

    Args:
        shooting: the problem.
        theta: start, full vector.
        free: parameters to move.
        prior: weak by default.
        states: initial states to start from; as measured by default.
        iterations: most linearisations to spend.
        robust: down-weight outliers (weights are renewed after accepted steps until they stay).
        tolerance: stop when every step is below this fraction of the parameter's standard deviation.
        settled: the initial states come from a fit, so that the first step may already be the last.

    Raises:
        NotIdentifiableError: the data lead to equations with infinite or missing entries.
    """
    prior = prior or default_prior(shooting, free)
    states = states or MEASURED
    settled = settled and shooting.start_of(theta, free)[0] in states.starts
    first = _descend(shooting, theta, free, prior, states, iterations, robust, tolerance, settled)
    lost = first.outcome is Convergence.ASTRAY
    if states and first.outcome not in (Convergence.ASTRAY, Convergence.CONVERGED):
        # Of an unfinished descent: its states cost more than twice what measured ones would.
        lost = 2.0 * shooting.linearise(first.theta, free).total_cost < first.lin.total_cost
    if not lost:
        return first
    again = _descend(shooting, first.theta, free, prior, MEASURED, iterations, robust, tolerance, False)
    best = min(again, first, key=lambda p: p.cost)
    return replace(best, iterations=first.iterations + again.iterations)


def _descend(
    shooting: Shooting,
    theta: FloatArray,
    free: Free,
    prior: Prior,
    states: InitialStates,
    iterations: int,
    robust: bool,
    tolerance: float,
    settled: bool,
) -> Polished:
    """`polish` from the states as they are; gives up where these have gone astray."""
    lin = shooting.linearise(theta, free, states)
    if robust:
        # Initial states as measured would let every sample of a segment look like an outlier.
        lin = shooting.linearise(theta, free, lin.stepped())
        weights = robust_weights(shooting, lin)
        shooting = shooting.with_robust(weights)
        lin = shooting.linearise(theta, free, lin.states)
    damping, refused, spent, outcome = 0.0, 0, 3 if robust else 1, Convergence.BUDGET
    cost = lin.total_cost + prior_terms(free, prior, theta)[2]
    while spent < iterations:
        # (H + damping diag H) z = -g within bounds, no farther than linearisation can be trusted.
        h, g = normal_equations(lin, free, prior, theta)
        z = bounded_step(free, theta, h + damping * np.diag(np.diag(h)), g)
        z *= min(1.0, LONGEST_STEP / max(float(np.max(np.abs(z), initial=0.0)), 1e-12))
        moved = free.move(theta, z)
        actual = free.step(theta, moved)
        trial = shooting.linearise(moved, free, lin.stepped(actual))
        spent += 1
        trial_cost = trial.total_cost + prior_terms(free, prior, moved)[2]
        # The first step also moves the initial states away from single noisy samples; it may cost a little.
        most = cost * (1.0 + 1e-9 if settled else 1.05) + 1e-9
        # A simulation that runs away leaves slopes beyond the digits of a float: no next step could be worked out.
        finite = np.isfinite(trial.information).all() and np.isfinite(trial.grad).all()
        if not (trial_cost <= most and finite and (np.diag(trial.information) >= 0.0).all()):
            # Refused: more damping, unless initial states, moved alone, miss the cost that they were to reach.
            damping, refused = max(4.0 * damping, 1e-2), refused + 1
            if refused == _REFUSALS:
                reached = shooting.linearise(theta, free, lin.stepped()).total_cost
                if not reached <= (1.0 + _SETTLED) * lin.total_cost:
                    outcome = Convergence.ASTRAY
                    break
            if damping > 1e6:
                outcome = Convergence.STUCK
                break
            continue
        # Accepted; done when the step or its gain is below what the data resolve.
        gain, sigma = cost - trial_cost, 1.0 / np.sqrt(np.diag(h))
        small = bool(np.all(np.abs(actual) <= tolerance * sigma)) or 0.0 <= gain < tolerance**2
        theta, lin, cost, refused = moved, trial, trial_cost, 0
        damping = damping * 0.2 if damping > 1e-4 else 0.0
        if settled and small:
            outcome = Convergence.CONVERGED
            break
        settled = True
        if robust:
            # Weights follow the residuals until they stay; costs under old and new ones cannot be compared.
            renewed = robust_weights(shooting, lin)
            change = renewed - weights
            if np.max(np.abs(change, out=change), initial=0.0) > _STEADY_WEIGHT:
                weights, shooting = renewed, shooting.with_robust(renewed)
                lin = shooting.linearise(theta, free, lin.states)
                spent, cost = spent + 1, lin.total_cost + prior_terms(free, prior, theta)[2]
    return Polished(theta, lin, cost, spent, outcome)


def bounded_step(free: Free, theta: FloatArray, h: FloatArray, g: FloatArray) -> FloatArray:
    """Minimises ``2 g z + z h z`` over steps that keep every parameter within its bounds.

    Args:
        free: parameters to move, with their bounds.
        theta: where the step starts, full vector.
        h: positive semi-definite, shape (P, P).
        g: shape (P,).

    Raises:
        NotIdentifiableError: the data lead to equations with infinite or missing entries.
    """
    if not (np.isfinite(h).all() and np.isfinite(g).all()):
        raise NotIdentifiableError(
            "the linearised simulation is not finite, so no step towards a fit exists",
            "a flight that the vehicle file can simulate for a second at a time",
            "check mass, rotor positions and the unit of the rotor signal; `quadid inspect` looks for wrong units",
        )
    if not len(g):
        return np.zeros(0)
    low, high = (free.difference(bound, theta[free.index]) for bound in free.bounds)
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    # Parameters are scaled first, so that only a true lack of information makes a direction vanish.
    scale = np.sqrt(np.where(np.diag(h) > 0.0, np.diag(h), 1.0))
    z = least_within(h / np.outer(scale, scale), g / scale, low * scale, high * scale)
    return np.clip(z / scale, low, high)
