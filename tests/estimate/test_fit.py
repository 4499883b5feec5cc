"""The whole estimate on simulated flights: truth inside its intervals, no random forces where none act."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from quadid_evaluation.studies.fast_loop import fly as fast_loop
from quadid_evaluation.studies.filter_error import LATE

from quadid.estimate import kalman as k
from quadid.estimate.fit import Estimate, estimate, tails
from quadid.estimate.missing import Vehicles, removed, size, smoothed
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_window
from quadid.flight import TruthParameters, draw_truth, fly
from quadid.flight.loop import SensorNoise
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Command, ParameterPrior, Vehicle

PELICAN = Vehicle.shipped("pelican")
SECONDS = 30.0
GUSTS = {"gusts": {"push": 0.6, "turn": 1.0, "time": 0.5}}


def guessed(truth: dict[str, float], factor: float, seed: int) -> Vehicle:
    """Every guess off by up to `factor`, bounds around the guess."""
    rng = np.random.default_rng(seed)
    off = np.exp(rng.uniform(-1.0, 1.0, len(NOMINAL_NAMES)) * np.log(factor))
    priors = {n: ParameterPrior(initial=truth[n] * float(o)) for n, o in zip(NOMINAL_NAMES, off, strict=True)}
    return PELICAN.model_copy(update={"parameters": priors})


@lru_cache
def estimated(seed: int, factor: float = 1.4, guess: int = 0, gusty: bool = False) -> tuple[Estimate, dict[str, float]]:
    truth = draw_truth(PELICAN, seed)
    flight = fly(PELICAN, truth, SECONDS, seed, outside=GUSTS if gusty else {})
    vehicle = guessed(truth.as_dict(), factor, guess)
    problem = Problem.of([from_window(flight.window, vehicle)], vehicle)
    return estimate(problem), truth.as_dict()


def test_truth_lies_inside_the_intervals_and_no_random_force_is_found() -> None:
    found, truth = estimated(1)
    for name in NOMINAL_NAMES:
        value, sigma = found.value(name)
        assert abs(np.log(value / truth[name])) < 3.0 * sigma, name
    # At their least, but for what chance makes of 30 s: a hundredth of gravity, of the control moment.
    share = found.psi[k.SIGMA : k.SIGMA + 4] / found.problem.noise_scale[:4]
    assert np.all(share < 0.1), share
    white = np.mean(found.whitened[0][:, :9] ** 2, axis=0)
    assert np.all(np.abs(white - 1.0) < 0.05), white
    assert not tails(found.problem.tracks, found.problem.passes(found.z, found.psi)[1]).any()


def test_in_a_simulators_quiet_air_a_random_force_is_less_than_its_accelerometer_shows() -> None:
    """Held to a thousandth of gravity, it stood for the noise of logged rotor speeds and bent the thrust curve."""
    flight = fly(PELICAN, draw_truth(PELICAN, 1), SECONDS, 1, noise_scale=0.005, extras=("velocity",))
    found = estimate(Problem.of([from_window(flight.window, PELICAN)], PELICAN))
    assert np.all(found.psi[k.SIGMA : k.SIGMA + 2] < 0.002)


def test_a_velocity_that_nobody_measures_has_no_innovations_and_no_outliers() -> None:
    flight = fly(PELICAN, draw_truth(PELICAN, 1), SECONDS, 1)
    found = estimate(Problem.of([from_window(flight.window, PELICAN, air=True)], PELICAN, ("rotor_drag.k_x",)))
    assert not found.whitened[0][:, k.VELOCITY :].any()
    assert not found.problem.tail.any()


def test_guesses_off_by_up_to_four_end_at_the_same_optimum() -> None:
    ends = [estimated(2, 4.0, guess)[0] for guess in range(3)]
    for other in ends[1:]:
        for name in NOMINAL_NAMES:
            (value, sigma), (same, _) = ends[0].value(name), other.value(name)
            assert abs(np.log(value / same)) < 0.2 * sigma, name


def test_a_model_that_runs_away_has_no_finite_information() -> None:
    """A guess of a hexacopter's file did on a right flight, and `identify` refused the flight."""
    found, _ = estimated(1)
    gains = found.problem.passes(found.z, found.psi)[1]
    information, _ = found.problem.normal_equations(found.z, found.psi, gains, nudge=500.0)
    assert not np.isfinite(information).all()


