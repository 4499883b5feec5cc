"""One call for every optimiser of the comparison: same box, same start, same budget, same account of evaluations.

The solvers are scipy's and pycma's, and this package's own swarm and L-SHADE; here they are only fed.  All work in the
unit box, start from (or include) the same point, and report the best point they ever evaluated.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import ParameterError, nearest
from quadid.identification.particle_swarm import Stop as SwarmStop
from quadid.identification.particle_swarm import Swarm, SwarmOptions, checked_box, read_only
from quadid.types import FloatArray
from quadid_evaluation.optimisers.ledger import WORST, Batch, BudgetSpentError, Ledger, NoGradientError
from quadid_evaluation.optimisers.lshade import SMALLEST_POPULATION, LShade, LShadeOptions
from quadid_evaluation.optimisers.lshade import Stop as LShadeStop


class Stop(StrEnum):
    """End of an optimiser."""

    CONVERGED = "the optimiser met its own tolerance"
    STALLED = "the optimiser gave up before it met its tolerance"
    BUDGET = "the evaluation budget is spent"
    NO_GRADIENT = "the cost is not finite where the optimiser needed a gradient"
    NOT_RUN = "the initial guess was evaluated and nothing else"


@dataclass(frozen=True)
class Result:
    """Result of an optimiser.

    Attributes:
        x: best point, shape (n,).
        evaluations: parameter vectors simulated, finite differences and the polish included; never above the budget.
        seconds: time on the caller's clock; NaN without a clock.
    """

    x: FloatArray
    cost: float
    evaluations: int
    seconds: float
    stop: Stop


def minimise(
    name: str,
    cost_batch: Batch,
    x0: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    budget: int,
    seed: int,
    residual: Batch | None = None,
    clock: Callable[[], float] | None = None,
) -> Result:
    """Minimises a cost in a box with the optimiser called `name`.

    Args:
        name: one of `NAMES`.
        cost_batch: (k, n) -> (k,); what is not finite counts as worst.
        x0: start, shape (n,), in the box.
        budget: largest number of parameter vectors that may be simulated.
        residual: (k, n) -> (k, m), for ``least_squares`` and ``pso_polish``; half its sum of squares is minimised, so
            the cost should rise and fall with that.
        clock: returns seconds, for `Result.seconds`.

    Raises:
        ParameterError: unknown name, invalid box or start, too small a budget, or a missing residual.
    """
    if name not in _SOLVERS:
        raise ParameterError(f"unknown optimiser '{name}'", ", ".join(NAMES), nearest(name, NAMES))
    low, high = checked_box(lower, upper)
    start = np.array(x0, dtype=np.float64)
    if start.shape != low.shape or not np.all((start >= low) & (start <= high)):
        raise ParameterError(f"start {start}", f"shape {low.shape}, inside the box", "clip it to the box")
    if budget < SMALLEST_POPULATION * (len(low) + 1):
        raise ParameterError(f"budget {budget}", f"at least {SMALLEST_POPULATION * (len(low) + 1)} evaluations")
    if name in NEED_RESIDUAL and residual is None:
        raise ParameterError(f"'{name}' without a residual", "a function (k, n) -> (k, m)", "pass residual=")
    ledger = Ledger(cost_batch, residual, low, high, budget)
    begin = clock() if clock else math.nan
    stop = _run(name, ledger, ledger.to_unit(start), seed)
    seconds = clock() - begin if clock else math.nan
    x = start if ledger.best is None else ledger.to_box(ledger.best)
    return Result(read_only(x), ledger.best_cost, ledger.evaluations, seconds, stop)


def _run(name: str, ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    kept = 1 if name in NEED_RESIDUAL else 0  # pays for the cost of the least residual
    ledger.budget -= kept
    try:
        stop = _SOLVERS[name](ledger, start, seed)
    except BudgetSpentError:
        stop = Stop.BUDGET
    except NoGradientError:
        stop = Stop.NO_GRADIENT
    ledger.budget += kept
    if kept:
        ledger.settle()
    return stop


def _initial(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    ledger.cost(start[None])
    return Stop.NOT_RUN


def _quasi_newton(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    """L-BFGS-B (Byrd et al. 1995, doi:10.1137/0916069) with forward differences."""
    import scipy.optimize

    solve: Any = scipy.optimize.minimize  # its stubs lack a cost that returns its gradient beside bounds
    options = {"maxiter": ledger.budget, "maxfun": ledger.budget, "ftol": 1e-12, "gtol": 1e-9}
    box = [(0.0, 1.0)] * len(start)
    found = solve(ledger.cost_and_gradient, start, jac=True, method="L-BFGS-B", bounds=box, options=options)
    return Stop.CONVERGED if found.success else Stop.STALLED


def _least_squares(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    """Trust-region reflective least squares (Branch, Coleman & Li 1999, doi:10.1137/S1064827595289108)."""
    from scipy.optimize import least_squares

    at: tuple[bytes, FloatArray] = b"", np.empty(0)

    def residual(u: FloatArray) -> FloatArray:
        nonlocal at
        at = u.tobytes(), ledger.residual(u[None])[0]
        return at[1]

    def jacobian(u: FloatArray) -> FloatArray:
        return ledger.jacobian(u, at[1] if at[0] == u.tobytes() else residual(u))

    if ledger.best is None:
        ledger.cost(start[None])  # the result is then never worse than the start
    if not np.all(np.isfinite(residual(start))):
        raise NoGradientError
    found: Any = least_squares(residual, start, jacobian, bounds=(0.0, 1.0), method="trf", x_scale=1.0)
    return Stop.CONVERGED if found.status > 0 else Stop.STALLED


def _differential_evolution(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    """Storn & Price 1997 (doi:10.1023/A:1008202821328), best1bin, vectorised, no polish."""
    import scipy.optimize

    def cost(u: FloatArray) -> FloatArray:  # (n, k) -> (k,); scipy's own tests need finite numbers
        return np.minimum(ledger.cost(np.clip(u.T, 0.0, 1.0)), WORST)

    evolve: Any = scipy.optimize.differential_evolution  # its stubs lack a vectorised cost
    found = evolve(
        cost,
        [(0.0, 1.0)] * len(start),
        x0=start,
        seed=np.random.default_rng(seed),
        vectorized=True,
        updating="deferred",
        polish=False,
        maxiter=ledger.budget,
        tol=1e-8,
    )
    return Stop.CONVERGED if found.success else Stop.STALLED


def _cma_es(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    """CMA-ES (Hansen 2016, arXiv:1604.00772) by pycma, initial step a quarter of the box, bounds by transformation."""
    import cma

    rng = np.random.default_rng(seed)
    options = {
        "bounds": [0.0, 1.0],
        "verbose": -10,
        "verb_log": 0,
        "verb_disp": 0,
        "seed": np.nan,  # leave numpy's global generator alone; all numbers come from ours
        "randn": lambda *shape: rng.standard_normal(shape),
    }
    ledger.cost(start[None])
    evolution = cma.CMAEvolutionStrategy(start, 0.25, options)
    while not evolution.stop():
        points = evolution.ask()
        evolution.tell(points, np.minimum(ledger.cost(np.array(points)), WORST).tolist())
    met = {"tolfun", "tolx", "tolfunhist", "tolfunrel"} & set(evolution.stop())
    return Stop.CONVERGED if met else Stop.STALLED


def _l_shade(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    """L-SHADE with the published settings; a small budget gets a population it can afford for ten generations."""
    n = len(start)
    population = max(SMALLEST_POPULATION, min(18 * n, ledger.budget // 10))
    options = LShadeOptions(population, initial_points=start)
    solver = LShade(np.zeros(n), np.ones(n), ledger.budget, seed, options)
    while solver.stop is LShadeStop.RUNNING:
        solver.tell(ledger.cost(solver.ask()))
    return Stop.CONVERGED if solver.stop is LShadeStop.CONVERGED else Stop.BUDGET


def algorithm_1(iterations: int) -> SwarmOptions:
    """The paper's Algorithm 1 as printed; the weight and the coefficients, not printed, are those of Shi & Eberhart."""
    return SwarmOptions("inertia", 2.0, 2.0, 0.9, 0.4, "in_turn", "clamp", None, iterations, patience=None)


