"""The account of a comparison: every evaluation that any optimiser asks for is made, counted and limited here.

Optimisers count in their own ways: some leave out finite differences, some overdraw their limits by a population.  Here
one evaluation is one simulation of one parameter vector, whoever asks for it and whatever for.
"""

import math
from collections.abc import Callable

import numpy as np

from quadid.errors import ParameterError
from quadid.types import FloatArray

Batch = Callable[[FloatArray], FloatArray]

WORST = 1e30
"""Stands for a cost that is not finite where a solver cannot take infinity."""
STEP = 1e-6
"""Finite-difference step as a fraction of the box."""


class BudgetSpentError(Exception):
    """Unwinds an optimiser from inside when the budget is spent; caught in `optimisers.minimise`."""


class NoGradientError(Exception):
    """A gradient was needed beside a point where cost or residual is not finite; caught in `optimisers.minimise`."""


class Ledger:
    """Evaluates in the unit box, counts, keeps the best, and stops at the budget.

    Solvers see the box as 0 <= u <= 1, so that none is punished for the units of a parameter.

    Attributes:
        evaluations: parameter vectors simulated so far.
        best: best u by cost, shape (n,); None before the first finite cost.
    """

    def __init__(self, cost: Batch, residual: Batch | None, lower: FloatArray, upper: FloatArray, budget: int) -> None:
        """Takes the problem: `cost` (k, n) -> (k,), `residual` (k, n) -> (k, m), a box of shape (n,), evaluations."""
        self._cost, self._residual, self.budget = cost, residual, budget
        self._lower, self._upper = lower, upper
        self.evaluations, self.best_cost = 0, math.inf
        self.best: FloatArray | None = None
        self._least: tuple[float, FloatArray] | None = None

    @property
    def remaining(self) -> int:
        """Evaluations left."""
        return self.budget - self.evaluations

    def to_box(self, u: FloatArray) -> FloatArray:
        """Maps the unit box to the parameters' own, any shape (..., n)."""
        return np.clip(self._lower + u * (self._upper - self._lower), self._lower, self._upper)

    def to_unit(self, x: FloatArray) -> FloatArray:
        """Maps parameters to the unit box, any shape (..., n)."""
        return np.clip((x - self._lower) / (self._upper - self._lower), 0.0, 1.0)

    def cost(self, u: FloatArray) -> FloatArray:
        """Costs of positions of shape (k, n), shape (k,); what is not finite becomes infinite.

        Raises:
            BudgetSpentError: after evaluating as many of the k as the budget still pays for.
        """
        affordable = u[: self.remaining]
        costs = np.full(len(u), np.inf)
        if len(affordable):
            found = np.asarray(self._cost(self.to_box(affordable)), dtype=np.float64)
            if found.shape != (len(affordable),):
                raise ParameterError(f"cost_batch returned shape {found.shape}", f"({len(affordable)},)")
            costs[: len(affordable)] = np.where(np.isfinite(found), found, np.inf)
        self.evaluations += len(affordable)
        leader = int(np.argmin(costs))
        if costs[leader] < self.best_cost:
            self.best, self.best_cost = u[leader].copy(), float(costs[leader])
        if len(affordable) < len(u):
            raise BudgetSpentError
        return costs

    def residual(self, u: FloatArray) -> FloatArray:
        """Residuals of positions of shape (k, n), shape (k, m); not finite where the simulation was not.

        Raises:
            BudgetSpentError: without evaluating, when the budget does not pay for all k.
        """
        assert self._residual is not None
        if len(u) > self.remaining:
            raise BudgetSpentError
        self.evaluations += len(u)
        values = np.asarray(self._residual(self.to_box(u)), dtype=np.float64)
        if values.ndim != 2 or len(values) != len(u):
            raise ParameterError(f"residual returned shape {values.shape}", f"({len(u)}, m)")
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.sum(values**2, axis=1)
        squares[~np.isfinite(squares)] = np.inf
        leader = int(np.argmin(squares))
        if squares[leader] < (math.inf if self._least is None else self._least[0]):
            self._least = float(squares[leader]), u[leader].copy()
        return values

    def settle(self) -> None:
        """Evaluates the cost of the position with the least sum of squared residuals, where one is known."""
        if self._least is not None:
            self.cost(self._least[1][None])

    def cost_and_gradient(self, u: FloatArray) -> tuple[float, FloatArray]:
        """Cost and forward-difference gradient at u, shape (n,), for n + 1 evaluations in one batch."""
        neighbours, step = _neighbours(u)
        costs = self.cost(np.concatenate([u[None], neighbours]))
        if not math.isfinite(costs[0]):
            return WORST, np.zeros(len(u))
        if not np.all(np.isfinite(costs)):
            raise NoGradientError
        return float(costs[0]), (costs[1:] - costs[0]) / step

    def jacobian(self, u: FloatArray, at_u: FloatArray) -> FloatArray:
        """Forward-difference Jacobian, shape (m, n), from the residual `at_u` (m,), for n more evaluations."""
        neighbours, step = _neighbours(u)
        difference = self.residual(neighbours) - at_u
        if not np.all(np.isfinite(difference)):
            raise NoGradientError
        return np.asarray((difference / step[:, None]).T)


def _neighbours(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One neighbour a component, shape (n, n), inside the unit box, and the signed steps, shape (n,)."""
    step = np.where(u + STEP <= 1.0, STEP, -STEP)
    neighbours = u + np.diag(step)
    return neighbours, np.diag(neighbours) - u
