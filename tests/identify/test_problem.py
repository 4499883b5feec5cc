"""Multiple shooting: the eliminated small matrices against plain least squares, gaps, missing samples, priors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from quadid.data.window import Window
from quadid.errors import WindowError
from quadid.flight import draw_truth, fly
from quadid.identification.fit import Projected
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import MEASURED, VELOCITY_PRIOR, Free, Linearised, Shooting
from quadid.identification.result import settle_states
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from tests.identify.dense import DenseProblem, perturbed
from tests.identify.flights import PELICAN, at_truth, flown, without_rows

NOISE = NoiseModel(np.array([0.02] * 3 + [0.003] * 3 + [0.25] * 3), np.array([0.0] * 3 + [0.004] * 3 + [0.0] * 3))
RIDGE = np.array([1.0] * 3 + [20.0] * 3 + [30.0] * 3 + [100.0] * 3)
LATE = (*NOMINAL_NAMES, "motor_lag.tau", "cg_offset.x", "gyro_bias.z", "battery_sag.fraction")
DRAGGED = (*NOMINAL_NAMES, "rotor_drag.k_x", "rotor_drag.k_y", "parasitic_drag.c", "accel_bias.x")


@dataclass(frozen=True)
class Case:
    """A small problem linearised both ways."""

    shooting: Shooting
    free: Free
    theta: FloatArray
    lin: Linearised
    a: FloatArray
    b: FloatArray
    r: FloatArray
    precision: FloatArray
    away: FloatArray


def case(window: Window, names: Sequence[str], **values: float) -> Case:
    """Linearises 0.4 s segments of `window` at the truth with `values` set, and the same by plain differences."""
    shooting = Shooting.cut([window], PELICAN, 0.4, NOISE)
    free = shooting.free(list(names))
    theta = at_truth(shooting, flown(3).truth.parameters)
    for name, value in values.items():
        theta[shooting.layout.entry(name.replace("__", ".")).index] = value
    lin = shooting.linearise(theta, free, settle_states(shooting, theta).states)
    moving = any("drag" in n for n in names)
    n_pre = lin.n_pre
    (x0,) = shooting.starts(n_pre, lin.states).x0
    dense = DenseProblem(shooting.rollouts[0], shooting.segments[0], shooting.noise, 9, n_pre)
    k = 9 if moving else 6
    precision = RIDGE[:k] ** -2.0
    away = np.zeros((len(x0), k))
    if moving:
        precision = precision + np.array([0.0] * 6 + [VELOCITY_PRIOR**-2.0] * 3)
        fresh = Shooting.cut([window], PELICAN, 0.4, NOISE).starts(n_pre).x0[0]
        away[:, 6:] = x0[:, 7:10] - fresh[:, 7:10]
    return Case(
        shooting,
        free,
        theta,
        lin,
        dense.state_columns(theta, x0, k),
        dense.parameter_columns(theta, x0, free),
        dense.residual(theta, x0),
        precision,
        away,
    )


def explicit_cost(c: Case, s: int, z: FloatArray) -> float:
    """Least cost of segment `s` over its initial state for the parameter step `z`, by one dense least squares.

    The ridge pulls at the step of the state, the velocity prior at the velocity itself.
    """
    k = c.a.shape[2]
    ridge = RIDGE[:k] ** -1.0
    rows, target = [c.a[s], np.diag(ridge)], [-(c.r[s] + c.b[s] @ z), np.zeros(k)]
    if k == 9:
        prior = np.hstack([np.zeros((3, 6)), np.eye(3) / VELOCITY_PRIOR])
        rows, target = [*rows, prior], [*target, -c.away[s, 6:] / VELOCITY_PRIOR]
    matrix, right = np.vstack(rows), np.concatenate(target)
    step = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return float(np.sum((matrix @ step - right) ** 2))


@pytest.fixture(scope="module")
def short() -> Window:
    """Three seconds of an excited flight."""
    return flown(3).window.slice(500, 650)


@pytest.fixture(scope="module")
def late(short: Window) -> Case:
    return case(short, LATE, motor_lag__tau=0.02)


@pytest.fixture(scope="module")
def dragged(short: Window) -> Case:
    return case(short, DRAGGED, rotor_drag__k_x=0.2, rotor_drag__k_y=0.3, parasitic_drag__c=0.02)


@pytest.mark.parametrize("which", ["late", "dragged"])
def test_the_eliminated_cost_is_that_of_a_dense_least_squares_solve(which: str, request: pytest.FixtureRequest) -> None:
    c: Case = request.getfixturevalue(which)
    rng = np.random.default_rng(0)
    for s in range(len(c.r)):
        # Steps large enough that every parameter weighs, small enough that rounding does not.
        for z in (np.zeros(len(c.free.entries)), *(0.05 * rng.standard_normal((3, len(c.free.entries))))):
            fast = c.lin.cost[s] + 2.0 * c.lin.grad[s] @ z + z @ c.lin.gram[s] @ z
            assert fast == pytest.approx(explicit_cost(c, s, z), rel=2e-4)


@pytest.mark.parametrize("which", ["late", "dragged"])
def test_gram_and_gradient_are_those_of_the_projected_columns(which: str, request: pytest.FixtureRequest) -> None:
    """Written with a projector built by QR; finite differences of the fast path are one-sided."""
    c: Case = request.getfixturevalue(which)
    for s in range(len(c.r)):
        stacked = np.vstack([c.a[s], np.diag(np.sqrt(c.precision))])
        q = np.linalg.qr(stacked)[0]
        b = np.vstack([c.b[s], np.zeros((len(c.precision), c.b.shape[2]))])
        r = np.concatenate(
            [c.r[s], c.away[s] * (c.precision - RIDGE[: len(c.precision)] ** -2.0) / np.sqrt(c.precision)]
        )
        b = b - q @ (q.T @ b)
        scale = np.linalg.norm(c.b[s], axis=0) + 1e-12
        np.testing.assert_allclose(c.lin.gram[s] / np.outer(scale, scale), b.T @ b / np.outer(scale, scale), atol=2e-4)
        size = np.linalg.norm(c.r[s])
        np.testing.assert_allclose(c.lin.grad[s] / scale / size, b.T @ r / scale / size, atol=2e-4)
        assert np.linalg.eigvalsh(c.lin.gram[s]).min() > -1e-8 * scale.max() ** 2


def test_the_cost_of_a_segment_is_the_least_over_its_initial_states(short: Window) -> None:
    """Against an optimiser that knows nothing of the elimination, the full nonlinear simulation in its loop."""
    shooting = Shooting.cut([short], PELICAN, 0.4, NOISE)
    theta = at_truth(shooting, flown(3).truth.parameters)
    lin = settle_states(shooting, theta)
    (x0,) = shooting.starts(1, lin.states).x0
    rollout, cut = shooting.rollouts[0], shooting.segments[0]
    for s in range(len(x0)):
        one = DenseProblem(rollout, replace(cut, starts=cut.starts[s : s + 1]), NOISE, 9, 1)

        def residual(a: FloatArray, one: DenseProblem = one, s: int = s) -> FloatArray:
            return np.asarray(one.residual(theta, perturbed(x0[s : s + 1], np.concatenate([a, np.zeros(6)])))[0])

        start = np.random.default_rng(s).normal(0.0, [0.01] * 3 + [0.03] * 3)
        best = least_squares(residual, start, x_scale=[0.01] * 3 + [0.03] * 3, xtol=1e-12, ftol=1e-12)
        assert lin.cost[s] == pytest.approx(2.0 * best.cost, rel=1e-5)


@pytest.mark.parametrize(
    ("names", "values"),
    [
        ((*NOMINAL_NAMES, "cg_offset.y", "imu_lever_arm.x", "gyro_scale.y", "thrust_curve.dead_speed"), {}),
        (("motor_lag.tau", "command_delay.delay"), {"motor_lag.tau": 0.02, "command_delay.delay": 0.013}),
        (("imu_lag.period", "attitude_delay.delay"), {"imu_lag.period": 0.1, "attitude_delay.delay": 0.021}),
        (("rotor_spin_up.J", "product_of_inertia.J_xz", "weak_rotor.loss_2", "rate_damping.l_p"), {}),
    ],
)
def test_the_gradient_is_the_slope_of_the_profiled_cost(
    names: tuple[str, ...], values: dict[str, float], short: Window
) -> None:
    """Envelope theorem: with the initial states at their optimum, twice the gradient is the slope of the least cost."""
    shooting = Shooting.cut([short], PELICAN, 0.4, NOISE)
    theta = at_truth(shooting, flown(3).truth.parameters)
    for name, value in values.items():
        theta[shooting.layout.entry(name).index] = value
    free = shooting.free(list(names))
    lin = shooting.linearise(theta, free, settle_states(shooting, theta).states)
    h = 2e-3
    for j, name in enumerate(names):
        step = np.zeros(len(names))
        step[j] = h
        costs = []
        for sign in (1.0, -1.0):
            other = Shooting.cut([short], PELICAN, 0.4, NOISE)
            costs.append(settle_states(other, free.move(theta, sign * step)).cost.sum())
        slope = (costs[0] - costs[1]) / (2.0 * h)
        size = np.sqrt(lin.gram[:, j, j].sum() * lin.cost.sum())
        assert 2.0 * lin.grad[:, j].sum() == pytest.approx(slope, rel=5e-3, abs=5e-3 * size), name


def test_at_an_upper_bound_the_difference_steps_inwards(short: Window) -> None:
    shooting = Shooting.cut([short], PELICAN, 0.4, NOISE)
    theta = at_truth(shooting, flown(3).truth.parameters)
    entry = shooting.layout.entry("motor_lag.tau")
    theta[entry.index] = entry.upper
    free = shooting.free(["motor_lag.tau"])
    at_bound = shooting.linearise(theta, free)
    theta[entry.index] -= 2e-4 * entry.typical
    below = shooting.linearise(theta, free)
    np.testing.assert_allclose(at_bound.gram, below.gram, rtol=0.02, atol=1e-6)


def test_a_missing_sample_carries_no_weight(short: Window) -> None:
    """Rows without a gyro count as nothing: cost and gradient are those of a dense solve without these rows."""
    holed = without_rows(short, gyro=[40, 41, 77], accel=slice(90, 100))
    c = case(holed, LATE, motor_lag__tau=0.02)
    rows = c.shooting.segments[0].starts[:, None] + np.arange(c.shooting.length)
    masked = np.isin(rows, [40, 41, 77])
    assert not c.lin.weights[masked][:, :3].any()
    assert c.lin.weights[~masked][:, :3].all()
    assert not c.lin.weights[np.isin(rows, np.arange(90, 100))][:, 6:].any()
    for s in range(len(c.r)):
        assert c.lin.cost[s] == pytest.approx(explicit_cost(c, s, np.zeros(len(LATE))), rel=2e-4)
    full = case(short, LATE, motor_lag__tau=0.02)
    lost = np.count_nonzero(full.lin.weights) - np.count_nonzero(c.lin.weights)
    assert lost == 3 * 3 + 10 * 3
    assert full.lin.rows.sum() - c.lin.rows.sum() == pytest.approx(lost, abs=0.1)


def test_a_channel_that_is_absent_and_one_that_is_all_nan_are_the_same(short: Window) -> None:
    shooting = [
        Shooting.cut([w], PELICAN, 0.4, NOISE)
        for w in (replace(short, accel=None), without_rows(short, accel=slice(None)))
    ]
    theta = at_truth(shooting[0], flown(3).truth.parameters)
    one, other = (s.linearise(theta, s.free(NOMINAL_NAMES)) for s in shooting)
    np.testing.assert_array_equal(one.cost, other.cost)
    np.testing.assert_array_equal(one.gram, other.gram)
    # Without specific force nothing shows a factor common to thrust, drag and all inertias.
    information, common = one.gram.sum(axis=0), np.ones(6)
    assert abs(common @ information @ common) < 1e-6 * np.trace(information)


def test_rows_count_samples_less_fitted_directions(late: Case, dragged: Case) -> None:
    samples = late.shooting.length * 9
    np.testing.assert_allclose(late.lin.rows, samples - 6.0, atol=0.01)
    assert np.all(dragged.lin.rows < samples - 6.0)
    assert np.all(dragged.lin.rows > samples - 9.01)


def test_segments_never_cross_a_gap() -> None:
    window = flown(3).window
    parts = [window.slice(0, 400), window.slice(520, 900)]
    together = Shooting.cut(parts, PELICAN, 0.4, NOISE)
    theta = at_truth(together, flown(3).truth.parameters)
    free = together.free(NOMINAL_NAMES)
    lin = together.linearise(theta, free)
    alone = [Shooting.cut([p], PELICAN, 0.4, NOISE).linearise(theta, free) for p in parts]
    np.testing.assert_array_equal(lin.cost, np.concatenate([a.cost for a in alone]))
    np.testing.assert_array_equal(lin.gram, np.concatenate([a.gram for a in alone]))
    np.testing.assert_array_equal(lin.window, [0] * len(alone[0].cost) + [1] * len(alone[1].cost))
    ends = lin.time + (together.length - 1) * together.dt
    for w, part in enumerate(parts):
        mine = lin.window == w
        assert lin.time[mine].min() > part.t[0]
        assert ends[mine].max() <= part.t[-1]
        np.testing.assert_allclose(np.diff(lin.time[mine]), 0.4)


def test_windows_too_short_for_a_segment_are_left_out(short: Window) -> None:
    shooting = Shooting.cut([short.slice(0, 20), short], PELICAN, 0.4, NOISE)
    assert len(shooting.rollouts) == 1
    assert shooting.count == Shooting.cut([short], PELICAN, 0.4, NOISE).count


def test_a_window_of_another_vehicle_is_refused(short: Window) -> None:
    with pytest.raises(WindowError, match="rotor columns"):
        Shooting.cut([replace(short, rotor_speed=short.rotor_speed[:, :3])], PELICAN, 0.4)


def test_occam_turns_the_least_deviance_into_the_marginal_one(dragged: Case, late: Case) -> None:
    """-2 log of the integral over the initial velocity under its prior, per segment, from the dense columns."""
    c = dragged
    for s in range(len(c.r)):
        h = c.a[s].T @ c.a[s] + np.diag(RIDGE[:9] ** -2.0)
        told = h[6:, 6:] - h[6:, :6] @ np.linalg.solve(h[:6, :6], h[:6, 6:])
        expected = np.linalg.slogdet(np.eye(3) + VELOCITY_PRIOR**2 * told)[1]
        assert c.lin.occam[s] == pytest.approx(expected, abs=2e-3)
    assert np.all(c.lin.occam > 0.0)
    assert not late.lin.occam.any()


def test_the_velocity_prior_pulls_towards_dead_reckoning_but_gives_way_to_drag() -> None:
    """Where drag is strong the data find the velocity; the prior alone holds it elsewhere."""
    truth = draw_truth(PELICAN, 3)
    flight = fly(PELICAN, truth, 20.0, 3, effects={"rotor_drag": {"k_x": 0.6, "k_y": 0.6}}, noise_scale=0.2)
    shooting = Shooting.cut([flight.window], PELICAN, 1.0)
    theta = at_truth(shooting, truth)
    free = shooting.free(["rotor_drag.k_x", "rotor_drag.k_y"])
    (reckoned,) = shooting.starts(1).x0
    theta[free.index] = 0.6
    states = MEASURED
    for _ in range(4):
        states = shooting.linearise(theta, free, states).stepped()
    rows = shooting.segments[0].starts - 1
    true = flight.truth.velocity[rows]
    before = np.sqrt(np.mean((reckoned[:, 7:9] - true[:, :2]) ** 2))
    after = np.sqrt(np.mean((shooting.starts(1, states).x0[0][:, 7:9] - true[:, :2]) ** 2))
    assert after < 0.5 * before


def test_measured_velocity_leaves_no_room_for_the_prior() -> None:
    flight = fly(PELICAN, draw_truth(PELICAN, 3), 10.0, 3, extras=("velocity",))
    shooting = Shooting.cut([flight.window], PELICAN, 1.0)
    assert shooting.has_velocity
    theta = at_truth(shooting, flight.truth.parameters)
    lin = shooting.linearise(theta, shooting.free(["rotor_drag.k_x"]))
    assert not lin.occam.any()
    assert lin.residuals.shape[2] == 12


def test_a_simulation_that_runs_away_costs_infinity(short: Window) -> None:
    shooting = Shooting.cut([short], PELICAN, 0.4, NOISE)
    theta = at_truth(shooting, flown(3).truth.parameters)
    theta[:1] = 1e300
    lin = shooting.linearise(theta, shooting.free(NOMINAL_NAMES))
    assert np.isinf(lin.cost).all()
    assert np.isfinite(lin.gram).all()


def test_the_swarm_sees_the_same_valley_as_the_eliminated_cost() -> None:
    """White noise: near the point where the directions were taken, both costs differ by a constant."""
    window = flown(3).window.slice(0, 1500)
    shooting = Shooting.cut([window], PELICAN, 0.2)
    truth = at_truth(shooting, flown(3).truth.parameters)
    free = shooting.free(NOMINAL_NAMES)
    cost = Projected(shooting, truth, free, 10_000).costs
    rng = np.random.default_rng(0)
    thetas = np.array([free.move(truth, 0.05 * rng.standard_normal(6)) for _ in range(10)])
    swarm = cost(thetas)
    plain = []
    for theta in thetas:
        other = Shooting.cut([window], PELICAN, 0.2)
        plain.append(settle_states(other, theta).cost.sum())
    difference = swarm - np.array(plain)
    assert np.ptp(difference) < 0.02 * np.ptp(swarm)
    assert np.argmin(swarm) == np.argmin(plain)
    assert len(Projected(shooting, truth, free, 5).costs(thetas[:3])) == 3


def test_robust_weights_of_two_windows_go_with_the_segments_that_are_taken() -> None:
    window = flown(3).window
    shooting = Shooting.cut(
        [window.slice(0, 700), without_rows(window.slice(900, 1500), gyro=slice(40, 60))], PELICAN, 0.4, NOISE
    )
    theta, free = at_truth(shooting, flown(3).truth.parameters), shooting.free(NOMINAL_NAMES)
    plain = shooting.linearise(theta, free)
    weights = np.where(plain.weights > 0.0, np.random.default_rng(0).uniform(0.3, 1.0, plain.weights.shape), 0.0)
    robust = shooting.with_robust(weights)
    counts = [len(s.starts) for s in shooting.segments]
    third = robust.taking([np.arange(0, count, 3) for count in counts])
    whole, some = robust.linearise(theta, free), third.linearise(theta, free)
    kept = np.concatenate([np.arange(0, counts[0], 3), counts[0] + np.arange(0, counts[1], 3)])
    np.testing.assert_array_equal(some.weights, weights[kept])
    np.testing.assert_array_equal(some.window, whole.window[kept])
    np.testing.assert_allclose(some.cost, whole.cost[kept], rtol=1e-12)
    np.testing.assert_allclose(some.time, whole.time[kept])
    assert whole.total_cost < plain.total_cost