def _swarm(ledger: Ledger, start: FloatArray, seed: int, budget: int, kept: int = 0, printed: bool = False) -> Stop:
    """4 n particles that leave `kept` iterations of the budget; as published, or `printed`: the paper's Algorithm 1."""
    n = len(start)
    particles = max(SMALLEST_POPULATION, min(4 * n, 64, budget // 10))
    iterations = max(budget // particles - kept, 1)
    options = algorithm_1(iterations) if printed else SwarmOptions(iterations=iterations, initial_points=start)
    swarm = Swarm(np.zeros(n), np.ones(n), particles, seed, options)
    while swarm.stop is SwarmStop.RUNNING:
        swarm.tell(ledger.cost(swarm.ask()))
    ends = {SwarmStop.CONVERGED: Stop.CONVERGED, SwarmStop.STALLED: Stop.STALLED}
    return ends.get(swarm.stop, Stop.BUDGET)


def _pso(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    """The constriction swarm, the start among its particles."""
    return _swarm(ledger, start, seed, ledger.budget)


def _pso_algorithm_1(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    """The paper's Algorithm 1 as printed: one particle at a time, all particles random, inertia weight 0.9 to 0.4."""
    ledger.cost(start[None])
    return _swarm(ledger, start, seed, ledger.budget, printed=True)


def _pso_polish(ledger: Ledger, start: FloatArray, seed: int) -> Stop:
    """A short swarm to find the basin (64 n evaluations, at most half the budget), then a local search."""
    _swarm(ledger, start, seed, min(64 * len(start), ledger.budget // 2), kept=1)
    return _least_squares(ledger, start if ledger.best is None else ledger.best, seed)


_SOLVERS: dict[str, Callable[[Ledger, FloatArray, int], Stop]] = {
    "initial": _initial,
    "quasi_newton": _quasi_newton,
    "least_squares": _least_squares,
    "pso": _pso,
    "pso_algorithm_1": _pso_algorithm_1,
    "pso_polish": _pso_polish,
    "cma_es": _cma_es,
    "l_shade": _l_shade,
    "differential_evolution": _differential_evolution,
}
NAMES: tuple[str, ...] = tuple(_SOLVERS)
"""Optimisers by name, as in the JSON of ``quadid compare``."""
NEED_RESIDUAL: frozenset[str] = frozenset({"least_squares", "pso_polish"})
"""Those that need the residual, not only the cost."""
