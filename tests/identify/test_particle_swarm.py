"""The swarm: published test functions, Algorithm 1 against a scalar transcription, bounds, seeds, hostile costs."""

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadid.errors import ParameterError
from quadid.identification.particle_swarm import Stop, Swarm, SwarmOptions
from quadid.types import FloatArray

Cost = Callable[[FloatArray], FloatArray]


def sphere(x: FloatArray) -> FloatArray:
    """Sum of squares, minimum 0 at 0."""
    return np.asarray(np.sum(x**2, axis=-1))


def rosenbrock(x: FloatArray) -> FloatArray:
    """Rosenbrock's valley, minimum 0 at 1."""
    return np.asarray(np.sum(100.0 * (x[..., 1:] - x[..., :-1] ** 2) ** 2 + (1.0 - x[..., :-1]) ** 2, axis=-1))


def rastrigin(x: FloatArray) -> FloatArray:
    """Rastrigin's egg box, minimum 0 at 0, about 11^n local minima in the usual box."""
    return np.asarray(np.sum(x**2 - 10.0 * np.cos(2.0 * np.pi * x) + 10.0, axis=-1))


def run(swarm: Swarm, cost: Cost) -> Swarm:
    """Drives a swarm until it stops by itself."""
    while swarm.stop is Stop.RUNNING:
        swarm.tell(cost(swarm.ask()))
    return swarm


def box(n: int, half_width: float) -> tuple[FloatArray, FloatArray]:
    """A cube about 0."""
    return np.full(n, -half_width), np.full(n, half_width)


def test_sphere_converges_from_every_seed() -> None:
    for seed in range(10):
        swarm = run(Swarm(*box(6, 100.0), 24, seed, SwarmOptions(iterations=1000)), sphere)
        assert swarm.stop is Stop.CONVERGED
        assert swarm.best_cost < 1e-6
        np.testing.assert_allclose(swarm.best, 0.0, atol=1e-3)


def test_rastrigin_finds_the_global_minimum_in_most_runs() -> None:
    options = SwarmOptions(iterations=500, patience=None)
    costs = [run(Swarm(*box(4, 5.12), 80, seed, options), rastrigin).best_cost for seed in range(10)]
    assert sum(cost < 1e-6 for cost in costs) >= 8
    assert max(costs) < 2.0  # one component in the neighbouring basin costs 0.995


def test_rosenbrock_in_two_dimensions_reaches_the_optimum_from_every_seed() -> None:
    options = SwarmOptions(iterations=1000, patience=None)
    for seed in range(10):
        np.testing.assert_allclose(run(Swarm(*box(2, 30.0), 30, seed, options), rosenbrock).best, 1.0, atol=1e-3)


def test_rosenbrock_in_four_dimensions_reaches_the_valley_but_creeps_along_it() -> None:
    """A swarm alone is no local solver: it is the polish that finds the last digits of a curved valley."""
    options = SwarmOptions(iterations=1000, patience=None, tolerance=0.0)
    costs = [run(Swarm(*box(4, 2.0), 30, seed, options), rosenbrock).best_cost for seed in range(6)]
    assert max(costs) < 0.1
    assert min(costs) > 1e-12


def test_components_of_very_different_size_are_searched_alike_in_a_log_box() -> None:
    truth = np.array([2.33e-5, 4.96e-7, 1.0e-2, 5.0e-5])

    def cost(log_x: FloatArray) -> FloatArray:
        return np.asarray(np.sum((np.exp(log_x) / truth - 1.0) ** 2, axis=-1))

    for seed in range(5):
        swarm = run(Swarm(np.log(truth / 4.0), np.log(truth * 3.0), 20, seed, SwarmOptions(iterations=500)), cost)
        np.testing.assert_allclose(np.exp(swarm.best), truth, rtol=1e-4)


def test_constriction_coefficient_is_the_published_one() -> None:
    assert SwarmOptions().chi == pytest.approx(0.7298, abs=5e-5)


