"""Filter-error estimation: Fisher scoring with frozen gains, noise numbers by the full filter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from quadid.estimate import kalman as k
from quadid.estimate.kalman import Gains, Track
from quadid.estimate.problem import Problem, measured, simulated
from quadid.types import BoolArray, FloatArray

BOLD = 1.5
"""Longest step of a logarithm: less than a factor of five."""
FIRST_SECONDS, NEAR_SECONDS = 20.0, 60.0
"""Of all flights together, what the first steps look at, and what stands for all of it where that is enough [s]."""
NEAR, MOST = 4, 40
"""Steps with random forces held large, and most steps after that."""
ENOUGH, FINE = 0.5, 0.1
"""Gain in -2 ln L that no step of the noise is worth taking for, and none of the physics."""
ALL_NOISE, NO_NOISE = np.ones(k.N_NOISE, dtype=np.bool_), np.zeros(k.N_NOISE, dtype=np.bool_)
"""Noise numbers that a step may change."""
FORCES = slice(k.SIGMA, k.SIGMA + 4)
"""Places of the sizes of random forces and moments among the noise numbers."""
ROUNDS = 4
"""Most times that effects are simulated anew, and that the noise of rotor speeds is taken out anew."""
CHANCE = 4.0
"""Standard errors of the kurtosis beyond which innovations have outliers."""
PATIENCE = 4
"""Times a step is shortened before the search ends."""
POOR = 0.25
"""Share of the gain that a step promises below which the next one is shorter."""
ACTS = 3.0
"""Times its least value beyond which a random force acts."""
FLAT = 1e-12
"""Curvature of scaled numbers below which a direction is as good as flat."""
PROMISE = 2.0
"""Times what the last `NEAR` steps gained that a search may gain by all that follow."""
STALE = 0.2
"""Change of a noise number's logarithm after which the information is taken anew."""


@dataclass(frozen=True)
class Estimate:
    """Maximum of the likelihood.

    Attributes:
        problem: what was estimated.
        z: scaled parameters, shape (P,).
        psi: noise numbers, shape (N_NOISE,).
        covariance: of the scaled parameters, (P, P).
        objective: -2 ln of likelihood and prior.
        whitened: innovations over their standard deviations, a (n, M) array a flight; 0 where not measured.
    """

    problem: Problem
    z: FloatArray
    psi: FloatArray
    covariance: FloatArray
    objective: float
    whitened: tuple[FloatArray, ...]

    @property
    def finite(self) -> bool:
        """Success of the search: it ended at numbers, of which there are none where the filter ran away."""
        return all(np.isfinite(a).all() for a in (self.objective, self.z, self.covariance))

    def value(self, name: str, flight: int = -1) -> tuple[float, float]:
        """Value of a parameter and its standard deviation: relative for the nominal six, else in its unit."""
        for i, (entry, place, where) in enumerate(self.problem.entries):
            if entry == name and where in (-1, flight):
                sigma = float(np.sqrt(self.covariance[i, i]))
                if place < k.TRIM:
                    return float(np.exp(self.z[i])), sigma
                neutral = self.problem.layout.entry(name).neutral if place >= k.N_PHYSICS else 0.0
                return neutral + float(self.z[i] * self.problem.size[i]), sigma * float(self.problem.size[i])
        raise KeyError(name)


