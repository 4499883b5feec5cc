"""The filter against dense textbook algebra, its score against differences, its motion against the kernel's."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from quadid.data.window import Window
from quadid.estimate import kalman as k
from quadid.estimate.problem import PLACES, Problem
from quadid.estimate.track import _curved, from_window
from quadid.estimate.whole_model import WholeModel
from quadid.flight import Flight, draw_truth, fly
from quadid.model.layout import Layout
from quadid.model.step import simulate
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.estimate.linear import NOISE, PELICAN, batch, dense_filter, physics, tiny_flight


def test_likelihood_and_means_are_those_of_a_dense_filter() -> None:
    track = tiny_flight()
    total, means = dense_filter(track)
    value, gains = k.kalman(track, physics(), NOISE)
    assert value == pytest.approx(total, rel=1e-9)
    np.testing.assert_allclose(gains.mean[:, 4:], means[:, 3:], atol=1e-9)
    np.testing.assert_allclose(2.0 * gains.mean[:, 1:4], means[:, :3], atol=1e-9)


def test_smoother_is_batch_least_squares() -> None:
    track = tiny_flight()
    mean, variance = batch(track)
    _, gains = k.kalman(track, physics(), NOISE)
    _, found, spread, *_ = k.backward(track, physics(), NOISE, gains, True)
    np.testing.assert_allclose(found, mean[:, k.FO :], atol=1e-9)
    np.testing.assert_allclose(spread, variance[:, k.FO :], rtol=1e-6)


def test_smoother_needs_no_attitude() -> None:
    """Without attitude the estimator's error is exactly zero; random forces are smoothed all the same."""
    track = tiny_flight()
    seen = track.seen.copy()
    seen[:, 1] = False
    track = track._replace(seen=seen)
    _, gains = k.kalman(track, physics(), NOISE)
    _, found, spread, *_ = k.backward(track, physics(), NOISE, gains, True)
    assert (spread[:, : k.AE - k.FO] > 0.0).all()
    assert np.abs(found[0, : k.AE - k.FO]).max() > 0.0


@pytest.mark.parametrize(("share", "lost"), [(0.1, 1e-3), (0.2, 3e-3), (0.3, 6e-3), (0.4, 1e-2)])
def test_rotors_that_turn_between_readings_keep_their_moments(share: float, lost: float) -> None:
    """Lines from reading to reading lose sinc^2: 3, 12, 26 and 43 %, and inertias would be as much too small.

    A cubic spline loses 28 % of what turns at two fifths of the rate of readings, where a low-pass for the grid ends.
    """
    dt, rows, y = 0.02, 300, PELICAN.rotor_positions[:, 1]
    phase = 2.0 * np.pi * share * np.arange(rows)
    speed = 500.0 + 10.0 * np.sin(phase)[:, None] * np.sign(y)
    track = from_window(Window(0.0, dt, speed, gyro=np.zeros((rows, 3)), sampling="smooth"), PELICAN)
    roll = k.moments(track, 0.0, 0.0, 0.0, 0.0)[:-1, [2, 2 + k.MOMENTS]].mean(axis=1)
    exact = 1e4 * np.abs(y).sum() * -np.diff(np.cos(phase)) / (2.0 * np.pi * share)
    gain = roll[20:-20] @ exact[20:-20] / (exact[20:-20] @ exact[20:-20])
    assert gain == pytest.approx(1.0, abs=lost)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_gap_in_readings_is_a_straight_line(smooth: bool) -> None:
    t = np.concatenate([0.02 * np.arange(50), 2.0 + 0.02 * np.arange(50)])
    speed = np.column_stack([400.0 + 100.0 * np.sin(20.0 * t)] * 4)
    at, (value, _) = _curved(t, speed, smooth)[0], np.moveaxis(_curved(t, speed, smooth)[1], -1, 0)
    inside = (at >= t[49]) & (at <= t[50])
    np.testing.assert_allclose(value[inside, 0], np.interp(at[inside], t, speed[:, 0]))