def algorithm_1(
    cost: Callable[[list[float]], float],
    lower: list[float],
    upper: list[float],
    n: int,
    iterations: int,
    w: tuple[float, float],
    c1: float,
    c2: float,
    seed: int,
    batch: bool,
) -> list[float]:
    """The paper's Algorithm 1 in plain scalars, line by line; returns the cost of g_best after every iteration.

    `batch` postpones line 7 until all particles have moved, which is how a vectorised swarm runs.
    """
    rng = np.random.default_rng(seed)

    def uniform() -> float:
        return float(rng.random())

    m = len(lower)
    x = [[lower[j] + (upper[j] - lower[j]) * uniform() for j in range(m)] for _ in range(n)]
    v = [[lower[j] + (upper[j] - lower[j]) * uniform() - x[i][j] for j in range(m)] for i in range(n)]
    p_best, f_p = [list(xi) for xi in x], [cost(xi) for xi in x]
    g = f_p.index(min(f_p))
    g_best, f_g = list(p_best[g]), f_p[g]
    history = [f_g]
    for t in range(1, iterations + 1):  # line 1
        inertia = w[0] + (w[1] - w[0]) * (t - 1) / max(iterations - 1, 1)
        groups = [list(range(n))] if batch else [[i] for i in range(n)]
        for group in groups:
            r1 = {(i, j): uniform() for i in group for j in range(m)}
            r2 = {(i, j): uniform() for i in group for j in range(m)}
            for i in group:  # line 2
                for j in range(m):
                    individual = c1 * r1[i, j] * (p_best[i][j] - x[i][j])
                    v[i][j] = inertia * v[i][j] + (individual + c2 * r2[i, j] * (g_best[j] - x[i][j]))  # line 3
                    x[i][j] = x[i][j] + v[i][j]  # line 4
                    if x[i][j] > upper[j]:  # line 5
                        x[i][j] = upper[j]
                    if x[i][j] < lower[j]:
                        x[i][j] = lower[j]
            for i in group:
                f = cost(x[i])  # line 6
                if f < f_p[i]:  # line 7
                    p_best[i], f_p[i] = list(x[i]), f
                if f_p[i] < f_g:
                    g_best, f_g = list(p_best[i]), f_p[i]
        history.append(f_g)
    return history


@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_algorithm_1_line_by_line(seed: int, batch: bool) -> None:
    lower, upper, n, iterations, w, c1, c2 = [-3.0, -2.0, 0.5], [4.0, 5.0, 6.0], 7, 60, (0.9, 0.4), 1.7, 1.9

    def cost(x: list[float]) -> float:
        return sum((xi - 1.0) ** 2 + 3.0 * math.cos(5.0 * xi) for xi in x)

    expected = algorithm_1(cost, lower, upper, n, iterations, w, c1, c2, seed, batch)
    update: Literal["batch", "in_turn"] = "batch" if batch else "in_turn"
    options = SwarmOptions("inertia", c1, c2, *w, update, "clamp", None, iterations, 0.0, None)
    swarm, history, seen = Swarm(lower, upper, n, seed, options), [], -1
    while swarm.stop in (Stop.RUNNING, Stop.CONVERGED) and swarm.iteration < iterations:
        swarm.tell([cost(list(x)) for x in swarm.ask()])
        if swarm.evaluations == n * (swarm.iteration + 1) and swarm.iteration > seen:
            seen = swarm.iteration
            history.append(swarm.best_cost)
    np.testing.assert_allclose(history, expected, rtol=1e-12)
    assert swarm.evaluations == n * (iterations + 1)


def test_swarms_side_by_side_do_not_share_randomness() -> None:
    def step(swarm: Swarm) -> FloatArray:
        x = swarm.ask()
        swarm.tell(rastrigin(x))
        return x

    together = [Swarm(*box(3, 5.0), 8, seed) for seed in (3, 4)]
    interleaved = [[step(swarm) for swarm in together] for _ in range(10)]
    for k, seed in enumerate((3, 4)):
        alone = Swarm(*box(3, 5.0), 8, seed)
        np.testing.assert_array_equal([step(alone) for _ in range(10)], [row[k] for row in interleaved])


def test_asking_twice_gives_the_same_positions_and_telling_twice_is_refused() -> None:
    swarm = Swarm(*box(2, 1.0), 5, 0)
    np.testing.assert_array_equal(swarm.ask(), swarm.ask())
    swarm.tell(np.zeros(5))
    with pytest.raises(ParameterError, match="after each ask"):
        swarm.tell(np.zeros(5))
    swarm.ask()
    with pytest.raises(ParameterError, match=r"shape \(5,\)"):
        swarm.tell(np.zeros(4))


def test_positions_handed_out_are_copies() -> None:
    swarm = Swarm(*box(2, 1.0), 5, 0)
    swarm.ask()[:] = 99.0
    assert np.max(np.abs(swarm.ask())) <= 1.0
    swarm.tell(sphere(swarm.ask()))
    with pytest.raises(ValueError, match="read-only"):
        swarm.best[0] = 99.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("update", ["batch", "in_turn"])
def test_costs_that_are_not_finite_are_worst(bad: float, update: Any) -> None:
    def cost(x: FloatArray) -> FloatArray:
        return np.where(x[:, 0] > 0.0, bad, sphere(x + 1.0))

    swarm = run(Swarm(*box(3, 5.0), 15, 0, SwarmOptions(update=update, iterations=400)), cost)
    np.testing.assert_allclose(swarm.best, -1.0, atol=1e-3)


