"""Global search: the particle swarm on short segments, whose valley Gauss-Newton then follows to the bottom."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from quadid.identification.particle_swarm import Stop, Swarm, SwarmOptions
from quadid.identification.problem import RIDGE, Free, Shooting
from quadid.model.simd import LANES
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray

Progress = Callable[[str, float], None]

SWARM_SECONDS = 0.2
"""Length of the segments that the swarm simulates [s]."""
RESOLUTION = 0.5
"""Differences of the swarm's cost, a sum of squares over the noise, below which particles are equally good."""
SWARM_SEGMENTS = 100
"""Most segments the swarm simulates, spread evenly: it has to find the valley, whose bottom the polish finds."""


def swarm_search(
    shooting: Shooting,
    theta: FloatArray,
    free: Free,
    options: SwarmOptions,
    particles: int,
    seed: int,
    report: Progress,
) -> tuple[FloatArray, int]:
    """Global search by the particle swarm on a thinned set of segments.

    Args:
        shooting: the problem, short segments.
        theta: full vector; what is not free stays.
        free: parameters to search within their bounds.
        options: variant of the swarm and most iterations.
        particles: their number.
        seed: of the swarm.
        report: called with a stage and a fraction done.

    Returns:
        Full vector of the best particle, and the number of parameter vectors simulated.
    """
    stated = dict(zip(NOMINAL_NAMES, shooting.vehicle.bounds, strict=True))
    box = np.array([stated.get(e.name, (e.lower, e.upper)) for e in free.entries])
    lower, upper = (free.scaled(bound) for bound in box.T)
    cost = Projected(shooting, theta, free, SWARM_SEGMENTS).costs
    guess = np.clip(free.scaled(theta[free.index]), lower, upper)[None]
    settings = replace(options, initial_points=guess)
    swarm = Swarm(lower, upper, particles, seed, settings)
    done = 0
    while swarm.stop is Stop.RUNNING and not _resolved(swarm, settings):
        points = swarm.ask()
        thetas = np.repeat(theta[None], len(points), axis=0)
        thetas[:, free.index] = free.unscaled(points)
        swarm.tell(cost(thetas))
        done += 1
        report("swarm", min(done / (options.iterations + 1), 1.0))
    best = theta.copy()
    best[free.index] = free.unscaled(swarm.best)
    return best, done * particles


def _resolved(swarm: Swarm, settings: SwarmOptions) -> bool:
    """True when no particle's best is worse than the best of all by more than the data resolve."""
    worst = float(np.max(swarm.personal_bests[1]))
    return settings.tolerance > 0.0 and np.isfinite(worst) and worst - swarm.best_cost < RESOLUTION


class Projected:
    """Residuals of short segments without what their initial states can undo, for many parameter vectors at once.

    The directions of the initial states are taken at `theta` and projected out (variable projection): within a short
    segment they hardly depend on the parameters.
    """

    def __init__(self, shooting: Shooting, theta: FloatArray, free: Free, most: int) -> None:
        """Takes at most `most` segments, spread evenly, and the directions that matter beside `free`."""
        self._n_pre, k = shooting.start_of(theta, free)
        few = shooting.at_most(most)
        sigma = np.sqrt(few.noise.variance)
        self._jobs = []
        windows = zip(few.rollouts, few.segments, few.starts(self._n_pre).x0, strict=True)
        for i, (rollout, segments, start) in enumerate(windows):
            x0 = start.copy()
            rolled, steps = few.roll_directions(i, theta, few.free([]), x0, self._n_pre, k)
            columns = rolled[0, ..., : few.channels, 1 : k + 1] - rolled[0, ..., : few.channels, :1]
            flat = (columns / steps * (few.measured_weights(i) / sigma)[..., None]).reshape(len(x0), -1, k)
            flat = np.concatenate([flat, np.repeat(np.diag(1e-6 / RIDGE[:k])[None], len(flat), axis=0)], axis=1)
            basis = np.ascontiguousarray(np.linalg.qr(flat)[0][:, :-k])  # once, not at every call
            self._jobs.append((rollout, segments, x0, rollout.valid[:, : few.channels] / sigma, basis))

    def costs(self, thetas: FloatArray) -> FloatArray:
        """Sums of squares, in the noise's units, shapes (m, size) -> (m,)."""
        parts = [r.costs(cut, thetas, x0, weights, basis, self._n_pre) for r, cut, x0, weights, basis in self._jobs]
        return np.asarray(np.sum(parts, axis=0), dtype=np.float64)

    def residuals(self, thetas: FloatArray) -> FloatArray:
        """Residuals whose squares `costs` sums, shapes (m, size) -> (m, samples)."""
        parts = []
        for rollout, segments, x0, weights, basis in self._jobs:
            out, _ = rollout.roll(segments, thetas, x0, None, self._n_pre)
            scaled = out[..., : weights.shape[1], :] * weights[segments.rows][..., None]
            flat = scaled.reshape(*out.shape[:2], -1, LANES)
            flat = flat - np.matmul(basis, np.matmul(basis.transpose(0, 2, 1), flat))
            parts.append(flat.transpose(0, 3, 1, 2).reshape(-1, flat.shape[1] * flat.shape[2])[: len(thetas)])
        return np.concatenate(parts, axis=1)
