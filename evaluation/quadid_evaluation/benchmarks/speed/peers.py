"""The same search problem for this package and for its peers."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from quadid.identification.particle_swarm import Swarm, SwarmOptions
from quadid.identification.problem import Shooting
from quadid.identification.search import SWARM_SECONDS, SWARM_SEGMENTS, Projected
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.kernel import numpy_moments, numpy_step
from quadid_evaluation.benchmarks.speed.flights import flight
from quadid_evaluation.benchmarks.speed.timing import interleaved
from quadid_evaluation.optimisers.box import BoxProblem
from quadid_evaluation.optimisers.minimise import minimise

PARTICLES, ITERATIONS = 64, 4
WITHIN = 1.001
BUDGET = 3000
METHODS = ("least_squares", "pso_polish", "cma_es", "differential_evolution", "pso")


class NumpyObjective:
    """The swarm's cost in vectorised NumPy: all particles at once, and all segments of a set or one after the other.

    The same segments, Runge-Kutta step, weights and projection as `Rollout.costs`; checked against it.
    """

    def __init__(self, seconds: float, most: int | None = None) -> None:
        """Prepares a set of this length; all its segments, or at most about `most` spread evenly."""
        vehicle, window = Vehicle.shipped("pelican"), flight(seconds)
        whole = Shooting.cut([window], vehicle, SWARM_SECONDS)
        self.vehicle, self.shooting = vehicle, whole if most is None else whole.at_most(most)
        s = self.shooting
        self.theta, self.free = s.layout.initial(vehicle), s.free(NOMINAL_NAMES)
        self.ours = Projected(s, self.theta, self.free, s.count).costs
        self.lower, self.upper = np.log(vehicle.bounds).T
        self.segments, self.x0 = s.segments[0], s.starts(1).x0[0].copy()
        rollout = s.rollouts[0]
        self.measured, self.moments = rollout.measured, numpy_moments(vehicle, window.rotor_speed)
        sigma = np.sqrt(s.noise.variance)
        self.weights = rollout.valid[:, :9] / sigma
        (part,) = s.columns(self.theta, s.free([]))
        self.basis = part.basis
        self.dt = window.dt

    def kernel(self, points: FloatArray) -> FloatArray:
        """Costs of points (m, 6), logarithms, by this package's kernel."""
        thetas = np.repeat(self.theta[None], len(points), axis=0)
        thetas[:, self.free.index] = np.exp(points)
        return self.ours(thetas)

    def __call__(self, points: FloatArray) -> FloatArray:
        """Costs of points (m, 6), logarithms, by NumPy, vectorised over particles and segments."""
        return self._costs(points, slice(None))

    def segment_by_segment(self, points: FloatArray) -> FloatArray:
        """The same, vectorised over particles alone, as objectives for particle swarms are usually written."""
        return np.asarray(sum(self._costs(points, slice(i, i + 1)) for i in range(len(self.x0))))

    def _costs(self, points: FloatArray, which: slice) -> FloatArray:
        x0, starts = self.x0[which], self.segments.starts[which]
        m, count, length = len(points), len(x0), self.segments.length
        theta = np.repeat(np.exp(points).T[:, :, None], count, axis=2)  # (6, m, segments)
        x = np.repeat(x0[:, :7].T[:, None], m, axis=1)
        out = np.empty((length, 9, m, count))
        first = starts - 1
        before = numpy_step(x, theta, self.moments[first].T[:, None], self.vehicle.mass, self.dt)
        for i in range(length):
            row = first + 1 + i
            y = self.measured[row].T[:, None]
            out[i, :3] = x[4:7] - y[:3]
            out[i, 3:6] = rotation_error(x[:4], y[3:7])
            after = numpy_step(x, theta, self.moments[row].T[:, None], self.vehicle.mass, self.dt)
            out[i, 6:8], out[i, 8] = -y[7:9], 0.5 * (before + after) - y[9]
            before = after
        out *= self.weights[starts + np.arange(length)[:, None]].transpose(0, 2, 1)[:, :, None]
        flat = out.transpose(3, 0, 1, 2).reshape(count, -1, m)
        inside = np.matmul(self.basis[which].transpose(0, 2, 1), flat)
        return np.asarray(np.sum(flat**2, axis=(0, 1)) - np.sum(inside**2, axis=(0, 1)))


def rotation_error(q: FloatArray, measured: FloatArray) -> FloatArray:
    """Twice the vector part of the rotation from measured to simulated body, shapes (4, ...) -> (3, ...)."""
    w, x, y, z = q
    a, b, c, d = measured
    scalar = a * w + b * x + c * y + d * z
    error = np.stack([
        a * x - b * w - c * z + d * y, a * y - c * w - d * x + b * z, a * z - d * w - b * y + c * x,
    ])  # fmt: skip
    return np.asarray(2.0 * error * np.where(scalar < 0.0, -1.0, 1.0))


