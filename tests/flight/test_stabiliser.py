"""The stabiliser and the pilot: the step replays the log, gains travel, sticks excite every axis."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadid.attitude_controller import GAIN_NAMES, pack_gains, stabilise_rows
from quadid.errors import ParameterError
from quadid.flight import PROFILES, Flight, Segment, TruthParameters, default_gains, draw_truth, fly
from quadid.flight.pilot import scripted, stick_profile
from quadid.types import FloatArray
from quadid.vehicle import Stabiliser, Vehicle, mixer_matrix

# --- The stabiliser: its pure step replays the log, gains travel through the vehicle file, the mixer inverts geometry


NAMES = ["pelican", "pelican_x", "hexacopter", "hummingbird", "crazyflie_brushless"]


def steps(
    gains: Mapping[str, float],
    mixer: FloatArray,
    reference: FloatArray,
    attitude: FloatArray,
    rate: FloatArray,
    integral: FloatArray,
    dt: float,
) -> FloatArray:
    """Rotor speeds (n, rotors) of n steps in a row from integral torques (3,)."""
    command = np.empty((len(reference), len(mixer)))
    after = np.array(integral[None], dtype=np.float64)
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


# --- The pilot's sticks: seeds, which axes move, manoeuvre segments; excitation like that of independent flights


PELICAN = Vehicle.shipped("pelican")


def movement(flight: Flight) -> dict[str, FloatArray]:
    """Movement of a flight: rms of rates, tilt angles, relative thrust."""
    q = flight.truth.quaternion
    angles = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_euler("ZYX")[:, :0:-1]
    squares = (flight.window.rotor_speed**2).sum(axis=1)
    return {
        "rates": flight.truth.rates.std(axis=0),
        "tilt": angles.std(axis=0),
        "thrust": np.array([squares.std() / squares.mean()]),
    }


@pytest.mark.parametrize("profile", list(PROFILES))
def test_sticks_are_decided_by_the_seed(profile: str) -> None:
    a, b, c = (stick_profile(profile, seed, 3000) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert profile == "hover" or not np.array_equal(a, c)
    if profile != "one_axis":
        np.testing.assert_array_equal(stick_profile(profile, 1, 5000)[:3000], a)
    with pytest.raises(ParameterError, match="excited"):
        stick_profile("exited", 1, 100)


def test_excited_moves_like_the_independent_flights(data_dir: Path) -> None:
    """Rates, tilt and thrust of `excited` within the range of flights simulated by somebody else."""
    others = []
    for file in sorted((data_dir / "cases").glob("*/train.csv")):
        names = file.open().readline().strip().split(",")
        table = dict(zip(names, np.loadtxt(file, delimiter=",", skiprows=1, unpack=True), strict=True))
        squares = np.sum([table[f"w{i}"] ** 2 for i in range(1, 5)], axis=0)
        others.append([table[c].std() for c in ("p", "q", "r", "phi", "theta")] + [squares.std() / squares.mean()])
    ours = []
    for seed in range(6):
        m = movement(fly(PELICAN, draw_truth(PELICAN, seed), 100.0, seed))
        ours.append(np.concatenate([m["rates"], m["tilt"], m["thrust"]]))
    ratio = np.mean(ours, axis=0) / np.mean(others, axis=0)
    assert np.all((ratio > 0.75) & (ratio < 1.35)), ratio


def test_gentle_and_hover_hardly_move() -> None:
    excited, gentle, hover = (movement(fly(PELICAN, None, 60.0, 1, p)) for p in ("excited", "gentle", "hover"))
    assert gentle["rates"].max() < 0.15 * excited["rates"].max()
    assert hover["rates"].max() < gentle["rates"].max() < 0.07
    assert hover["tilt"].max() < 0.01


def test_one_axis_at_a_time() -> None:
    flight = fly(PELICAN, None, 90.0, 1, "one_axis")
    for part in range(3):
        rms = flight.truth.rates[part * 1500 + 200 : (part + 1) * 1500].std(axis=0)
        assert rms.argmax() == part
        assert np.sort(rms)[1] < 0.25 * rms.max()


def test_roll_and_pitch_without_yaw() -> None:
    rms = fly(PELICAN, None, 60.0, 1, "roll_pitch").truth.rates.std(axis=0)
    assert rms[:2].min() > 0.25
    assert rms[2] < 0.1


def test_segments() -> None:
    base = {"start": 1.0, "duration": 2.0, "amplitude": 0.2}
    shapes = {
        kind: scripted([Segment("pitch", kind, **base)], 1, 400)[:, 1]
        for kind in ("step", "pulse", "doublet", "3211", "sine", "chirp", "multisine", "noise")
    }
    for kind, sticks in shapes.items():
        assert np.all(sticks[:50] == 0.0), kind
        assert np.all(sticks[150:] == 0.0), kind
        assert 0.05 < np.abs(sticks[50:150]).max() <= 0.8, kind
    np.testing.assert_array_equal(shapes["doublet"][50:150], np.repeat([0.2, -0.2], 50))
    assert shapes["3211"][50:150].sum() == pytest.approx(0.2 * 100 / 7, abs=0.5)
    assert shapes["multisine"][50:150].std() == pytest.approx(0.2, rel=0.1)


def test_a_scripted_doublet_rolls_the_vehicle() -> None:
    script = [Segment("roll", "doublet", 5.0, 1.0, 0.25), Segment("yaw", "step", 8.0, 4.0, 0.5)]
    flight = fly(PELICAN, None, 12.0, 1, "scripted", segments=script)
    t, rates = flight.truth.t, flight.truth.rates
    before, during = t < 4.9, (t >= 5.0) & (t < 6.5)
    assert np.abs(rates[before]).max() < 0.15
    assert rates[during, 0].max() > 0.5
    assert rates[during, 0].min() < -0.9
    assert np.abs(rates[during, 1]).max() < 0.2
    turned = Rotation.from_quat(flight.truth.quaternion[-1, [1, 2, 3, 0]]).as_euler("ZYX")[0]
    assert turned == pytest.approx(0.5, abs=0.1)


def test_manoeuvre_entries_are_checked() -> None:
    good = {"axis": "roll", "kind": "sine", "start": 0, "duration": 5, "amplitude": 0.1}
    assert Segment.from_mapping(good).frequency == 0.5
    for change, match in (
        ({"axis": "rol"}, "roll"),
        ({"kind": "sin"}, "sine"),
        ({"amplitude": 2.0}, "at most 0.6"),
        ({"duration": -1.0}, "duration > 0"),
        ({"frequency": 40.0}, "25 Hz"),
        ({"amplitud": 0.1}, "amplitude"),
        ({"start": "soon"}, "finite number"),
    ):
        with pytest.raises(ParameterError, match=match):
            Segment.from_mapping({**good, **change})
    with pytest.raises(ParameterError, match="lacks duration"):
        Segment.from_mapping({k: v for k, v in good.items() if k != "duration"})
    with pytest.raises(ParameterError, match="segments"):
        fly(PELICAN, None, 5.0, 1, "scripted")