def test_gusts_are_found_in_newtons() -> None:
    found, _ = estimated(3, gusty=True)
    parts = smoothed(found)
    # 0.6 m/s^2 along north and east, half of it down; 1 rad/s^2 about x and y.
    force, interval = size(parts, force=True)
    assert force[:2] == pytest.approx(PELICAN.mass * np.array([0.6, 0.6]), rel=0.3)
    assert np.all((interval[0] < force) & (force < interval[1]))
    inertia = [found.value(n)[0] for n in NOMINAL_NAMES[2:4]]
    assert size(parts, force=False)[0][:2] == pytest.approx(inertia, rel=0.3)


@pytest.mark.parametrize("speed", [0.0, 0.005])
def test_noisy_rotor_speeds_leave_the_inertias_alone(speed: float) -> None:
    """Random moments and 0.5 % noise on logged speeds made J 20 % too large, outside its interval."""
    window = fast_loop(PELICAN, 60.0, 1, speed=speed)
    found = estimate(Problem.of([from_window(window, PELICAN)], PELICAN))
    for name, true in zip(NOMINAL_NAMES[2:4], PELICAN.initial[2:4], strict=True):
        value, sigma = found.value(name)
        assert abs(np.log(value / true)) < max(3.0 * sigma, 0.01), name
        assert sigma < 0.03
    if speed:
        assert found.psi[k.ROTOR] == pytest.approx(speed * PELICAN.hover_speed(), rel=0.15)


def test_noisy_rotor_speeds_make_no_thrust_curve() -> None:
    """Noise took 7 % off the slope of a thrust that hardly varies: the accelerometer is compared with it too."""
    quiet = SensorNoise(0.002, 0.002, 1e-4, 1e-4, gyro_shake=0.0, accel_shake=0.0, velocity=0.002)
    window = fly(PELICAN, None, 40.0, 1, "roll_pitch", noise=quiet, extras=("velocity",)).window
    noise = 0.4 * np.random.default_rng(0).standard_normal(window.rotor_speed.shape)  # [rad/s]
    noisy = replace(window, rotor_speed=window.rotor_speed + noise)
    reads = PELICAN.model_copy(update={"command": Command(sampling="instant")})
    found = estimate(Problem.of([from_window(noisy, reads)], reads, ("thrust_curve.dead_speed",), [noisy]))
    value, sigma = found.value("thrust_curve.dead_speed")
    assert abs(value) < 2.0 * sigma
    assert sigma < 1.0  # of 370 rad/s
    inertia, share = found.value("J_xx")
    assert abs(np.log(inertia / TruthParameters.of(PELICAN).as_dict()["J_xx"])) < 3.0 * share


HIDDEN = {"cg_offset": {"x": 0.01, "y": 0.0}, "rotor_drag": {"k_x": 0.4, "k_y": 0.4}}


def test_the_model_with_the_cause_misses_less_on_another_flight() -> None:
    """Drag pulls against the velocity; on a flight that was not fitted the right model explains nearly all of it."""
    windows = [fly(PELICAN, None, 30.0, seed, effects=HIDDEN, extras=("velocity",)).window for seed in (1, 2)]
    layout = Layout(PELICAN)
    nominal = layout.initial(PELICAN)
    nominal[:6] = list(TruthParameters.of(PELICAN).as_dict().values())
    whole, half = nominal.copy(), nominal.copy()
    layout.write_effects(whole, HIDDEN)
    layout.write_effects(half, {"rotor_drag": {"k_x": 0.4, "k_y": 0.0}})
    flights = Vehicles(windows[:1], PELICAN, nominal)
    before, after, between = (flights.missing(windows[1:], theta) for theta in (nominal, whole, half))
    assert removed(before, after) > 0.95
    assert 0.1 < removed(before, between) < 0.95
    # What is missing without it: drag of 0.4 1/s at a few m/s.
    assert np.all(size(before, force=True)[0][:2] > 0.01 * before[0].weight)


