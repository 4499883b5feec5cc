"""Worth of a particle swarm.  Every optimiser on smooth and non-smooth problems, narrow and wide bounds.

    python -m quadid_evaluation.studies.optimisers --seeds 30 --out docs/results

Each seed is a new individual Pelican, a new flight of 10 s (non-smooth: 5 s), and a start drawn in the box; all
optimisers of a seed get the same.  Smooth: the paper's six parameters.  Non-smooth: the vehicle's commands come late
and its rotors saturate; the simulation can be late by whole samples only, as simulations with a fixed step are, and
clips at a speed to be found: two more parameters, of which one has no gradient and the other has one only where the
rotors saturate.
"""

import copy
from collections.abc import Mapping
from itertools import product
from typing import Any, NamedTuple

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
    """Cost and residual of one flight; counts evaluations and remembers when the cost fell.

    Smooth: logarithms of the six parameters.  Late: two more, a delay of whole samples [s] and a speed that the rotors
    do not exceed [hover speeds].
    """

    def __init__(
        self, window: Window, vehicle: Vehicle, truth: FloatArray, factor: float, seed: int, late: bool
    ) -> None:
        """A box of `factor` each way around the six, moved off the truth, and a start in it."""
        rng = np.random.default_rng([seed, round(factor), 7])
        centre = np.log(truth) + rng.uniform(-OFF_CENTRE, OFF_CENTRE, len(truth))
        self.lower, self.upper, self.truth = centre - np.log(factor), centre + np.log(factor), np.log(truth)
        self.start = rng.uniform(self.lower, self.upper)
        if late:
            low, high = np.array([0.0, SPEEDS[0]]), np.array([LONGEST_DELAY, SPEEDS[1]])
            self.lower, self.upper = np.append(self.lower, low), np.append(self.upper, high)
            self.truth = np.append(self.truth, [DELAY, KNEE])
            self.start = np.append(self.start, np.random.default_rng([seed, round(factor), 8]).uniform(low, high))
        self.window, self.late, self.hover = window, late, vehicle.hover_speed(truth[0])
        self.plain = Rollout(window, vehicle)
        self.segments = Segments.cut(len(window), round(SEGMENT / window.dt))
        self.x0 = self.plain.initial_states(self.segments)
        self.weight = 1.0 / np.sqrt(NoiseModel.guess(self.plain.channels).variance)
        self.neutral = Layout(vehicle).initial(vehicle)
        # Orthonormal directions in which initial attitude and rate move the weighted residual of each segment.
        dx = np.zeros((7, 12))
        dx[1 + np.arange(6), np.arange(6)] = 1e-6
        out, _ = self.plain.roll(self.segments, np.repeat(self.neutral[None], 7, axis=0), self.x0, dx)
        moved = (out[0, ..., 1:7] - out[0, ..., :1]) / 1e-6 * self.weight[:, None]
        self.basis = np.linalg.qr(moved.reshape(len(moved), -1, 6))[0]
        self.forget()

    def forget(self) -> None:
        """Starts a new account."""
        self.evaluations = 0
        self.trace: list[tuple[int, float]] = [(0, np.inf)]

    def rollout(self, point: FloatArray) -> Rollout:
        """The simulation that a point asks for: commands late by whole samples, clipped."""
        if not self.late:
            return self.plain
        u = self.window.rotor_speed
        shift = round(point[6] / self.window.dt)
        late = np.concatenate([np.repeat(u[:1], shift, axis=0), u[: len(u) - shift]])
        # A copy with other commands: checking and preparing a new window would take longer than simulating it.
        window, rollout = copy.copy(self.window), copy.copy(self.plain)
        object.__setattr__(window, "rotor_speed", np.minimum(late, point[7] * self.hover))
        rollout.window, rollout._number = window, next(NUMBERS)
        return rollout

    def residual(self, points: FloatArray) -> FloatArray:
        """Residuals in standard deviations, initial states projected out, (k, n) -> (k, samples)."""
        # Each point has a rollout of its own, unless all share delay and saturation.
        shared = np.all(points[:, 6:] == points[0, 6:])
        parts = [points] if shared else [point[None] for point in points]
        out = np.concatenate([self.roll(self.rollout(part[0]), part) for part in parts])
        for row in out:
            self.evaluations += 1
            with np.errstate(over="ignore", invalid="ignore"):
                cost = 0.5 * float(row @ row)
            if cost < self.trace[-1][1]:
                self.trace.append((self.evaluations, cost))
        return out

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


