"""Worth of a particle swarm.  Every optimiser on smooth and non-smooth problems, narrow and wide bounds.

    python -m quadid_evaluation.studies.optimisers --seeds 30 --out docs/results

Each seed is a new individual Pelican, a new flight of 10 s (non-smooth: 5 s), and a start drawn in the box; all
optimisers of a seed get the same.  Smooth: the paper's six parameters.  Non-smooth: the vehicle's commands come late
and its rotors saturate; the simulation can be late by whole samples only, as simulations with a fixed step are, and
clips at a speed to be found: two more parameters, of which one has no gradient and the other has one only where the
rotors saturate.
"""

import copy
import time
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.flight import draw_truth, fly
from quadid.identification.noise import NoiseModel
from quadid.model.layout import Layout
from quadid.model.rollout import NUMBERS, Rollout, Segments
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import options, table
from quadid_evaluation.optimisers.minimise import NAMES, minimise
from quadid_evaluation.studies.truth import with_values

BUDGET = {"smooth": 1500, "non-smooth": 1000}
"""Simulations of the flight that a run may spend."""
SECONDS, SEGMENT = {"smooth": 10.0, "non-smooth": 5.0}, 0.2
SUCCESS = 1.01
DELAY, KNEE = 0.04, 1.12
LONGEST_DELAY, SPEEDS = 0.2, (1.0, 1.5)
"""Bounds of the delay [s] and of the saturation [hover speeds]."""
BOUNDS = {"narrow": 2.0, "wide": 10.0}
"""Factor each way around the truth, before the box is moved off it."""
OFF_CENTRE = 0.3
METHODS = tuple(n for n in NAMES if n != "initial")