@pytest.mark.parametrize("measured", [(), ("velocity",)], ids=["without velocity", "with velocity"])
def test_the_right_model_misses_nothing_and_is_right_about_its_errors(measured: tuple[str, ...]) -> None:
    """Drag tells the velocity that nobody measures; what was only added along the filter's states ran away there."""
    hidden = {"rotor_drag": {"k_x": 0.3, "k_y": 0.3}, "weak_rotor": {"rotor": 2, "loss": 0.04}}
    # Longer than the liveliest minute, on which the noise is settled.
    windows = [fly(PELICAN, None, 65.0, seed, effects=hidden, extras=measured).window for seed in (1, 2)]
    layout = Layout(PELICAN)
    theta = layout.initial(PELICAN)
    theta[:6] = list(TruthParameters.of(PELICAN).as_dict().values())
    layout.write_effects(theta, hidden)
    flights = Vehicles(windows[:1], PELICAN, theta)
    (found,) = flights.missing(windows[1:], theta)
    assert np.all(size([found], force=True)[0] < 0.003 * found.weight)
    assert np.all(size([found], force=False)[0] < 0.01 * found.control.std(axis=0))
    assert [flights.mean_square([w], theta) for w in windows] == pytest.approx([1.0, 1.0], abs=0.07)


def test_rows_without_a_measurement_are_rows_of_the_whole_model_too() -> None:
    """A gyro at half the grid's rate leaves every other row empty; the effects' table ended in a traceback there."""
    window = fly(PELICAN, draw_truth(PELICAN, 3), 10.0, 3, effects={"rotor_drag": {"k_x": 0.4, "k_y": 0.4}}).window
    empty = {}
    for name in ("gyro", "accel", "attitude"):
        values = getattr(window, name).copy()
        values[1::2] = np.nan
        empty[name] = values
    sparse = replace(window, velocity=None, position=None, **empty)
    layout = Layout(PELICAN)
    theta = layout.initial(PELICAN)
    for axis in "xy":
        theta[layout.entry(f"rotor_drag.k_{axis}").index] = 0.4
    (found,) = Vehicles([sparse], PELICAN, theta).missing([sparse], theta)
    assert len(found.t) == len(window)
    assert np.isfinite(found.force_sigma).all()


STRONG = {
    "motor_lag": {"tau": 0.03},
    "rotor_drag": {"k_x": 0.3, "k_y": 0.3},
    "axial_inflow": {"k_z": 0.3},
    "gyro_scale": {"x": 0.05},
    "imu_lag": {"cutoff": 12.0},
}
FREED = {
    "rotor_drag.k_x": 0.2,
    "motor_lag.tau": 0.02,
    "axial_inflow.k_z": 0.2,
    "gyro_scale.x": 0.04,
    "imu_lag.period": 0.06,
    "attitude_delay.delay": 0.01,
    "weak_rotor.loss_1": 0.02,
    "product_of_inertia.J_xy": 0.0,
    "parasitic_drag.c": 0.0,
}


def test_gradient_by_any_entry_is_the_slope_of_the_squares() -> None:
    """In every stage from command to sensor, under the gains and along the states of the pass it is taken at.

    What that leaves out, gains and states that follow the entry, is none on average at the truth; here, a fifth off in
    several causes, it is 0.6 standard errors at most, but for air that brakes, which is in the gains.
    """
    window = fly(PELICAN, None, 10.0, 3, effects=STRONG, extras=("velocity",)).window
    problem = Problem.of([from_window(window, PELICAN)], PELICAN, tuple(FREED), [window])
    psi = problem.first_noise()
    psi[k.SIGMA : k.SIGMA + 4] *= 0.2
    z = problem.start()
    for i, (name, _, _) in enumerate(problem.entries):
        z[i] += FREED.get(name, 0.0) / problem.size[i]
    problem = problem.along(z, psi)
    _, gains = problem.passes(z, psi)
    information, gradient = problem.normal_equations(z, psi, gains)
    sigma = 1.0 / np.sqrt(np.diag(information))
    for i, (name, _, _) in enumerate(problem.entries):
        steps = z + np.outer([1e-3, -1e-3], np.arange(len(z)) == i)
        above, below = (
            problem.penalty(x) + np.sum(problem.sensitivities(0, x, psi, gains[0], only=()).plain ** 2) for x in steps
        )
        assert gradient[i] * sigma[i] == pytest.approx((above - below) / 4e-3 * sigma[i], rel=1e-3, abs=0.01), name
        if not name.startswith(("rotor_drag", "axial_inflow", "parasitic_drag")):
            up, down = (problem.passes(x, psi)[0] for x in steps)
            assert gradient[i] * sigma[i] == pytest.approx((up - down) / 4e-3 * sigma[i], rel=0.02, abs=0.6), name