def estimate(problem: Problem, start: FloatArray | None = None, noise: FloatArray | None = None) -> Estimate:
    """Parameters, noise and random forces of the flights of a problem.

    Args:
        problem: the flights and what is free.
        start: scaled parameters where to begin; default the guess.
        noise: noise numbers of an estimate nearby, at whose peak of the likelihood to stay; default: search for one.
    """
    z = problem.start() if start is None else start
    if noise is None:
        # 1. Steps with random forces held large, so that no flight diverges from a bad guess.
        part = problem.liveliest(FIRST_SECONDS)
        psi = part.first_noise()
        z = scoring(part.along(z, psi).frozen(z), z, psi, NEAR, NO_NOISE)[0]
        whole, z = problem.based_on(z)
        # 2. Let them shrink: noise and physics together, until the likelihood stays; near it, over all flights.
        part = whole.liveliest(FIRST_SECONDS)
        near = part.along(z, psi).frozen(z)
        z, psi, _ = settle_noise(near, z, psi)
        problem = whole.along(z, psi).frozen(z)
        if part is whole and not problem.objective(z, psi) <= near.objective(z, psi):  # effects that run away
            problem = near
    else:
        whole, z = problem.based_on(z)
        psi = np.asarray(np.clip(noise, *whole.noise_bounds.T))
        problem = whole.along(z, psi).frozen(z)
    z, psi, value, gains, information = scoring(problem, z, psi, MOST, ALL_NOISE)

    def moved(new: Problem) -> bool:
        """Moves to the maximum of another problem; stays where it has none."""
        nonlocal problem, z, psi, value, gains, information
        gains.clear()  # of a long flight, each list of them is a third of all memory
        tried = scoring(new, z, psi, MOST, ALL_NOISE)
        if there := bool(np.isfinite(tried[2]) and np.isfinite(tried[4]).all()):
            problem, (z, psi, value, gains, information) = new.weighted(tried[3]), tried
        else:
            gains = problem.passes(z, psi)[1]
        return there

    # 3. Effects are simulated along states: take those where the search ended, until both stay.
    for _ in range(0 if problem is whole else ROUNDS):
        before = z
        if not moved(whole.along(z, psi, gains).frozen(z)) or (z - before) @ information @ (z - before) < FINE:
            break
    # 4. Where innovations have outliers, their density has tails.
    tail = tails(problem.tracks, gains)
    if np.any(tail > 0.0):
        moved(replace(problem, tail=tail))
    # 5. Noise of logged rotor speeds makes inertias too large by as much as it explains.
    for _ in range(ROUNDS):
        tilted = problem.unbiased(z, psi, gains)
        slope = tilted.taken[0]
        step = np.linalg.solve(information, slope)
        if np.max(np.abs(step), initial=0.0) > BOLD:  # rotors hardly move: that noise is all there is
            break
        if slope @ step < FINE:
            problem = tilted
            break
        before = z
        if not moved(tilted) or (z - before) @ information @ (z - before) < FINE:
            break
    taken, noise = problem.taken
    # 6. A loop faster than the log answers a random moment within a step: by nothing to all of what it may.
    within = problem.within_a_step(z, gains)
    inverse = np.linalg.inv(information)
    z = np.clip(z + 0.5 * inverse @ within.sum(axis=0), *problem.limits)
    # 7. Intervals: score over slope, and how well the noise of rotor speeds and that answer are known.
    by_square = taken * of_square(problem, z, psi, gains)
    score = information + noise + within.T @ within / 12.0 + np.outer(by_square, by_square)
    covariance = inverse @ score @ inverse
    return Estimate(problem, z, psi, np.asarray(covariance), value, whitened(problem.tracks, gains))


def settle_noise(problem: Problem, z: FloatArray, psi: FloatArray) -> tuple[FloatArray, FloatArray, list[Gains]]:
    """Scaled parameters, noise numbers and gains of the largest likelihood, with exact rotor speeds and noisy ones.

    Noise of rotor speeds may stand for that of a gyro, which is then none: the likelihood has a peak at either.
    """
    exact = psi.copy()
    exact[k.ROTOR] = problem.noise_bounds[k.ROTOR, 0]
    others, sizes = np.arange(k.N_NOISE) != k.ROTOR, np.arange(k.N_NOISE) < k.TIME
    # Noise of about the right size before physics moves, or a long lag takes it for what it makes of the rotors.
    rough = scoring(problem, z, exact, NEAR, others & sizes, physics=False)[1]
    first = scoring(problem, z, rough, MOST, others)
    # Large random forces have peaks of their own, of long and of short times: search from where they come to rest, too.
    if np.any(first[1][FORCES] > problem.noise_scale[:4]):
        settled = scoring(problem, z, rough, MOST, others & sizes, physics=False)[1]
        first = min((first, scoring(problem, z, settled, MOST, others)), key=lambda found: found[2])
    noisy = first[1].copy()
    noisy[k.ROTOR] = psi[k.ROTOR]
    noisy = scoring(problem, first[0], noisy, NEAR, sizes, physics=False)[1]
    if noisy[k.ROTOR] > ACTS * exact[k.ROTOR]:
        first = min((first, scoring(problem, first[0], noisy, MOST, ALL_NOISE)), key=lambda found: found[2])
    z, psi, _, gains, _ = first
    return z, psi, gains


def of_square(problem: Problem, z: FloatArray, psi: FloatArray, gains: Sequence[Gains]) -> float:
    """Relative standard deviation of the variance of rotor speeds: none at its floor, no more than its bounds leave."""
    low, high = problem.noise_bounds[k.ROTOR]
    if psi[k.ROTOR] <= 1.01 * low:
        return 0.0
    data = problem.noise_information(z, psi, gains)
    known = np.linalg.inv(data + 0.5 * np.diag(problem.noise_curvature(psi)))
    return float(min(2.0 * np.sqrt(known[k.ROTOR, k.ROTOR]), (high / psi[k.ROTOR]) ** 2 / np.sqrt(12.0)))