def flown(seed: int = 1, seconds: float = 12.0) -> tuple[k.Track, FloatArray]:
    truth = draw_truth(PELICAN, seed)
    p = np.zeros(k.N_PHYSICS)
    p[:6] = list(truth.as_dict().values())
    flight = fly(PELICAN, truth, seconds, seed, extras=("velocity",))
    return from_window(flight.window, PELICAN), p


@pytest.mark.parametrize("still", [0.0, 3.0])
def test_score_is_the_slope_of_the_likelihood(still: float) -> None:
    track, p = flown()
    if still > 0.0:  # nobody measures the velocity
        track.seen[:, 3] = False
        track = track._replace(still=still)
    p[k.DRAG] = p[k.DRAG + 1] = 0.3
    _, gains = k.kalman(track, p, NOISE)
    score = k.backward(track, p, NOISE, gains, False)[0] * NOISE
    for i in range(k.N_NOISE):
        by = np.zeros(k.N_NOISE)
        by[i] = 1e-4 * NOISE[i]
        up, down = (k.kalman(track, p, NOISE + s * by)[0] for s in (1.0, -1.0))
        assert score[i] == pytest.approx((up - down) / 2e-4, rel=2e-2, abs=0.3), i


def test_what_noise_of_rotor_speeds_explains_is_the_slope_of_the_variances() -> None:
    """The sum of G' N G Q is the derivative of sum ln S by ln Q."""
    track, p = flown()
    borrowed = k.backward(track, p, NOISE, k.kalman(track, p, NOISE)[1], False)[3]

    def heights(speed: float) -> float:
        psi = NOISE.copy()
        psi[k.ROTOR] = speed
        S = k.kalman(track, p, psi)[1].S
        return float(np.sum(np.log(S[S > 0.0])))

    up, down = (heights(NOISE[k.ROTOR] * np.exp(step)) for step in (1e-4, -1e-4))
    assert np.all(borrowed > 0.0)
    assert borrowed.sum() == pytest.approx((up - down) / 4e-4, rel=1e-3)


def test_random_forces_of_size_zero_change_nothing() -> None:
    track, p = flown()
    still, other = NOISE.copy(), NOISE.copy()
    still[k.SIGMA : k.SIGMA + 4] = other[k.SIGMA : k.SIGMA + 4] = 0.0
    other[k.TIME : k.TIME + 4] *= 3.0
    value, gains = k.kalman(track, p, still)
    assert value == k.kalman(track, p, other)[0]
    assert not gains.mean[:, k.FO + 1 : k.AE + 1].any()
    _, force, spread, *_ = k.backward(track, p, still, gains, True)
    assert not force[:, :6].any()
    assert not spread[:, :6].any()


def test_a_replay_of_the_same_physics_gives_the_same_innovations() -> None:
    track, p = flown()
    track = track._replace(weight=np.random.default_rng(0).uniform(0.1, 1.0, (len(track.t), k.M)))
    _, g = k.kalman(track, p, NOISE)
    out = np.zeros((len(track.t), k.M))
    k.replay(track, p, NOISE, g, g.table, out)
    seen = g.S > 0.0
    np.testing.assert_allclose(out[seen], (g.nu / np.sqrt(np.where(seen, g.S, 1.0)))[seen], atol=1e-9)


def test_rotors_that_stand_still_have_no_drag() -> None:
    """The yaw moment of drag divides by their mean speed."""
    flight = fly(PELICAN, seconds=2.0, seed=1, extras=("velocity",))
    speed = np.zeros_like(flight.window.rotor_speed)
    p = physics()
    p[k.DRAG] = p[k.DRAG + 1] = 0.3
    value, gains = k.kalman(from_window(replace(flight.window, rotor_speed=speed), PELICAN), p, NOISE)
    assert np.isfinite(value)
    assert np.isfinite(gains.mean).all()


EFFECTS = {
    "rotor_drag": {"k_x": 0.3, "k_y": 0.4},
    "cg_offset": {"x": 0.004, "y": -0.003},
    "rate_damping": {"l_p": 0.5, "m_q": 0.8, "n_r": 0.2},
}
MORE = {
    **EFFECTS,
    "rotor_drag": {"k_x": 0.3, "k_y": 0.4, "central": 1.0},
    "motor_lag": {"tau": 0.03},
    "weak_rotor": {"rotor": 2.0, "loss": 0.02},
    "parasitic_drag": {"c": 0.05},
    "gyro_scale": {"x": 0.02, "y": 0.0, "z": -0.03},
    "imu_lever_arm": {"x": 0.05},
}