class Outcome(NamedTuple):
    """One run: cost over that of the optimum, evaluations until success (None: failed)."""

    ratio: float
    reached: int | None


Outcomes = list[dict[str, Outcome]]
"""By seed and method."""


def problem(kind: str, bounds: str, seed: int) -> Problem:
    """The problem of one seed."""
    base, late = Vehicle.shipped("pelican"), kind != "smooth"
    truth = draw_truth(base, seed)
    values = np.array([truth.as_dict()[n] for n in NOMINAL_NAMES])
    how: dict[str, Any] = {}
    if late:
        how = {"effects": {"command_delay": {"delay": DELAY}}, "outside": {"weak_supply": {"knee": KNEE, "share": 0.0}}}
    window = fly(base, truth, SECONDS[kind], seed, **how).window
    return Problem(window, with_values(base, values), values, BOUNDS[bounds], seed, late)


def run(kind: str, bounds: str, seed: int) -> dict[str, Outcome]:
    """Every optimiser on the problem of one seed; the optimum is the lowest cost that anything found."""
    task = problem(kind, bounds, seed)
    inside = np.clip(task.truth, task.lower, task.upper)
    lowest = minimise("least_squares", task.cost, inside, task.lower, task.upper, 1000, seed, task.residual).cost
    traces = {}
    for name in METHODS:
        task.forget()
        minimise(name, task.cost, task.start, task.lower, task.upper, BUDGET[kind], seed, task.residual)
        traces[name] = task.trace
    lowest = min(lowest, *(trace[-1][1] for trace in traces.values()))
    reached = {name: next((n for n, c in trace if c <= SUCCESS * lowest), None) for name, trace in traces.items()}
    return {name: Outcome(trace[-1][1] / lowest, reached[name]) for name, trace in traces.items()}


GAIN = 0.1
"""Share of runs that makes a swarm worth its evaluations."""


def successes(outcomes: Outcomes, name: str) -> tuple[int, float]:
    """Number of successes, and the median of evaluations to them (infinite without any)."""
    reached = [n for o in outcomes if (n := o[name].reached) is not None]
    return len(reached), float(np.median(reached)) if reached else np.inf


def successes_table(results: Mapping[tuple[str, str], Outcomes]) -> list[str]:
    """Markdown: a row a method, a column a problem."""

    def cell(outcomes: Outcomes, name: str) -> str:
        (reached, evaluations), ratios = successes(outcomes, name), [o[name].ratio for o in outcomes]
        return f"{reached}, {f'{evaluations:.0f}' if reached else '–'}, {np.median(ratios):.4g}, {max(ratios):.4g}"

    heads = ("method", *(f"{kind}, {bounds} bounds" for kind, bounds in results))
    return table(heads, [(name, *(cell(outcomes, name) for outcomes in results.values())) for name in METHODS])


def page(results: Mapping[tuple[str, str], Outcomes], seeds: int) -> str:
    """The result as Markdown: what the tables say of the swarm, and the tables."""
    worth, alone = [], []
    for (kind, bounds), outcomes in results.items():
        found = {name: successes(outcomes, name) for name in METHODS}
        first = min(METHODS, key=lambda name: (-found[name][0], found[name][1]))
        gain = found["pso_polish"][0] - found["least_squares"][0]
        if gain >= GAIN * len(outcomes):
            worth.append(f"{kind}, {bounds} bounds (+{gain} successes)")
        if first in ("pso", "pso_algorithm_1") and found[first][0]:
            alone.append(f"{kind}, {bounds} bounds")
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
        f"A swarm before least squares gains at least {GAIN:.0%} of the runs on: "
        f"{'; '.join(worth) or 'none of these problems'}.",
        "",
        f"A swarm without polish is best on: {'; '.join(alone) or 'none of them'}.",
        "",
        "Successes, median evaluations to success, median and largest cost over the optimum:",
        "",
        *successes_table(results),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    given, results = options(__doc__, seeds=30), dict[tuple[str, str], Outcomes]()
    for kind, bounds in product(BUDGET, BOUNDS):
        results[kind, bounds] = [run(kind, bounds, seed) for seed in range(given.seeds)]
        print(*successes_table(results), sep="\n", flush=True)
    if given.out is not None:
        (given.out / "optimisers.md").write_text(page(results, given.seeds), encoding="utf-8")
