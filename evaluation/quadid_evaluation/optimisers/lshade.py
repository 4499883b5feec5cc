"""L-SHADE: differential evolution that learns its own step sizes and shrinks its population.

Success-history adaptation of F and CR, mutation current-to-pbest/1 with an archive of beaten parents, linear population
size reduction.  Ask/tell, one seed, no printing, no threads; it is independent of the problem.

Source: Tanabe & Fukunaga, "Improving the search performance of SHADE using linear population size reduction", CEC 2014,
doi:10.1109/CEC.2014.6900380.  Equation and algorithm numbers below are that paper's.
"""

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import ParameterError
from quadid.identification.particle_swarm import checked_box, place, read_only
from quadid.types import FloatArray

SMALLEST_POPULATION = 4
"""N_min: current-to-pbest/1 needs this many."""


class Stop(StrEnum):
    """State of the evolution: running, or the reason for its end."""

    RUNNING = "the population is still evolving"
    CONVERGED = "the population has shrunk below the tolerance"
    BUDGET = "the evaluation budget is spent"
    NO_FINITE_COST = "no individual has found a finite cost within the budget"


@dataclass(frozen=True)
class LShadeOptions:
    """Settings; the defaults are the paper's (Section III).

    Attributes:
        population: N_init; None for 18 n.
        memory: H, the number of entries of the success history.
        archive: r_arc, size of the archive as a multiple of the population.
        best_fraction: p of current-to-pbest.
        tolerance: converged when no individual is farther from the best than this fraction of the box in any component;
            0 to spend the whole budget, as the paper does.
        initial_points: shape (k, n), first k individuals, inside the box; the rest are drawn uniformly.
    """

    population: int | None = None
    memory: int = 6
    archive: float = 2.6
    best_fraction: float = 0.11
    tolerance: float = 1e-8
    initial_points: ArrayLike | None = field(default=None, compare=False)