def blind(flight: Flight, vehicle: Vehicle) -> k.Track:
    """The flight without measurements after the first."""
    track = from_window(flight.window, vehicle)
    seen = np.zeros_like(track.seen)
    seen[0, 3] = True
    return track._replace(seen=seen)


def still(p: FloatArray, track: k.Track) -> k.Gains:
    """A filter pass without random forces."""
    noise = NOISE.copy()
    noise[k.SIGMA : k.TIME] = 0.0
    gains: k.Gains = k.kalman(track, p, noise)[1]
    return gains


def test_motion_is_the_simulations() -> None:
    """The means move as `quadid.model` says, the filter's own effects included."""
    vehicle = PELICAN.model_copy(update={"effects": EFFECTS})
    flight = fly(vehicle, seconds=4.0, seed=2)
    wanted = simulate(vehicle, np.asarray(flight.window.rotor_speed), flight.window.dt)
    p = physics()
    p[:6] = vehicle.initial
    p[k.DRAG : k.DRAG + 2], p[k.CG : k.CG + 2] = (0.3, 0.4), (0.004, -0.003)
    p[k.DAMP : k.DAMP + 3] = 0.5, 0.8, 0.2
    mean = still(p, blind(flight, vehicle)).mean
    # A second without feedback: drag at the hubs is linear in the rotors' squares here, a mean over the step there.
    np.testing.assert_allclose(mean[1:50, 4:7], wanted.rate[:49], atol=3e-3)
    np.testing.assert_allclose(mean[1:50, k.VE + 1 : k.VE + 4], wanted.velocity[:49], atol=3e-3)


def test_an_imu_beside_the_centre_of_gravity_reads_what_the_flown_one_does() -> None:
    """It is fixed to the frame, so a vehicle that turns about a centre of gravity beside it accelerates it."""
    truth, shift = draw_truth(PELICAN, 2), {"x": 0.02, "y": -0.03}
    window = fly(PELICAN, truth, 8.0, 2, effects={"cg_offset": shift}, noise_scale=0.0).window
    p = np.zeros(k.N_PHYSICS)
    p[:6], p[k.CG : k.CG + 2] = list(truth.as_dict().values()), tuple(shift.values())
    read = still(p, from_window(window, PELICAN)).nu[5:-1, k.ACCEL : k.VELOCITY]
    assert np.sqrt(np.mean(read**2, axis=0)).max() < 5e-4


def test_a_lag_is_one_of_rotor_speeds() -> None:
    """Not of their squares, of which the mean behind a lag is more where commands jump."""
    vehicle = PELICAN.model_copy(update={"effects": {"motor_lag": {"tau": 0.06}}})
    flight = fly(vehicle, seconds=4.0, seed=2)
    speed = (
        np.asarray(flight.window.rotor_speed)
        * (1.0 + 0.2 * np.resize([1.0, 1.0, -1.0, -1.0], len(flight.window)))[:, None]
    )
    wanted = simulate(vehicle, speed, flight.window.dt)
    p = physics()
    p[:6], p[k.LAG] = vehicle.initial, 0.06
    jumpy = replace(flight, window=replace(flight.window, rotor_speed=speed))
    mean = still(p, blind(jumpy, vehicle)).mean
    np.testing.assert_allclose(mean[1:50, k.VE + 1 : k.VE + 4], wanted.velocity[:49], atol=3e-3)
    np.testing.assert_allclose(mean[1:50, 4:7], wanted.rate[:49], atol=3e-3)


