"""Every method on the same data, judged by the same score: what `quadid compare` runs.

Optimisers all minimise one objective in one box from one start, and may spend one budget; each is run with several
seeds.  Subspace models are fitted to the same windows.  Whatever found it, a model is scored as every other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from quadid.errors import ParameterError, nearest
from quadid.types import FloatArray, JsonDict
from quadid_evaluation.optimisers.minimise import NAMES as OPTIMISERS
from quadid_evaluation.optimisers.minimise import Result, minimise
from quadid_evaluation.paper.subspace import METHODS as SUBSPACE

METHODS = (
    "initial", "quasi_newton", "least_squares", "pso", "pso_polish", "cma_es", "l_shade", "differential_evolution",
    "cva", "moesp",
)  # fmt: skip
"""Methods by name, in the order of the table."""
KNOWN = (*METHODS, *(name for name in OPTIMISERS if name not in METHODS))
"""All names that may be asked for."""
SEEDLESS = frozenset({"initial", "quasi_newton", "least_squares", *SUBSPACE})
"""Methods without randomness: run once, whatever the number of seeds."""
SUCCESS = 1.01
"""A run has failed when its cost is above this multiple of the lowest cost that any run of any method found."""


class Problem(Protocol):
    """An objective in a box, as every optimiser sees it (`quadid_evaluation.optimisers.box`)."""

    lower: FloatArray
    upper: FloatArray
    start: FloatArray

    def theta(self, point: FloatArray) -> FloatArray:
        """Full parameter vector of a point, shape (size,)."""

    def cost(self, points: FloatArray) -> FloatArray:
        """Shapes (k, n) -> (k,)."""

    def residual(self, points: FloatArray) -> FloatArray:
        """Shapes (k, n) -> (k, samples); half its sum of squares is the cost."""


@dataclass(frozen=True)
class Trial:
    """One run of one optimiser.

    Attributes:
        seed: of all its randomness.
        found: what it ended with.
    """

    seed: int
    found: Result


@dataclass(frozen=True)
class Tried:
    """All runs of one optimiser.

    Attributes:
        name: of the optimiser.
        trials: one a seed.
    """

    name: str
    trials: tuple[Trial, ...]

    @property
    def typical(self) -> Trial:
        """The run of median cost (the lower one of two), which stands for the method in the tables."""
        return sorted(self.trials, key=lambda t: t.found.cost)[(len(self.trials) - 1) // 2]

    def failures(self, lowest: float) -> int:
        """Number of runs that ended above `SUCCESS` times the lowest cost."""
        return sum(not t.found.cost <= SUCCESS * lowest for t in self.trials)


def check_methods(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the methods asked for, each once, in the order of the table; raises ParameterError for unknown ones."""
    for name in names:
        if name not in KNOWN:
            raise ParameterError(f"unknown method '{name}'", ", ".join(KNOWN), nearest(name, KNOWN))
    return tuple(name for name in KNOWN if name in names)


def run_optimiser(
    name: str, problem: Problem, seeds: Sequence[int], budget: int, clock: Callable[[], float] | None = None
) -> Tried:
    """Runs one optimiser on a problem, once for each seed, or once where it has no randomness."""
    p = problem
    trials = [
        Trial(seed, minimise(name, p.cost, p.start, p.lower, p.upper, budget, seed, p.residual, clock))
        for seed in (seeds[:1] if name in SEEDLESS else seeds)
    ]
    return Tried(name, tuple(trials))


def lowest_cost(tried: Sequence[Tried]) -> float:
    """Lowest cost of all runs; infinite when there is none."""
    return min((t.found.cost for method in tried for t in method.trials), default=math.inf)


@dataclass(frozen=True)
class Scores:
    """What one model scores.

    Attributes:
        train: on the training windows.
        validate: on each validation log.
    """

    train: float
    validate: tuple[float, ...]

    def entry(self) -> JsonDict:
        """As JSON."""
        return {"train": self.train, "validate": list(self.validate)}


def optimiser_entry(
    method: Tried, lowest: float, scores: Scores, paper: Scores | None, parameters: Mapping[str, float]
) -> JsonDict:
    """One optimiser in the form of ``quadid.compare/1``; `mse` and `parameters` are those of its typical run."""
    typical = method.typical.found
    return {
        "name": method.name,
        "mse": scores.entry(),
        "mse_paper": None if paper is None else paper.entry(),
        "cost": typical.cost,
        "evaluations": typical.evaluations,
        "seconds": typical.seconds,
        "parameters": dict(parameters),
        "seed": method.typical.seed,
        "stop": typical.stop.value,
        "runs": len(method.trials),
        "failures": method.failures(lowest),
        "trials": [
            {"seed": t.seed, "cost": t.found.cost, "evaluations": t.found.evaluations, "seconds": t.found.seconds}
            for t in method.trials
        ],
    }


def black_box_entry(name: str, scores: Scores, order: int, fits: int, seconds: float) -> JsonDict:
    """One subspace method: it predicts, and gives no physical parameters."""
    return {
        "name": name,
        "mse": scores.entry(),
        "mse_paper": None,
        "evaluations": fits,
        "seconds": seconds,
        "parameters": {},
        "order": order,
        "runs": 1,
        "failures": 0,
        "note": "a black box: predicts, gives no physical parameters",
    }


def failed_entry(name: str, reason: str) -> JsonDict:
    """A method that could not be run on these data."""
    return {
        "name": name, "mse": {"train": math.nan, "validate": []}, "mse_paper": None, "evaluations": 0,
        "seconds": math.nan, "parameters": {}, "runs": 1, "failures": 1, "note": reason,
    }  # fmt: skip
