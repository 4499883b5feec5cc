"""Particle swarm: the paper's Algorithm 1, and the constriction swarm that is the default.

An optimiser is a state machine with two verbs: `Swarm.ask` hands out positions to be evaluated, `Swarm.tell` takes
their costs.  It sees no more of the problem, draws all randomness from its seed, prints nothing and starts no threads.

Sources:
    Kennedy & Eberhart 1995, doi:10.1109/ICNN.1995.488968 (the swarm);
    Shi & Eberhart 1998, doi:10.1109/ICEC.1998.699146 (inertia weight; the paper's Algorithm 1);
    Clerc & Kennedy 2002, doi:10.1109/4235.985692 (constriction);
    Eberhart & Shi 2000, doi:10.1109/CEC.2000.870279 (constriction with a velocity clamp).
"""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import ParameterError
from quadid.types import FloatArray


class Stop(StrEnum):
    """Why a swarm stopped, or that it did not."""

    RUNNING = "the swarm is still searching"
    CONVERGED = "the swarm has shrunk below the tolerance"
    STALLED = "the best cost has not improved for as many iterations as patience allows"
    BUDGET = "the swarm has used all its iterations"
    NO_FINITE_COST = "no particle has found a finite cost in all iterations"


@dataclass(frozen=True)
class SwarmOptions:
    """Rules by which a swarm moves and stops.

    Attributes:
        variant: ``constriction`` (Clerc & Kennedy: chi = 0.7298 for c1 = c2 = 2.05) or ``inertia`` (Algorithm 1).
        c1: individual acceleration coefficient.
        c2: social acceleration coefficient; constriction needs c1 + c2 > 4.
        w_start: inertia weight of the first iteration (variant ``inertia`` only).
        w_end: inertia weight of the last iteration, reached linearly; equal to `w_start` for a constant weight.
        update: ``batch``: all particles move, then all are evaluated; ``in_turn``: one particle at a time moves and is
            evaluated, so the next one already follows a new best, as the loop of Algorithm 1 is printed.
        walls: what happens at a bound besides clamping the position: ``absorb`` sets the velocity component to zero,
            ``clamp`` leaves it (Algorithm 1).
        velocity_clamp: largest velocity component as a fraction of the width of the box; None for no clamp.
        iterations: T, the number of iterations after the initial evaluation.
        tolerance: converged when no particle is farther from the best than this fraction of the box in any component.
        patience: stalled after this many iterations without an improvement; None to go on to the last iteration.
        improvement: relative decrease of the best cost that counts as an improvement.
        initial_points: shape (k, n), positions of the first k particles inside the box; the rest are drawn uniformly.
    """

    variant: Literal["constriction", "inertia"] = "constriction"
    c1: float = 2.05
    c2: float = 2.05
    w_start: float = 0.9
    w_end: float = 0.4
    update: Literal["batch", "in_turn"] = "batch"
    walls: Literal["absorb", "clamp"] = "absorb"
    velocity_clamp: float | None = 0.5
    iterations: int = 200
    tolerance: float = 1e-6
    patience: int | None = 50
    improvement: float = 1e-6
    initial_points: ArrayLike | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        """Checks ranges; raises ParameterError."""
        if self.variant == "constriction" and not self.c1 + self.c2 > 4.0:
            raise ParameterError(f"c1 + c2 = {self.c1 + self.c2:g}", "more than 4 for constriction", "use 2.05 twice")
        if min(self.c1, self.c2) < 0.0:
            raise ParameterError(f"c1 = {self.c1:g}, c2 = {self.c2:g}", "no negative acceleration coefficient")
        if self.velocity_clamp is not None and not self.velocity_clamp > 0.0:
            raise ParameterError(f"velocity_clamp {self.velocity_clamp:g}", "a positive fraction of the box, or None")
        if self.iterations < 1 or (self.patience is not None and self.patience < 1):
            raise ParameterError(f"iterations {self.iterations}, patience {self.patience}", "at least 1")

    @property
    def chi(self) -> float:
        """Constriction coefficient of Clerc & Kennedy with kappa = 1: 2 / |2 - phi - sqrt(phi^2 - 4 phi)|."""
        phi = self.c1 + self.c2
        return 2.0 / abs(2.0 - phi - math.sqrt(phi * phi - 4.0 * phi))