def whitened(tracks: Sequence[Track], gains: Sequence[Gains]) -> tuple[FloatArray, ...]:
    """Innovations of a pass over their standard deviations, shape (n, M) for each flight; 0 where not measured."""
    masked = ((measured(track, g), g) for track, g in zip(tracks, gains, strict=True))
    return tuple(np.where(seen, g.nu / np.sqrt(np.where(seen, g.S, 1.0)), 0.0) for seen, g in masked)


def tails(tracks: Sequence[Track], gains: Sequence[Gains]) -> FloatArray:
    """1 / degrees of freedom of the Student-t density of each group of innovations, shape (4,), by their kurtosis.

    A Student-t density has kurtosis 3 + 6 / (k - 4); what chance alone makes of a Gaussian's counts as none.
    """
    out, plain = np.zeros(4), whitened(tracks, gains)
    for group in range(4):
        z = np.concatenate([w[:, 3 * group : 3 * group + 3] for w in plain])
        z = z[z[:, 0] != 0.0]
        if len(z):
            excess = float(np.mean(np.mean(z**4, axis=0) / np.mean(z**2, axis=0) ** 2)) - 3.0
            if excess > CHANCE * np.sqrt(24.0 / z.size):
                out[group] = 1.0 / (4.0 + 6.0 / excess)
    return out


def scoring(
    problem: Problem,
    z: FloatArray,
    psi: FloatArray,
    turns: int,
    noise: BoolArray,
    physics: bool = True,
    wanted: float = np.inf,
) -> tuple[FloatArray, FloatArray, float, list[Gains], FloatArray]:
    """Fisher scoring of physics and noise, whose information has no common part.

    Physics by sensitivities of the innovations under the gains of this turn; the noise numbers' logarithms, those that
    `noise` (N_NOISE,) frees, by the exact score of the full filter.  Gains are renewed after every step.  One that does
    not help is damped (Levenberg-Marquardt), the noise alone where physics alone helps: where it hardly acts, its
    expected curvature is no guide.  Without `physics` the noise alone moves.  Weights of outliers are renewed before
    every step, and held in it; the gains have them.  The objective is infinite where the search was given up, since it
    would hardly come down to what is `wanted`.

    Returns:
        Scaled parameters, noise numbers, objective, gains there; information (P, P) before the last step.
    """
    value, gains = problem.passes(z, psi)
    information, gradient = np.eye(len(z)), np.zeros(len(z))
    curvature, slope, at = np.eye(len(psi)), np.zeros(len(psi)), np.full(len(psi), np.inf)
    last, sloped = np.log(psi), slope
    damping = calm = 0.0
    below = above = np.zeros(len(z))
    renewed: list[Gains] = []
    before = np.inf
    for turn in range(turns if np.isfinite(value) else 0):
        if turn % NEAR == NEAR - 1:
            if value - wanted > PROMISE * (before - value):
                return z, psi, np.inf, gains, information
            before = value
        fallen = 0.0
        if problem.tail.any():
            held, quieter = problem.reweighted(z, psi, gains, noise)
            anew, renewed = held.passes(z, quieter, simulated(gains))
            if not np.isfinite(anew):
                break
            fallen = value - anew
            problem, psi, value, gains, renewed = held, quieter, anew, renewed, []
        if physics:
            below, above, nudge = problem.corner(z, psi, gains)
            information, gradient = problem.normal_equations(z, psi, gains, nudge)
            below, above = np.maximum(below, -BOLD), np.minimum(above, BOLD)
        log = np.log(psi)
        fresh = not noise.any() or np.max(np.abs(log - at)) > STALE
        if noise.any():
            slope = problem.score(z, psi, gains) * psi
            if fresh:
                data = problem.noise_information(z, psi, gains)
                curvature, at = 2.0 * data + np.diag(problem.noise_curvature(psi)), log
            else:
                curvature = secant(curvature, log - last, slope - sloped)
            last, sloped = log, slope
        if not (np.isfinite(information).all() and np.isfinite(curvature).all()):
            break  # readings so wild that they overflow lead nowhere
        for _ in range(PATIENCE):
            step = newton_step(information, gradient, damping, below, above)
            bold = newton_step(curvature, slope, calm, *noise_box(problem, psi, noise))
            by_physics, by_noise = -float(gradient @ step), -0.5 * float(slope @ bold)
            done = by_physics < FINE and max(by_noise, fallen) < ENOUGH
            moved, changed = z + step, changed_noise(psi, bold, problem.noise_bounds)
            renewed.clear()  # what did not help makes room
            better, renewed = problem.passes(moved, changed)
            if better < value or done:
                break
            if by_physics > FINE and noise.any():
                there = simulated(renewed)
                renewed.clear()
                better, renewed = problem.passes(moved, psi, there)
            if better < value:
                changed, by_noise, calm = psi, 0.0, more(calm)
                break
            damping, calm = more(damping), more(calm)
        if not better < value and fresh:
            break
        if not better < value or changed is psi:
            at = np.full(len(psi), np.inf)  # a curvature by secants that led nowhere is taken anew
        if not better < value:
            damping = calm = 0.0
            continue
        if value - better > POOR * (by_physics + by_noise):
            damping, calm = less(damping), calm if changed is psi else less(calm)
        else:
            damping, calm = more(damping), calm if changed is psi else more(calm)
        z, psi, value, gains, renewed = moved, changed, better, renewed, []
        if done and fresh:
            break
        at = np.full(len(psi), np.inf) if done else at  # what promises no more has to be looked at
    return z, psi, value, gains, information


