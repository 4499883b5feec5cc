"""The stabiliser: its pure step replays the log, gains travel through the vehicle file, the mixer inverts geometry."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadid.attitude_controller import GAIN_NAMES, mixer_matrix, pack_gains, stabilise_rows
from quadid.errors import ParameterError
from quadid.flight import TruthParameters, default_gains, fly
from quadid.types import FloatArray
from quadid.vehicle import Stabiliser, Vehicle

NAMES = ["pelican", "pelican_x", "hexacopter", "hummingbird", "crazyflie_brushless"]


def steps(
    gains: Mapping[str, float], mixer: FloatArray, reference: FloatArray, attitude: FloatArray, rate: FloatArray,
    integral: FloatArray, dt: float,
) -> FloatArray:  # fmt: skip
    """Rotor speeds (n, rotors) of n steps in a row from integral torques (3,)."""
    command = np.empty((len(reference), len(mixer)))
    after = np.array(integral, dtype=np.float64)
    stabilise_rows(pack_gains(gains), mixer, reference, attitude, rate, np.full(len(reference), dt), after, command)
    return command


@pytest.mark.parametrize("name", NAMES)
def test_mixer_inverts_the_geometry(name: str) -> None:
    vehicle = Vehicle.shipped(name)
    gains = default_gains(vehicle)
    b, d = gains["thrust_coefficient"], gains["drag_coefficient"]
    at = vehicle.rotor_positions
    forward = np.vstack([np.full(len(at), b), -b * at[:, 1], b * at[:, 0], d * vehicle.spins])
    np.testing.assert_allclose(forward @ mixer_matrix(vehicle, gains), np.eye(4), atol=1e-3)


def test_logged_sensors_and_references_give_the_logged_commands() -> None:
    """The stabiliser reads exactly what is logged, so its pure step replays the log, noise and all."""
    flight = fly(Vehicle.shipped("pelican"), seconds=20.0, seed=4)
    w, gains = flight.window, flight.gains
    mixer = mixer_matrix(flight.vehicle, gains)
    assert w.attitude is not None
    assert w.gyro is not None
    b, d = gains["thrust_coefficient"], gains["drag_coefficient"]
    at = flight.vehicle.rotor_positions
    forward = np.vstack([-b * at[:, 1], b * at[:, 0], d * flight.vehicle.spins])
    # the integral torques before the first row: what its command holds beyond the proportional part
    first = steps(gains, mixer, flight.references[:1], w.attitude[:1], w.gyro[:1], np.zeros(3), 0.02)
    integral = forward @ (w.rotor_speed[0] ** 2 - first[0] ** 2)
    commands = steps(gains, mixer, flight.references, w.attitude, w.gyro, integral, w.dt)
    assert np.abs(commands - w.rotor_speed).max() < 1e-6


@pytest.mark.parametrize(("axis", "gain"), [(0, "roll_rate_p"), (1, "pitch_rate_p"), (2, "yaw_rate_p")])
def test_torque_opposes_the_error(axis: int, gain: str) -> None:
    """Tilted by +angle with a level reference, the commanded torque is negative about that axis alone."""
    vehicle = Vehicle.shipped("pelican")
    gains = {**default_gains(vehicle), "roll_rate_i": 0.0, "pitch_rate_i": 0.0, "yaw_rate_i": 0.0}
    turn = np.zeros(3)
    turn[axis] = 0.05
    q = Rotation.from_rotvec(turn).as_quat()[[3, 0, 1, 2]]
    mixer = mixer_matrix(vehicle, gains)
    (command,) = steps(gains, mixer, np.array([[0, 0, 0, 0.3]]), q[None], np.zeros((1, 3)), np.zeros(3), 0.02)
    b, d, at = gains["thrust_coefficient"], gains["drag_coefficient"], vehicle.rotor_positions
    torque = np.vstack([-b * at[:, 1], b * at[:, 0], d * vehicle.spins]) @ command**2
    expected = np.zeros(3)
    expected[axis] = -gains[gain] * gains[["roll_p", "pitch_p", "yaw_p"][axis]] * np.sin(0.05)
    np.testing.assert_allclose(torque, expected, atol=1e-12)


def test_gains_travel_through_the_vehicle_file() -> None:
    vehicle = Vehicle.shipped("pelican")
    gains = {**default_gains(vehicle), "roll_p": 3.7}
    with_gains = vehicle.model_copy(update={"stabiliser": Stabiliser(gains=gains)})
    back = Vehicle.from_yaml(with_gains.to_yaml())
    assert back.stabiliser is not None
    assert back.stabiliser.gains == gains
    assert fly(back, seconds=2.0).gains["roll_p"] == 3.7


def test_wrong_gains_are_named() -> None:
    gains = default_gains(Vehicle.shipped("pelican"))
    assert tuple(gains) == GAIN_NAMES
    with pytest.raises(ParameterError, match="roll_p"):
        pack_gains({**gains, "rol_p": 1.0})
    with pytest.raises(ParameterError, match="yaw_rate_i"):
        pack_gains({k: v for k, v in gains.items() if k != "yaw_rate_i"})


@pytest.mark.parametrize("name", NAMES)
def test_follows_its_references(name: str) -> None:
    """Hover after a flight's worth of sticks: attitude follows the reference within a few degrees rms."""
    flight = fly(Vehicle.shipped(name), seconds=30.0, seed=6)
    q = flight.truth.quaternion
    angles = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_euler("ZYX")[:, ::-1]
    error = angles[:, :2] - flight.references[:, :2]
    assert error.std(axis=0).max() < 0.13
    assert flight.truth.rates.std(axis=0).max() < 0.8


def test_a_normalized_command_has_its_ceiling() -> None:
    data = Vehicle.shipped("pelican").model_dump()
    data["command"] = {"kind": "normalized", "max_speed": 500.0}
    vehicle = Vehicle.model_validate(data)
    flight = fly(vehicle, seconds=5.0)
    assert default_gains(vehicle)["max_speed"] <= 500.0
    command = flight.recording.channels["motor_command"].values
    np.testing.assert_allclose(vehicle.command.to_rotor_speed(command), flight.window.rotor_speed)
    assert command.max() <= 1.0
    data["command"] = {"kind": "pwm", "max_speed": 800.0, "range": (1000.0, 2000.0)}
    pulses = fly(Vehicle.model_validate(data), seconds=5.0).recording.channels["motor_command"].values
    assert 1000.0 < pulses.min() < pulses.max() <= 2000.0
    assert TruthParameters.of(vehicle).b == 2.33e-5