class Swarm:
    """A swarm of particles in the box ``lower <= x <= upper``.

    Costs that are not finite (NaN and infinities of either sign) count as worst: such a position never becomes anyone's
    best, so a simulation that diverges repels nobody and attracts nobody.

    Attributes:
        options: as given.
        best: position of the lowest finite cost so far, shape (n,); the first particle while there is none.
        best_cost: its cost; infinite while there is none.
        stop: `Stop.RUNNING`, or why to stop.  The swarm obeys `ask` after that too; whether to go on is the caller's.
        iteration: number of completed iterations; the initial evaluation is number 0.
        evaluations: number of costs reported to it.
    """

    def __init__(
        self, lower: ArrayLike, upper: ArrayLike, particles: int, seed: int, options: SwarmOptions | None = None
    ) -> None:
        """Draws the initial positions and velocities.

        Args:
            lower: shape (n,), finite.
            upper: shape (n,), finite, above `lower` in every component.
            particles: N, at least 1.
            seed: of the swarm's own generator.
            options: default `SwarmOptions()`.

        Raises:
            ParameterError: a box, a number of particles or initial points that make no swarm.
        """
        self.options = options or SwarmOptions()
        self._lower, self._upper = checked_box(lower, upper)
        if particles < 1:
            raise ParameterError(f"{particles} particles", "at least 1")
        self._width = self._upper - self._lower
        self._rng = np.random.default_rng(seed)
        shape = (particles, len(self._width))
        # Algorithm 1, initialization: "random position (x) and velocity (v) within the search space boundaries": both
        # the position and the first step stay in the box.
        self._x = np.minimum(self._lower + self._width * self._rng.random(shape), self._upper)
        target = self._lower + self._width * self._rng.random(shape)
        place(self.options.initial_points, self._x, self._lower, self._upper)
        self._v = target - self._x
        self._own_best, self._own_cost = self._x.copy(), np.full(particles, np.inf)
        self.best, self.best_cost = read_only(self._x[0]), math.inf
        self.stop, self.iteration, self.evaluations = Stop.RUNNING, 0, 0
        self._turn, self._placed = slice(0, particles), True
        self._mark, self._idle = math.inf, 0

    def ask(self) -> FloatArray:
        """Returns positions to be evaluated, shape (k, n).

        k is the number of particles; with ``update="in_turn"`` it is 1 after the initial evaluation.  Asking again
        without telling returns the same positions.
        """
        if not self._placed:
            self._move(self._turn)
            self._placed = True
        return self._x[self._turn].copy()

    def tell(self, costs: ArrayLike) -> None:
        """Takes the costs of the positions last asked for, shape (k,), and updates bests and `stop`.

        Raises:
            ParameterError: no positions are waiting for costs, or their number differs.
        """
        array = np.array(costs, dtype=np.float64)
        waiting = self._turn.stop - self._turn.start
        if not self._placed or array.shape != (waiting,):
            raise ParameterError(f"costs of shape {array.shape}", f"one tell of shape ({waiting},) after each ask")
        self.evaluations += waiting
        array[~np.isfinite(array)] = np.inf
        # Algorithm 1, line 7: P_best = x_i if f(x_i) is better than f(P_best), g_best likewise.
        better = array < self._own_cost[self._turn]
        self._own_best[self._turn][better] = self._x[self._turn][better]
        self._own_cost[self._turn][better] = array[better]
        leader = int(np.argmin(self._own_cost))
        if self._own_cost[leader] < self.best_cost:
            self.best, self.best_cost = read_only(self._own_best[leader]), float(self._own_cost[leader])
        self._advance()

    @property
    def personal_bests(self) -> tuple[FloatArray, FloatArray]:
        """Best position, shape (particles, n), and its cost, shape (particles,), of every particle."""
        return self._own_best.copy(), self._own_cost.copy()

    @property
    def inertia_weight(self) -> float:
        """Inertia weight of the iteration in progress, t = 1 ... T."""
        o = self.options
        return o.w_start + (o.w_end - o.w_start) * min(self.iteration / max(o.iterations - 1, 1), 1.0)

    def _move(self, turn: slice) -> None:
        o, x, v = self.options, self._x[turn], self._v[turn]
        r1, r2 = self._rng.random((2, *x.shape))
        # Algorithm 1, line 3: v_i(t) = w v_i(t-1) + c1 r1 (P_best,i - x_i(t-1)) + c2 r2 (g_best,i - x_i(t-1)),
        # with r1, r2 ~ U(0, 1) drawn anew for every particle and component.
        pull = o.c1 * r1 * (self._own_best[turn] - x) + o.c2 * r2 * (self.best - x)
        # Clerc & Kennedy's constriction scales the whole sum instead: v = chi (v + pull).
        v = o.chi * (v + pull) if o.variant == "constriction" else self.inertia_weight * v + pull
        if o.velocity_clamp is not None:
            v = np.clip(v, -o.velocity_clamp * self._width, o.velocity_clamp * self._width)
        # Algorithm 1, line 4: x_i(t) = x_i(t-1) + v_i(t); line 5: x_i(t) clamped to [x_lb, x_ub].
        moved = x + v
        self._x[turn] = np.clip(moved, self._lower, self._upper)
        outside = (moved < self._lower) | (moved > self._upper)
        self._v[turn] = np.where(outside & (o.walls == "absorb"), 0.0, v)

    def _advance(self) -> None:
        particles, initial = len(self._x), self.evaluations == len(self._x)
        self._placed = False
        complete = self._turn.stop == particles
        if self.options.update == "in_turn":
            start = 0 if complete else self._turn.stop
            self._turn = slice(start, start + 1)
        if complete:
            self.iteration += 0 if initial else 1
            self._judge()

    def _judge(self) -> None:
        o = self.options
        improved = self.best_cost < self._mark - o.improvement * abs(self._mark) if self._mark < math.inf else True
        if improved:
            self._mark, self._idle = self.best_cost, 0
        else:
            self._idle += 1
        spread = float(np.max(np.abs(self._x - self.best) / self._width))
        if math.isfinite(self.best_cost) and len(self._x) > 1 and spread < o.tolerance:
            self.stop = Stop.CONVERGED
        elif o.patience is not None and self._idle >= o.patience:
            self.stop = Stop.STALLED
        elif self.iteration >= o.iterations:
            self.stop = Stop.BUDGET if math.isfinite(self.best_cost) else Stop.NO_FINITE_COST
        else:
            self.stop = Stop.RUNNING