def secant(curvature: FloatArray, step: FloatArray, change: FloatArray) -> FloatArray:
    """Curvature after the slope changed along a step: damped BFGS (J. Nocedal and S. J. Wright, procedure 18.2)."""
    expected = curvature @ step
    along, seen = float(step @ expected), float(step @ change)
    if not along > 0.0:
        return curvature
    share = 1.0 if seen > 0.2 * along else 0.8 * along / (along - seen)
    mixed = share * change + (1.0 - share) * expected
    return curvature - np.outer(expected, expected) / along + np.outer(mixed, mixed) / float(step @ mixed)


def more(damping: float) -> float:
    """Damping after a step that was too long."""
    return max(4.0 * damping, 0.1)


def less(damping: float) -> float:
    """Damping after a good step."""
    return 0.25 * damping if damping > 0.02 else 0.0


def noise_box(problem: Problem, psi: FloatArray, free: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Least and most step of the noise numbers, as `changed_noise` takes it: down to the bound, up by a factor.

    What hardly acts may rise to where a search begins: by factors it would take a dozen steps.
    """
    bounds, leap = problem.noise_bounds, problem.first_noise() / psi
    low, high = bounds[:, 0] / psi, np.minimum(bounds[:, 1] / psi, np.maximum(np.exp(BOLD), leap))
    low[k.TIME :] = np.maximum(low[k.TIME :], np.exp(-BOLD))
    box = np.array([low, high])
    box = np.where(np.arange(k.N_NOISE) < k.TIME, 0.5 * (box**2 - 1.0), np.log(box))
    # What does not act has no correlation time.
    acts = psi[k.SIGMA : k.ROTOR] > ACTS * bounds[k.SIGMA : k.ROTOR, 0]
    free = free.copy()
    free[k.TIME :] &= np.append(acts[:4], acts[4:].any())
    least, most = np.where(free, box, 0.0)
    return least, most


def changed_noise(psi: FloatArray, step: FloatArray, bounds: FloatArray) -> FloatArray:
    """Noise numbers after a step of logarithms, as one of variances, where the likelihood is nearly a parabola.

    For random forces that is the variance of what drives them, sigma^2 / T, which data show best.
    """
    longer = np.zeros(k.TIME)
    longer[k.SIGMA : k.ROTOR] = step[k.TIME + np.minimum(np.arange(6), 4)]
    variance = np.maximum(1.0 + 2.0 * step[: k.TIME] - longer, 0.0) * np.exp(longer)
    by = np.concatenate([np.sqrt(variance), np.exp(step[k.TIME :])])
    return np.asarray(np.clip(psi * by, *bounds.T))


def best_step(
    h: FloatArray, g: FloatArray, box: tuple[FloatArray, FloatArray], free: list[int]
) -> tuple[FloatArray, float]:
    """Step of the entries `free` within a box to the minimum of 2 g z + z h z, and how far that falls."""
    at = np.ix_(free, free)
    step = newton_step(h[at], g[free], 0.0, box[0][free], box[1][free])
    return step, -float(2.0 * g[free] @ step + step @ h[at] @ step)


def newton_step(
    curvature: FloatArray, slope: FloatArray, damping: float, least: FloatArray, most: FloatArray
) -> FloatArray:
    """Levenberg-Marquardt step: the minimum within a box around zero of a parabola with these derivatives."""
    step, free = np.zeros(len(slope)), most > least
    if free.any():
        scale = 1.0 / np.sqrt(np.diag(curvature)[free])
        size, turn = np.linalg.eigh(curvature[np.ix_(free, free)] * np.outer(scale, scale))
        root = np.sqrt(np.maximum(size, FLAT) + damping)
        wanted = -turn.T @ (slope[free] * scale) / root
        box = least[free] / scale, most[free] / scale
        found = lsq_linear(root[:, None] * turn.T, wanted, box, method="bvls")
        step[free] = found.x * scale
    return step