class Problem:
    """Cost and residual of one flight; counts evaluations and remembers the best."""

    def __init__(self, window: Window, vehicle: Vehicle, truth: FloatArray, factor: float, seed: int) -> None:
        """Smooth problem: logarithms of the six parameters in a box of `factor` each way."""
        rng = np.random.default_rng([seed, round(factor), 7])
        centre = np.log(truth) + rng.uniform(-OFF_CENTRE, OFF_CENTRE, len(truth))
        self.lower, self.upper = centre - np.log(factor), centre + np.log(factor)
        self.truth = np.log(truth)
        self.window, self.vehicle = window, vehicle
        self.plain = Rollout(window, vehicle)
        self.segments = Segments.cut(len(window), round(SEGMENT / window.dt))
        self.x0 = self.plain.initial_states(self.segments)
        self.weight = 1.0 / np.sqrt(NoiseModel.guess(self.plain.channels).variance)
        self.neutral = Layout(vehicle).initial(vehicle)
        self.basis = self.state_directions()
        self.start = rng.uniform(self.lower, self.upper)
        self.forget()

    def forget(self) -> None:
        """Starts a new account."""
        self.evaluations, self.best = 0, np.inf
        self.trace: list[tuple[int, float]] = []

    def state_directions(self) -> FloatArray:
        """Orthonormal directions in which initial attitude and rate move the weighted residual of each segment."""
        dx = np.zeros((7, 12))
        dx[1 + np.arange(6), np.arange(6)] = 1e-6
        out, _ = self.plain.roll(self.segments, np.repeat(self.neutral[None], 7, axis=0), self.x0, dx)
        moved = (out[0, ..., 1:7] - out[0, ..., :1]) / 1e-6 * self.weight[:, None]
        return np.asarray(np.linalg.qr(moved.reshape(len(moved), -1, 6))[0])

    def rollout(self, point: FloatArray) -> Rollout:
        """The simulation that a point asks for."""
        return self.plain

    def residual(self, points: FloatArray) -> FloatArray:
        """Residuals in standard deviations, initial states projected out, (k, n) -> (k, samples)."""
        out = self.simulate(points)
        for row in out:
            self.evaluations += 1
            with np.errstate(over="ignore", invalid="ignore"):
                cost = 0.5 * float(row @ row)
            if cost < self.best:
                self.best = cost
                self.trace.append((self.evaluations, cost))
        return out

    def simulate(self, points: FloatArray) -> FloatArray:
        """Residuals of many points that share one rollout."""
        return self.roll(self.rollout(points[0]), points)

    def roll(self, rollout: Rollout, points: FloatArray) -> FloatArray:
        """Weighted residuals of one rollout, shape (k, samples)."""
        thetas = np.repeat(self.neutral[None], len(points), axis=0)
        thetas[:, : len(NOMINAL_NAMES)] = np.exp(points[:, : len(NOMINAL_NAMES)])
        with np.errstate(over="ignore", invalid="ignore"):
            out, _ = rollout.roll(self.segments, thetas, self.x0)
            lanes = np.moveaxis(out, -1, 1).reshape(-1, *out.shape[1:-1])[: len(points)]
            flat = (lanes * self.weight).reshape(*lanes.shape[:2], 1, -1)
            flat = flat - np.matmul(np.matmul(flat, self.basis), self.basis.transpose(0, 2, 1))
        return np.asarray(flat.reshape(len(points), -1))

    def cost(self, points: FloatArray) -> FloatArray:
        """Half the sum of squares, (k, n) -> (k,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(0.5 * np.sum(self.residual(points) ** 2, axis=1))

    def reached(self, limit: float) -> int | None:
        """Evaluations until the cost was below `limit`; None if it never was."""
        return next((n for n, cost in self.trace if cost <= limit), None)


class LateAndSaturated(Problem):
    """The non-smooth problem: a delay of whole samples and a speed that the rotors do not exceed, eight parameters."""

    def __init__(self, window: Window, vehicle: Vehicle, truth: FloatArray, factor: float, seed: int) -> None:
        """Adds delay [s] and saturation [hover speeds] to the six."""
        super().__init__(window, vehicle, truth, factor, seed)
        rng = np.random.default_rng([seed, round(factor), 8])
        low, high = np.array([0.0, SPEEDS[0]]), np.array([LONGEST_DELAY, SPEEDS[1]])
        self.lower, self.upper = np.append(self.lower, low), np.append(self.upper, high)
        self.hover = vehicle.hover_speed(truth[0])
        self.truth = np.append(self.truth, [DELAY, KNEE])
        self.start = np.append(self.start, rng.uniform(low, high))

    def rollout(self, point: FloatArray) -> Rollout:
        """Commands late by whole samples, clipped."""
        u = self.window.rotor_speed
        shift = round(point[6] / self.window.dt)
        late = np.concatenate([np.repeat(u[:1], shift, axis=0), u[: len(u) - shift]])
        # A copy with other commands: checking and preparing a new window would take longer than simulating it.
        window, rollout = copy.copy(self.window), copy.copy(self.plain)
        object.__setattr__(window, "rotor_speed", np.minimum(late, point[7] * self.hover))
        rollout.window, rollout._number = window, next(NUMBERS)
        return rollout

    def simulate(self, points: FloatArray) -> FloatArray:
        """Each point has a rollout of its own, unless all share delay and saturation."""
        if np.all(points[:, 6:] == points[0, 6:]):
            return super().simulate(points)
        return np.concatenate([self.roll(self.rollout(p), p[None]) for p in points])


@dataclass(frozen=True)
class Outcome:
    """One run: cost over that of the optimum, evaluations until success (None: failed), seconds."""

    ratio: float
    reached: int | None
    seconds: float


def problem(kind: str, bounds: str, seed: int) -> Problem:
    """The problem of one seed."""
    base = Vehicle.shipped("pelican")
    truth = draw_truth(base, seed)
    values = np.array([truth.as_dict()[n] for n in NOMINAL_NAMES])
    vehicle = with_values(base, values)
    if kind == "smooth":
        return Problem(fly(base, truth, SECONDS[kind], seed).window, vehicle, values, BOUNDS[bounds], seed)
    flight = fly(
        base,
        truth,
        SECONDS[kind],
        seed,
        effects={"command_delay": {"delay": DELAY}},
        outside={"weak_supply": {"knee": KNEE, "share": 0.0}},
    )
    return LateAndSaturated(flight.window, vehicle, values, BOUNDS[bounds], seed)


def optimum(task: Problem, seed: int) -> float:
    """Lowest cost near the truth."""
    inside = np.clip(task.truth, task.lower, task.upper)
    return minimise("least_squares", task.cost, inside, task.lower, task.upper, 1000, seed, task.residual).cost


def run(kind: str, bounds: str, seed: int, budget: int) -> dict[str, Outcome]:
    """Every optimiser on the problem of one seed; the optimum is the lowest cost that anything found."""
    task = problem(kind, bounds, seed)
    lowest, runs = optimum(task, seed), {}
    for name in METHODS:
        task.forget()
        begin = time.perf_counter()
        minimise(name, task.cost, task.start, task.lower, task.upper, budget, seed, task.residual)
        runs[name] = (task.best, task.trace, time.perf_counter() - begin)
    lowest = min(lowest, *(best for best, _, _ in runs.values()))
    out = {}
    for name, (best, trace, seconds) in runs.items():
        task.trace = trace
        out[name] = Outcome(best / lowest, task.reached(SUCCESS * lowest), seconds)
    return out


GAIN = 0.1
"""Share of runs that makes a swarm worth its evaluations."""


def successes_table(results: dict[tuple[str, str], list[dict[str, Outcome]]]) -> list[str]:
    """Markdown: a row a method, a column a problem."""
    heads, rows = [f"{kind}, {bounds} bounds" for kind, bounds in results], []
    for name in METHODS:
        cells = [name]
        for outcomes in results.values():
            reached, evaluations = successes(outcomes, name)
            middle, worst = (f([o[name].ratio for o in outcomes]) for f in (np.median, np.max))
            cells.append(f"{reached}, {f'{evaluations:.0f}' if reached else '–'}, {middle:.4g}, {worst:.4g}")
        rows.append(cells)
    return table(("method", *heads), rows)


def successes(outcomes: list[dict[str, Outcome]], name: str) -> tuple[int, float]:
    """Number of successes, and the median of evaluations to them (infinite without any)."""
    reached = [o[name].reached for o in outcomes if o[name].reached is not None]
    return len(reached), float(np.median([n for n in reached if n is not None])) if reached else np.inf


def best(outcomes: list[dict[str, Outcome]]) -> list[str]:
    """Methods by successes, then by evaluations."""
    return sorted(METHODS, key=lambda name: (-successes(outcomes, name)[0], successes(outcomes, name)[1]))


def answer(results: dict[tuple[str, str], list[dict[str, Outcome]]]) -> list[str]:
    """Conclusions from the tables about the swarm."""
    worth, alone = [], []
    for (kind, bounds), outcomes in results.items():
        first = best(outcomes)[0]
        gain = successes(outcomes, "pso_polish")[0] - successes(outcomes, "least_squares")[0]
        if gain >= GAIN * len(outcomes):
            worth.append(f"{kind}, {bounds} bounds (+{gain} successes)")
        if first in ("pso", "pso_algorithm_1") and successes(outcomes, first)[0]:
            alone.append(f"{kind}, {bounds} bounds")
    return [
        f"A swarm before least squares gains at least {GAIN:.0%} of the runs on: "
        + (f"{'; '.join(worth)}." if worth else "none of these problems."),
        "",
        f"A swarm without polish is best on: {'; '.join(alone) if alone else 'none of them'}.",
    ]


def page(results: dict[tuple[str, str], list[dict[str, Outcome]]], seeds: int) -> str:
    """The result as Markdown."""
    lines = [
        "# When is a particle swarm worth it?",
        "",
        f"`python -m quadid_evaluation.studies.optimisers --seeds {seeds} --out docs/results`",
        "",
        "Each seed is a new Pelican, flight and random start, the same for all methods. Success: cost within "
        f"{SUCCESS - 1.0:.0%} of the lowest of any method, or of least squares from the truth.",
        "",
        f"* Smooth: the six parameters, flights of {SECONDS['smooth']:g} s, segments of {SEGMENT:g} s, "
        f"{BUDGET['smooth']} evaluations.",
        f"* Non-smooth: flights of {SECONDS['non-smooth']:g} s with a command delay of {1e3 * DELAY:g} ms and rotors "
        f"that saturate at {KNEE:g} hover speeds. Delay (whole samples, no gradient) and saturation speed are fitted "
        f"too; {BUDGET['non-smooth']} evaluations.",
        "* Bounds: "
        + ", ".join(f"{name} a factor of {factor:g} each way" for name, factor in BOUNDS.items())
        + f", off centre by up to a factor of {np.exp(OFF_CENTRE):.2f}.",
        "",
        *answer(results),
        "",
    ]
    lines += [
        "Successes, median evaluations to success, median and largest cost over the optimum:",
        "",
        *successes_table(results),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    given, results = options(__doc__, seeds=30), dict[tuple[str, str], list[dict[str, Outcome]]]()
    for kind in ("smooth", "non-smooth"):
        for bounds in BOUNDS:
            results[kind, bounds] = [run(kind, bounds, seed, BUDGET[kind]) for seed in range(given.seeds)]
            print(*successes_table(results), sep="\n", flush=True)
    if given.out is not None:
        (given.out / "optimisers.md").write_text(page(results, given.seeds), encoding="utf-8")