def read_only(values: FloatArray) -> FloatArray:
    """Returns a copy that refuses to be written to, same shape."""
    copy = values.copy()
    copy.setflags(write=False)
    return copy


def place(points: ArrayLike | None, among: FloatArray, lower: FloatArray, upper: FloatArray) -> None:
    """Writes initial points (k, n), if there are any, over the first of a population (N, n).

    Raises:
        ParameterError: more points than the population has, of another length, or outside the box.
    """
    if points is None:
        return
    given = np.atleast_2d(np.array(points, dtype=np.float64))
    if given.shape[1:] != lower.shape or len(given) > len(among):
        raise ParameterError(f"initial points of shape {given.shape}", f"up to {among.shape}")
    if not np.all((given >= lower) & (given <= upper)):
        raise ParameterError("an initial point outside the box", "lower <= point <= upper", "clip it to the box")
    among[: len(given)] = given


def checked_box(lower: ArrayLike, upper: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Returns both bounds as arrays, shape (n,); raises ParameterError unless they are finite and lower < upper."""
    low, high = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    if low.ndim != 1 or low.shape != high.shape or not low.size:
        raise ParameterError(f"bounds of shape {low.shape} and {high.shape}", "two equal shapes (n,), n at least 1")
    with np.errstate(invalid="ignore", over="ignore"):
        valid = np.isfinite(low) & np.isfinite(high) & np.isfinite(high - low) & (low < high)
    if not np.all(valid):
        i = int(np.argmin(valid))
        raise ParameterError(f"bounds [{low[i]:g}, {high[i]:g}] of component {i}", "finite bounds, lower below upper")
    return low, high