def test_any_other_model_moves_the_means_as_it_says() -> None:
    vehicle = PELICAN.model_copy(update={"effects": MORE})
    flight = fly(vehicle, seconds=4.0, seed=2)
    speed, dt = np.asarray(flight.window.rotor_speed), flight.window.dt
    wanted = simulate(vehicle, speed, dt)
    p = physics()
    p[:6] = vehicle.initial
    p[k.DRAG : k.DRAG + 2], p[k.CG : k.CG + 2] = (0.3, 0.4), (0.004, -0.003)
    p[k.DAMP : k.DAMP + 3] = 0.5, 0.8, 0.2
    p[k.CENTRAL] = 1.0
    own = PLACES.keys() - {"motor_lag.tau"}
    whole, theta = WholeModel(flight.window, vehicle, own), Layout(vehicle).initial(vehicle)
    track = blind(flight, vehicle)
    for _ in range(3):
        track = track._replace(beyond=whole.along(theta, still(p, track).mean))
    mean = still(p, track).mean[1:41]
    np.testing.assert_allclose(mean[:, k.VE + 1 : k.VE + 4], wanted.velocity[:40], atol=3e-3)
    sensed = mean[:, 4:7] + track.beyond.added[1:41, 9:12]
    np.testing.assert_allclose(sensed, wanted.rate[:40], atol=3e-3)


INTERRUPTED = """
import signal
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_window
from quadid.flight import fly
from quadid.vehicle import Vehicle

vehicle = Vehicle.shipped("pelican")
problem = Problem.of([from_window(fly(vehicle, seconds=60.0, seed=1).window, vehicle)], vehicle)
z, psi = problem.start(), problem.first_noise()
problem.passes(z, psi)
signal.signal(signal.SIGALRM, signal.default_int_handler)
for i in range(8):
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.03 + 0.004 * i)
        while True:
            problem.passes(z, psi)
    except KeyboardInterrupt:
        print("stopped")
"""


def test_an_interrupt_during_a_pass_is_an_exception_and_no_crash() -> None:
    ended = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout.split()) == (0, 8 * ["stopped"]), ended.stderr[-2000:]


def struck() -> tuple[k.Track, FloatArray]:
    """A flight whose accelerometer is struck now and then."""
    track, p = flown()
    y = track.y.copy()
    y[::37, 7:10] += 2.0
    return track._replace(y=y), p


def test_the_score_is_the_slope_of_the_likelihood_with_weights() -> None:
    track, p = struck()
    track = track._replace(weight=np.random.default_rng(0).uniform(0.1, 1.0, (len(track.t), k.M)))
    score = k.backward(track, p, NOISE, k.kalman(track, p, NOISE)[1], False)[0]
    for i in (k.GYRO, k.ACCEL, k.ACCEL + 2, k.SIGMA, k.SIGMA + 1, k.SIGMA + 2, k.TIME):
        by = 1e-4 * NOISE[i] * (np.arange(k.N_NOISE) == i)
        up, down = (k.kalman(track, p, NOISE + s * by)[0] for s in (1.0, -1.0))
        assert score[i] * NOISE[i] == pytest.approx((up - down) / 2e-4, rel=2e-2, abs=0.3), i


@pytest.mark.parametrize("free", [False, True])
def test_renewed_weights_lower_the_objective(free: bool) -> None:
    """The price of weights and the likelihood fall together until they stay, and struck readings alone lose weight.

    Where the noise of readings is free, it has no factor in common with them.
    """
    track, p = struck()
    problem = replace(Problem.of([track], PELICAN), tail=np.array([0.2, 0.2, 0.2, 0.2]))
    z, held, psi = problem.at(p[:6]), problem, NOISE
    gains = [k.kalman(track, p, NOISE)[1]]
    values = [np.inf]
    for _ in range(12):
        held, psi = held.reweighted(z, psi, gains, np.full(k.N_NOISE, free))
        value, gains = held.passes(z, psi)
        assert value <= values[-1] + 1e-6
        values.append(value)
    assert values[1] - values[-1] > 10.0
    assert values[-1] <= problem.objective(z, psi)
    if not free:
        assert values[-2] - values[-1] < 0.5
    else:
        np.testing.assert_allclose(gains[0].w[:, k.ACCEL : k.VELOCITY].mean(axis=0), 1.0)
    accel = gains[0].w[:, k.ACCEL : k.VELOCITY]
    assert accel[::37].max() < 0.2
    assert np.median(accel) > 0.9
