"""The model in closed loop against the flown vehicle, which shares no equations with it, only the control law."""

import numpy as np
import pytest

from quadid.data.window import Window
from quadid.errors import ParameterError, WindowError
from quadid.flight import Flight, fly
from quadid.model.closed_loop import ClosedLoop, kinematic_acceleration
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import GRAVITY, Vehicle

PELICAN = Vehicle.shipped("pelican")
LAYOUT = Layout(PELICAN)
SETTLED = 500
"""Rows after which the stabiliser's integrals and the rotors have forgotten how the simulation began."""
EFFECTS: list[dict[str, dict[str, float]]] = [
    {},
    {"motor_lag": {"tau": 0.03}, "command_delay": {"delay": 0.013}},
    {"rotor_drag": {"k_x": 0.3, "k_y": 0.2}, "cg_offset": {"x": 0.003, "y": -0.002}},
    {"ahrs_acceleration_error": {"k": 0.1}, "gyro_bias": {"x": 0.01, "y": 0.0, "z": 0.01}},
]


def at_truth(flight: Flight) -> np.ndarray:
    theta = LAYOUT.neutral()
    values = flight.truth.parameters.as_dict()
    theta[: len(NOMINAL_NAMES)] = [values[n] for n in NOMINAL_NAMES]
    LAYOUT.write_effects(theta, {k: dict(v) for k, v in flight.truth.effects.items()})
    return theta


@pytest.mark.parametrize("effects", EFFECTS, ids=lambda e: "+".join(e) or "nominal")
def test_references_alone_reproduce_a_flight_without_noise(effects: dict[str, dict[str, float]]) -> None:
    flight = fly(PELICAN, seconds=20.0, seed=3, noise_scale=0.0, effects=effects)
    w = flight.window
    assert w.gyro is not None
    assert w.attitude is not None
    assert w.accel is not None
    flown = ClosedLoop(w, PELICAN, flight.gains).fly(at_truth(flight)[None])
    assert np.max(np.abs(flown.rates[0] - w.gyro)[SETTLED:]) < 5e-3 * np.max(np.abs(w.gyro))
    turn = 2.0 * np.arccos(np.minimum(np.abs(np.sum(flown.attitude[0] * w.attitude, axis=1)), 1.0))
    assert np.max(turn[SETTLED:]) < np.radians(0.1)
    # In-plane force follows velocity, which starts unknown and is forgotten in a few seconds of drag.
    assert np.max(np.abs(flown.accel[0] - w.accel)[SETTLED:, 2]) < 0.02
    assert np.sqrt(np.mean((flown.accel[0] - w.accel)[SETTLED:] ** 2)) < 0.05


def test_a_faster_stabiliser_than_the_log_is_simulated_at_its_own_rate() -> None:
    flight = fly(PELICAN, seconds=15.0, seed=4, noise_scale=0.0, command_rate=1000.0)
    assert flight.window.gyro is not None
    theta = at_truth(flight)[None]
    errors = []
    for rate in (50.0, 200.0, 1000.0):
        flown = ClosedLoop(flight.window, PELICAN, flight.gains, rate).fly(theta)
        errors.append(np.sqrt(np.mean((flown.rates[0] - flight.window.gyro)[SETTLED:] ** 2)))
    assert errors[0] > 3.0 * errors[1] > 9.0 * errors[2]


def test_lanes_do_not_touch_each_other() -> None:
    flight = fly(PELICAN, seconds=5.0, seed=5)
    loop = ClosedLoop(flight.window, PELICAN, flight.gains)
    thetas = at_truth(flight) * np.linspace(0.9, 1.1, 19)[:, None] ** np.isin(np.arange(LAYOUT.size), range(6))
    together = loop.fly(thetas)
    for i in (0, 7, 18):
        alone = loop.fly(thetas[i : i + 1])
        np.testing.assert_array_equal(together.rates[i], alone.rates[0])
        np.testing.assert_array_equal(together.accel[i], alone.accel[0])


def test_only_ratios_to_the_mixer_matter_for_the_gains() -> None:
    flight = fly(PELICAN, seconds=5.0, seed=6)
    theta = at_truth(flight)[None]
    scaled = dict(flight.gains)
    torques = ("roll_rate_p", "pitch_rate_p", "yaw_rate_p", "roll_rate_i", "pitch_rate_i", "yaw_rate_i")
    for name in (*torques, "yaw_torque_limit", "thrust_coefficient", "drag_coefficient"):
        scaled[name] *= 1.7
    one = ClosedLoop(flight.window, PELICAN, flight.gains).fly(theta)
    two = ClosedLoop(flight.window, PELICAN, scaled).fly(theta)
    np.testing.assert_allclose(one.rates, two.rates, atol=1e-9)


def test_at_rest_gravity_corrected_acceleration_is_zero_whatever_the_tilt() -> None:
    q = np.array([[1.0, 0.2, -0.3, 0.4]])
    q /= np.linalg.norm(q)
    w, v = q[:, 0], q[:, 1:]
    up = np.array([[0.0, 0.0, -GRAVITY]])
    # What an accelerometer at rest reads: the reaction to gravity, in body axes (inverse rotation of q).
    force = up + 2.0 * np.cross(np.cross(up, v), v) + 2.0 * w * np.cross(up, v)
    np.testing.assert_allclose(kinematic_acceleration(force, q), 0.0, atol=1e-12)


def test_what_is_missing_or_impossible_is_refused() -> None:
    flight = fly(PELICAN, seconds=3.0, seed=7)
    w = flight.window
    bare = Window(w.t0, w.dt, w.rotor_speed, gyro=w.gyro, attitude=w.attitude, accel=w.accel)
    with pytest.raises(WindowError, match="references"):
        ClosedLoop(bare, PELICAN, flight.gains)
    with pytest.raises(ParameterError, match="multiple of 50"):
        ClosedLoop(w, PELICAN, flight.gains, 120.0)