def test_a_swarm_that_never_sees_a_finite_cost_says_so() -> None:
    swarm = run(Swarm(*box(3, 5.0), 6, 0, SwarmOptions(iterations=20)), lambda x: np.full(len(x), np.nan))
    assert swarm.stop is Stop.NO_FINITE_COST
    assert math.isinf(swarm.best_cost)
    assert swarm.best.shape == (3,)


def test_stalls_on_a_plateau_and_runs_out_of_iterations_on_a_slope() -> None:
    plateau = run(Swarm(*box(2, 1.0), 5, 0, SwarmOptions(patience=7)), lambda x: np.ones(len(x)))
    assert (plateau.stop, plateau.iteration) == (Stop.STALLED, 7)
    slope = run(Swarm(*box(2, 1.0), 5, 0, SwarmOptions(iterations=9, tolerance=0.0)), sphere)
    assert (slope.stop, slope.iteration, slope.evaluations) == (Stop.BUDGET, 9, 50)


def test_initial_points_lead_the_first_batch_and_are_never_lost() -> None:
    points = np.array([[0.5, 0.5], [-0.5, 0.25]])
    swarm = Swarm(*box(2, 1.0), 5, 0, SwarmOptions(initial_points=points))
    np.testing.assert_array_equal(swarm.ask()[:2], points)
    swarm.tell([0.0, 1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(swarm.best, points[0])
    bests, costs = swarm.personal_bests
    np.testing.assert_array_equal(bests[:2], points)
    np.testing.assert_array_equal(costs, np.arange(5.0))


@pytest.mark.parametrize(
    ("lower", "upper", "particles", "options", "message"),
    [
        ([0.0], [0.0], 5, {}, "lower below upper"),
        ([0.0, 1.0], [1.0, math.inf], 5, {}, "component 1"),
        ([-1e308], [1e308], 5, {}, "component 0"),
        ([math.nan], [1.0], 5, {}, "component 0"),
        ([0.0, 0.0], [1.0], 5, {}, "equal shapes"),
        ([], [], 5, {}, "equal shapes"),
        ([0.0], [1.0], 0, {}, "at least 1"),
        ([0.0], [1.0], 2, {"c1": 1.0}, "constriction"),
        ([0.0], [1.0], 2, {"variant": "inertia", "c1": -1.0}, "negative"),
        ([0.0], [1.0], 2, {"velocity_clamp": 0.0}, "positive fraction"),
        ([0.0], [1.0], 2, {"iterations": 0}, "at least 1"),
        ([0.0], [1.0], 2, {"initial_points": [[2.0]]}, "outside the box"),
        ([0.0], [1.0], 2, {"initial_points": [[math.nan]]}, "outside the box"),
        ([0.0], [1.0], 2, {"initial_points": np.zeros((3, 1))}, r"up to \(2, 1\)"),
    ],
)
def test_what_makes_no_swarm_is_refused(
    lower: list[float], upper: list[float], particles: int, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ParameterError, match=message):
        Swarm(lower, upper, particles, 0, SwarmOptions(**options))


@settings(max_examples=60, deadline=None)
@given(
    lower=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=4),
    width=st.floats(1e-9, 1e6),
    particles=st.integers(1, 9),
    seed=st.integers(0, 2**32),
    options=st.builds(
        SwarmOptions,
        variant=st.sampled_from(["constriction", "inertia"]),
        update=st.sampled_from(["batch", "in_turn"]),
        walls=st.sampled_from(["absorb", "clamp"]),
        velocity_clamp=st.one_of(st.none(), st.floats(0.01, 2.0)),
        w_start=st.floats(0.0, 1.2),
        iterations=st.integers(1, 30),
        patience=st.one_of(st.none(), st.integers(1, 10)),
    ),
    pattern=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1, max_size=7),
)
def test_whatever_it_is_told_a_swarm_stays_in_its_box_and_remembers_the_best(
    lower: list[float], width: float, particles: int, seed: int, options: SwarmOptions, pattern: list[float]
) -> None:
    low = np.array(lower)
    high = low + width * (1.0 + np.abs(low))
    swarm, told = Swarm(low, high, particles, seed, options), [math.inf]
    for step in range(200):
        if swarm.stop is not Stop.RUNNING:
            break
        x = swarm.ask()
        assert np.all((x >= low) & (x <= high))
        costs = [pattern[(step + k) % len(pattern)] for k in range(len(x))]
        swarm.tell(costs)
        told += [c for c in costs if math.isfinite(c)]
        assert swarm.best_cost == min(told)
        assert np.all((swarm.best >= low) & (swarm.best <= high))
    assert swarm.stop is not Stop.RUNNING or options.update == "in_turn"