def test_a_motor_lag_among_the_late_causes_leaves_the_inertias_alone() -> None:
    """The six alone answer J_xx 12 % too large; with the family free it is right, and said to be."""
    truth = draw_truth(PELICAN, 5)
    vehicle = guessed(truth.as_dict(), 1.2, 5)
    window = fly(PELICAN, truth, SECONDS, 5, effects={"motor_lag": {"tau": 0.03}}).window
    track = from_window(window, vehicle)
    six, family = (estimate(Problem.of([track], vehicle, n, [window])) for n in ((), LATE))
    for name in NOMINAL_NAMES[2:4]:
        wrong, (value, sigma) = six.value(name)[0], family.value(name)
        assert np.log(wrong / truth.as_dict()[name]) > 0.04, name
        assert sigma < 0.03, name
        assert abs(np.log(value / truth.as_dict()[name])) < 3.0 * sigma, name
    lag, spread = family.value("motor_lag.tau")
    assert lag == pytest.approx(0.03, abs=max(3.0 * spread, 0.002))


def test_the_search_stays_in_a_corner_of_the_delay_that_a_short_lag_rounds() -> None:
    """The objective rises to either side of no delay, though its slope there points to negative ones."""
    truth = draw_truth(PELICAN, 1)
    vehicle = guessed(truth.as_dict(), 1.2, 1)
    window = fly(PELICAN, truth, 2.0 * SECONDS, 1, outside=GUSTS).window
    found = estimate(Problem.of([from_window(window, vehicle)], vehicle, LATE, [window]))
    names = [name for name, *_ in found.problem.entries]
    at, delay = found.z.copy(), names.index("command_delay.delay")
    at[delay], at[names.index("motor_lag.tau")] = 0.0, 0.002
    value, gains = found.problem.passes(at, found.psi)
    beside = 0.01 * (np.arange(len(at)) == delay)
    assert min(found.problem.objective(at + side, found.psi) for side in (-beside, beside)) > value + 0.1
    below, above, _ = found.problem.corner(at, found.psi, gains)
    assert below[delay] == above[delay] == 0.0


def test_outliers_lose_their_weight_and_pull_nothing() -> None:
    """One row in thirty with readings far off leaves the estimate of the flight without them."""
    flight = fly(PELICAN, draw_truth(PELICAN, 1), SECONDS, 1)
    assert flight.window.accel is not None
    accel, rng = flight.window.accel.copy(), np.random.default_rng(0)
    struck = rng.random(len(accel)) < 0.03
    accel[struck] += rng.normal(0.0, 3.0, (int(struck.sum()), 3))
    clean, found = (
        estimate(Problem.of([from_window(replace(flight.window, accel=a), PELICAN)], PELICAN))
        for a in (flight.window.accel, accel)
    )
    assert found.problem.tail[2] > 0.1
    weight = found.problem.passes(found.z, found.psi)[1][0].w[:, k.ACCEL : k.VELOCITY].min(axis=1)
    assert np.median(weight[struck]) < 0.02
    assert np.median(weight[~struck]) > 0.7
    for name in NOMINAL_NAMES[:5]:
        (value, sigma), (wanted, _) = found.value(name), clean.value(name)
        assert abs(np.log(value / wanted)) < sigma, name
        assert sigma < 1.3 * clean.value(name)[1], name


def test_an_ideal_accelerometer_without_drag_leaves_random_forces_a_size() -> None:
    """It reads exactly nothing along x and y: a least size of zero had no logarithm."""
    flight = fly(PELICAN, draw_truth(PELICAN, 1), SECONDS, 1)
    assert flight.window.accel is not None
    still = replace(flight.window, accel=flight.window.accel * [0.0, 0.0, 1.0])
    found = estimate(Problem.of([from_window(still, PELICAN)], PELICAN))
    assert found.problem.noise_bounds[:, 0].min() > 0.0
    assert found.finite