class LShade:
    """L-SHADE in the box ``lower <= x <= upper``.

    Costs that are not finite count as worst.

    Attributes:
        best: position of the lowest finite cost so far, shape (n,).
        best_cost: its cost; infinite while there is none.
        stop: `Stop.RUNNING`, or why to stop.
        evaluations: number of costs told; never above the budget.
    """

    def __init__(
        self, lower: ArrayLike, upper: ArrayLike, budget: int, seed: int, options: LShadeOptions | None = None
    ) -> None:
        """Draws the first population.

        Args:
            budget: evaluations in all; the population shrinks linearly from N_init to 4 over them.

        Raises:
            ParameterError: an invalid box, initial point, or a budget below one population.
        """
        self.options = options or LShadeOptions()
        self._lower, self._upper = checked_box(lower, upper)
        n = len(self._lower)
        self._first_size = self.options.population or 18 * n
        if not SMALLEST_POPULATION <= self._first_size <= budget:
            raise ParameterError(
                f"a population of {self._first_size} with a budget of {budget}",
                f"{SMALLEST_POPULATION} <= population <= budget",
                "raise the budget or set LShadeOptions.population",
            )
        self.budget, self._rng = budget, np.random.default_rng(seed)
        self._trials = self._lower + (self._upper - self._lower) * self._rng.random((self._first_size, n))
        place(self.options.initial_points, self._trials, self._lower, self._upper)
        self._x, self._cost = np.empty((0, n)), np.empty(0)
        self._archive = np.empty((0, n))
        # Algorithm 2, line 4: all entries of M_CR and M_F are 0.5; NaN stands for the terminal value of M_CR.
        self._m_cr, self._m_f = np.full(self.options.memory, 0.5), np.full(self.options.memory, 0.5)
        self._entry = 0
        self._cr, self._f = np.empty(0), np.empty(0)
        self._asked = True
        self.best, self.best_cost = read_only(self._trials[0]), math.inf
        self.stop, self.evaluations = Stop.RUNNING, 0

    def ask(self) -> FloatArray:
        """Returns positions to be evaluated, shape (k, n); the same ones until they are told."""
        if self._asked:
            return self._trials.copy()
        (size, n), rng = self._x.shape, self._rng
        i, entry = np.arange(size), rng.integers(len(self._m_f), size=size)
        # Eq. (1): CR_i = 0 if M_CR is terminal, else N(M_CR, 0.1) cut to [0, 1].
        mean = self._m_cr[entry]
        self._cr = np.where(np.isnan(mean), 0.0, np.clip(mean + 0.1 * rng.standard_normal(size), 0.0, 1.0))
        # Eq. (2): F_i = Cauchy(M_F, 0.1), drawn again while not positive, cut at 1.
        location, f = self._m_f[entry], np.zeros(size)
        while np.any(pending := f <= 0.0):
            f[pending] = location[pending] + 0.1 * rng.standard_cauchy(int(pending.sum()))
        self._f = np.minimum(f, 1.0)
        # Eq. (3), current-to-pbest/1: v_i = x_i + F_i (x_pbest - x_i) + F_i (x_r1 - x_r2), r2 also from the archive;
        # r1 != i and r2 != i, r1 are drawn uniformly.
        elite = np.argsort(self._cost, kind="stable")[: max(round(self.options.best_fraction * size), 2)]
        p_best = self._x[elite[rng.integers(len(elite), size=size)]]
        everyone = np.concatenate([self._x, self._archive])
        r1 = rng.integers(size - 1, size=size)
        r1 += r1 >= i
        r2 = rng.integers(len(everyone) - 2, size=size)
        for taken in (np.minimum(i, r1), np.maximum(i, r1)):
            r2 += r2 >= taken
        mutant = self._x + self._f[:, None] * (p_best - self._x + self._x[r1] - everyone[r2])
        # Eq. (4): a component outside the box is put midway between the parent and the bound.
        mutant = np.where(mutant < self._lower, 0.5 * (self._lower + self._x), mutant)
        mutant = np.where(mutant > self._upper, 0.5 * (self._upper + self._x), mutant)
        # Eq. (5): binomial crossover; component j_rand always comes from the mutant.
        keep = rng.random((size, n)) > self._cr[:, None]
        keep[i, rng.integers(n, size=size)] = False
        # No trial beyond the budget: the last generation may be incomplete.
        self._trials = np.where(keep, self._x, mutant)[: self.budget - self.evaluations]
        self._asked = True
        return self._trials.copy()

    def tell(self, costs: ArrayLike) -> None:
        """Takes the costs of the positions last asked for, shape (k,).

        Raises:
            ParameterError: nothing was asked for, or another number of positions.
        """
        array = np.array(costs, dtype=np.float64)
        if not self._asked or array.shape != (len(self._trials),):
            raise ParameterError(f"costs of shape {array.shape}", f"one tell of shape ({len(self._trials)},) an ask")
        self._asked = False
        self.evaluations += len(array)
        array[~np.isfinite(array)] = np.inf
        if not len(self._x):
            self._x, self._cost = self._trials.copy(), array
        else:
            # Eq. (6): a trial replaces a parent it equals or beats; only a strict success enters archive and history.
            k = len(array)
            parent = self._cost[:k].copy()
            success, accept = array < parent, array <= parent
            self._archive = np.concatenate([self._archive, self._x[:k][success]])
            with np.errstate(over="ignore"):
                gain = parent[success] - array[success]
            self._learn(gain, self._cr[:k][success], self._f[:k][success])
            self._x[:k][accept] = self._trials[accept]
            self._cost[:k][accept] = array[accept]
            # Eq. (10): N = round((N_min - N_init) / budget * evaluations + N_init); the worst leave.
            span = SMALLEST_POPULATION - self._first_size
            size = max(round(span * self.evaluations / self.budget + self._first_size), SMALLEST_POPULATION)
            if size < len(self._x):
                stay = np.sort(np.argsort(self._cost, kind="stable")[:size])
                self._x, self._cost = self._x[stay], self._cost[stay]
            room = round(self.options.archive * len(self._x))
            if len(self._archive) > room:
                self._archive = self._archive[self._rng.choice(len(self._archive), room, replace=False)]
        leader = int(np.argmin(self._cost))
        if self._cost[leader] < self.best_cost:
            self.best, self.best_cost = read_only(self._x[leader]), float(self._cost[leader])
        finite = math.isfinite(self.best_cost)
        spread = np.max(np.abs(self._x - self.best) / (self._upper - self._lower))
        if finite and spread < self.options.tolerance:
            self.stop = Stop.CONVERGED
        elif self.evaluations >= self.budget:
            self.stop = Stop.BUDGET if finite else Stop.NO_FINITE_COST

    @property
    def population(self) -> int:
        """Present number of individuals."""
        return len(self._x) or self._first_size

    def _learn(self, gain: FloatArray, cr: FloatArray, f: FloatArray) -> None:
        # Algorithm 1 and Eqs. (7)-(9): weighted Lehmer means of the successful CR and F replace the oldest entry.
        if not len(gain):
            return
        finite = np.isfinite(gain)  # a parent without a finite cost counts like the largest finite gain
        gain = np.where(finite, gain, np.max(gain[finite], initial=0.0) or 1.0)
        weight = gain / np.max(gain)  # before the sum, which could overflow
        weight /= np.sum(weight)
        terminal = np.isnan(self._m_cr[self._entry]) or np.max(cr) == 0.0
        self._m_cr[self._entry] = np.nan if terminal else (weight @ cr**2) / (weight @ cr)
        self._m_f[self._entry] = (weight @ f**2) / (weight @ f)
        self._entry = (self._entry + 1) % len(self._m_f)