def objectives(rounds: int) -> dict[str, Any]:
    """One evaluation of the whole cost of a set, kernel and NumPy: processor time, thus per core."""
    rows = []
    for most, counts in ((SWARM_SEGMENTS, (16, 64, 256)), (None, (64,))):
        objective = NumpyObjective(500.0, most)
        for m in counts:
            points = np.random.default_rng(2).uniform(objective.lower, objective.upper, (m, 6))
            cases: dict[str, Callable[[], object]] = {
                "kernel": partial(_repeated, objective.kernel, points, 10),
                "particles": partial(objective.segment_by_segment, points),
                "both": partial(objective, points),
            }
            times = {name: t["processor"] for name, t in interleaved(cases, rounds).items()}
            kernel = times["kernel"] / 10.0
            rows.append({
                "segments": len(objective.x0), "particles": m, "kernel": kernel,
                "numpy": times["both"], "gain": times["both"] / kernel,
                "numpy_particles": times["particles"], "gain_particles": times["particles"] / kernel,
            })  # fmt: skip
    return {"rows": rows}


def _repeated(cost: Callable[[FloatArray], FloatArray], points: FloatArray, times: int) -> None:
    for _ in range(times):
        cost(points)


def swarms(rounds: int) -> dict[str, Any]:
    """A swarm of 64 particles over all of a 500 s set: this package, and pyswarms with the NumPy objective."""
    import pyswarms

    objective = NumpyObjective(500.0)
    few = np.random.default_rng(1).uniform(objective.lower, objective.upper, (8, 6))
    ratio = objective(few) / objective.kernel(few)
    evaluations = PARTICLES * ITERATIONS

    def ours() -> None:
        swarm = Swarm(objective.lower, objective.upper, PARTICLES, 1, SwarmOptions(iterations=ITERATIONS - 1))
        for _ in range(ITERATIONS):
            swarm.tell(objective.kernel(swarm.ask()))

    def theirs(cost: Callable[[FloatArray], FloatArray]) -> Callable[[], None]:
        def run() -> None:
            options = {"c1": 1.49, "c2": 1.49, "w": 0.73}
            swarm = pyswarms.single.GlobalBestPSO(
                PARTICLES, 6, options, bounds=(objective.lower, objective.upper)
            )  # fmt: skip
            swarm.optimize(cost, ITERATIONS, verbose=False)

        return run

    times = interleaved(
        {
            "quadid": ours,
            "pyswarms, NumPy over particles": theirs(objective.segment_by_segment),
            "pyswarms, NumPy over particles and segments": theirs(objective),
            "pyswarms, quadid's kernel": theirs(objective.kernel),
        },
        rounds,
    )
    for found in times.values():
        found["ms_per_evaluation"] = 1e3 * found["wall"] / evaluations
    return {
        "samples": len(objective.measured), "particles": PARTICLES, "evaluations": evaluations, "times": times,
        "cost_ratio": [float(ratio.min()), float(ratio.max())],
        "gain": _ratio(times, "and segments", "wall"), "gain_processor": _ratio(times, "and segments", "processor"),
        "gain_particles": _ratio(times, "over particles", "wall"),
        "gain_particles_processor": _ratio(times, "over particles", "processor"),
    }  # fmt: skip


def _ratio(times: dict[str, dict[str, Any]], ending: str, clock: str) -> float:
    """How often the time of quadid's swarm goes into that of the one whose name ends so."""
    (other,) = (t for name, t in times.items() if name.endswith(ending))
    return float(other[clock] / times["quadid"][clock])


def time_to_optimum(seeds: int) -> dict[str, Any]:
    """Seconds and evaluations until the cost is within 0.1 % of the optimum; 400 segments of 500 s."""
    vehicle = Vehicle.shipped("pelican")
    problem = BoxProblem([flight(500.0)], vehicle)
    best = minimise(
        "least_squares", problem.cost, problem.start, problem.lower, problem.upper, BUDGET, 0, problem.residual
    ).cost
    found: dict[str, list[tuple[float, int] | None]] = {name: [] for name in METHODS}
    for seed in range(seeds):
        start = np.random.default_rng(seed).uniform(problem.lower, problem.upper)
        for name in METHODS:
            found[name].append(_reach(name, problem, start, seed, WITHIN * best))
    return {"optimum": best, "seeds": seeds, "methods": {n: _told(runs) for n, runs in found.items()}}


def _told(runs: list[tuple[float, int] | None]) -> dict[str, Any]:
    reached = [r for r in runs if r is not None]
    seconds = [r[0] for r in reached]
    return {
        "reached": len(reached), "seconds": float(np.median(seconds)) if seconds else None,
        "quartiles": np.percentile(seconds, [25, 75]).tolist() if seconds else None,
        "evaluations": float(np.median([r[1] for r in reached])) if reached else None,
    }  # fmt: skip


def _reach(name: str, problem: BoxProblem, start: FloatArray, seed: int, limit: float) -> tuple[float, int] | None:
    evaluations, begin = 0, time.perf_counter()
    reached: list[tuple[float, int]] = []

    def residual(points: FloatArray) -> FloatArray:
        nonlocal evaluations
        out = problem.residual(points)
        evaluations += len(points)
        note(0.5 * float(np.min(np.sum(out**2, axis=1))))
        return out

    def cost(points: FloatArray) -> FloatArray:
        nonlocal evaluations
        out = problem.cost(points)
        evaluations += len(points)
        note(float(np.min(out)))
        return out

    def note(value: float) -> None:
        if value <= limit and not reached:
            reached.append((time.perf_counter() - begin, evaluations))

    minimise(name, cost, start, problem.lower, problem.upper, BUDGET, seed, residual)
    return reached[0] if reached else None
