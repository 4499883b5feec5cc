"""The flown truth against a second set of equations integrated by SciPy's DOP853 at tight tolerance."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.flight import Flight, TruthParameters, draw_truth, fly
from quadid.vehicle import Vehicle
from tests.flight.second_opinion import SecondOpinion

EVERYTHING = {
    "motor_lag": {"tau": 0.031, "tau_down": 0.044},
    "command_delay": {"delay": 0.0137},
    "rotor_drag": {"k_x": 0.3, "k_y": 0.2, "central": 0.4},
    "parasitic_drag": {"c": 0.03, "c_z": 0.05},
    "translational_lift": {"k": 0.01},
    "rotor_drag_moment": {"h_x": 0.03, "h_y": -0.02},
    "rate_damping": {"l_p": 0.8, "m_q": 1.3, "n_r": 0.4},
    "axial_inflow": {"k_z": 0.3, "k_climb": 0.03, "central": 0.7},
    "wind": {"north": 2.0, "east": -1.5},
    "weak_rotor": {"rotor": 2.0, "loss": 0.08, "drag_loss": -0.05},
    "cg_offset": {"x": 0.006, "y": -0.004},
    "mass_change": {"time": 3.4567, "fraction": 0.15, "J_xx": 0.2, "J_yy": 0.1, "J_zz": 0.05, "x": 0.003, "y": -0.002},
    "drag_torque_curve": {"growth": 0.7},
    "no_gyroscopic_coupling": {"share": 0.6},
    "thrust_drop": {"time": 3.7321, "fraction": 0.06},
    "battery_sag": {"fraction": 0.1},
    "thrust_curve": {"dead_speed": 30.0, "offset": 0.1},
    "product_of_inertia": {"J_xy": 1e-3, "J_xz": -8e-4, "J_yz": 6e-4},
    "rotor_spin_up": {"J": 5e-5},
    "imu_lever_arm": {"x": 0.05, "y": -0.03, "z": 0.02},
}


def noise_free(name: str, effects: dict[str, dict[str, float]], seconds: float = 8.0, seed: int = 3) -> Flight:
    """A flight without noise of an individual of the type."""
    vehicle = Vehicle.shipped(name)
    return fly(vehicle, draw_truth(vehicle, seed), seconds, seed, effects=effects, noise_scale=0.0)


def check_states(flight: Flight, first: int, last: int) -> None:
    """Compares the truth at row `last` with DOP853 from row `first`."""
    opinion = SecondOpinion(flight)
    dt, truth = flight.window.dt, flight.truth
    state = opinion.fly(opinion.start(first), first * dt, last * dt)
    np.testing.assert_allclose(truth.position[last], state[0:3], rtol=0, atol=2e-8)
    np.testing.assert_allclose(truth.velocity[last], state[3:6], rtol=0, atol=2e-8)
    np.testing.assert_allclose(truth.rates[last], state[10:13], rtol=0, atol=2e-8)
    q = np.array([state[9], *state[6:9]])
    assert abs(abs(q @ truth.quaternion[last]) / np.linalg.norm(q) - 1.0) < 1e-14


@pytest.mark.parametrize("name", ["pelican", "pelican_x", "hexacopter", "hummingbird"])
def test_nominal_truth(name: str) -> None:
    check_states(noise_free(name, {}), 100, 130)


def test_everything_at_once() -> None:
    flight = noise_free("pelican", EVERYTHING)
    check_states(flight, 40, 60)
    check_states(flight, 165, 195)  # across both changes


def test_rotor_spin_up_of_jumping_rotors() -> None:
    check_states(noise_free("pelican", {"rotor_spin_up": {"J": 7e-5}, "product_of_inertia": {"J_xz": 1e-3}}), 50, 100)


def test_ground_effect() -> None:
    check_states(noise_free("pelican", {"ground_effect": {"radius_scale": 2.0}}), 50, 100)


@pytest.mark.parametrize("effects", [{}, EVERYTHING, {"rotor_spin_up": {"J": 7e-5}, "imu_lever_arm": {"y": 0.06}}])
def test_acceleration_is_the_mean_over_one_sample_centred_on_t(effects: dict[str, dict[str, float]]) -> None:
    flight = noise_free("pelican", effects)
    opinion, dt = SecondOpinion(flight), flight.window.dt
    assert flight.window.accel is not None
    for row in (60, 61, 200):
        begin = opinion.fly(opinion.start(row - 1), (row - 1) * dt, (row - 0.5) * dt)
        begin[-3:] = 0.0
        end = opinion.fly(begin, (row - 0.5) * dt, (row + 0.5) * dt)
        np.testing.assert_allclose(flight.window.accel[row], end[-3:] / dt, rtol=0, atol=1e-7)


def test_held_command_of_row_k_acts_from_t_k() -> None:
    """Thrust of the log's own row explains the specific force between rows, half each at a row."""
    flight = noise_free("pelican", {})
    w, p = flight.window, TruthParameters.of(flight.vehicle)
    p = flight.truth.parameters
    assert w.accel is not None
    pull = -p.b * (w.rotor_speed**2).sum(axis=1) / p.mass
    np.testing.assert_allclose(w.accel[1:, 2], 0.5 * (pull[1:] + pull[:-1]), rtol=1e-9)


def test_instant_readings_are_linear_in_between() -> None:
    """The Crazyflie's log holds readings: rotor speed runs straight from one to the next."""
    flight = noise_free("crazyflie_brushless", {})
    w, p = flight.window, flight.truth.parameters
    assert w.sampling == "instant"
    assert w.accel is not None
    np.testing.assert_allclose(w.rotor_speed, flight.truth.rotor_speed, rtol=1e-12)
    s = np.linspace(-0.5, 0.5, 2001)[:, None, None]
    before, here, after = w.rotor_speed[:-2], w.rotor_speed[1:-1], w.rotor_speed[2:]
    path = np.where(s < 0, here + (here - before) * s, here + (after - here) * s)
    thrust = np.trapezoid((path**2).sum(axis=2), s[:, 0, 0], axis=0)
    np.testing.assert_allclose(w.accel[1:-1, 2], -p.b * thrust / p.mass, rtol=1e-6)


def test_command_faster_than_the_log() -> None:
    """With commands at 1 kHz the log holds their mean over the sample."""
    vehicle = Vehicle.shipped("pelican")
    fast = fly(vehicle, seconds=4.0, seed=1, noise_scale=0.0, command_rate=1000.0)
    fine = fly(vehicle, seconds=4.0, seed=1, noise_scale=0.0, command_rate=1000.0, log_rate=500.0)
    np.testing.assert_allclose(
        fast.window.rotor_speed, fine.window.rotor_speed.reshape(200, 10, 4).mean(axis=1), rtol=1e-6
    )
