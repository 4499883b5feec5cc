"""Gyros and attitudes that were filtered or come late are named by kinematics alone, with the error of estimates."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log
from scipy.signal import butter, filtfilt, lfilter
from scipy.spatial.transform import Rotation

import quadid
from quadid.checks import Check, CheckResult, inspect
from quadid.checks.frames import gyro_check, response
from quadid.checks.motion import Log
from quadid.data.window import Channel, Recording, sample_period
from quadid.rotation import product
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

Flight = tuple[Recording, Vehicle]
FLIGHTS = {
    "pelican": None,
    "cases": "cases/case_001/train.csv",
    "hexacopter": "findings/vehicles/2_hexa_wrong_logs/clean.csv",
    "figure8": "crazyflie_rpm/figure8_27.csv",
    "brushed": "brushed/jana00.csv",
}


@pytest.fixture(scope="module", params=FLIGHTS)
def flight(request: pytest.FixtureRequest) -> Flight:
    """A flight of our simulator, of two others, and two recorded ones."""
    place = FLIGHTS[request.param]
    if place is None:
        made = quadid.simulate(seconds=60.0, seed=3, extras=("velocity", "position"))
        return made.flight.recording, Vehicle.shipped("pelican")
    path: Path = request.getfixturevalue("data_dir") / place
    return open_log(path), Vehicle.named(path.parent / "vehicle.yaml")


def sources(
    flight: Flight, name: str, change: Callable[[Channel], FloatArray], **effects: dict[str, float]
) -> list[Check]:
    """Check of the source of gyro and attitude once a channel was changed."""
    recording, vehicle = flight
    channel = recording.channels[name]
    changed = {**recording.channels, name: replace(channel, values=np.asarray(change(channel)))}
    known = vehicle.model_copy(update={"effects": {**vehicle.effects, **effects}})
    return [c for c in inspect(replace(recording, channels=changed), known).checks if c.name == "gyro_source"]


def late(seconds: float) -> Callable[[Channel], FloatArray]:
    return lambda c: np.column_stack([np.interp(c.t - seconds, c.t, x) for x in c.values.T])


def low_passed(cutoff: float, order: int = 2) -> Callable[[Channel], FloatArray]:
    return lambda c: np.asarray(lfilter(*butter(order, cutoff, fs=1.0 / sample_period(c.t)), c.values, axis=0))


def test_a_gyro_as_it_came_has_nothing_said_of_it(flight: Flight) -> None:
    assert sources(flight, "gyro", lambda c: c.values) == []


@pytest.mark.parametrize(("cutoff", "order"), [(4.0, 2), (8.0, 2), (12.0, 2), (6.0, 1)])
def test_a_low_pass_of_the_gyro_is_named_with_its_delay_and_what_it_does(
    flight: Flight, cutoff: float, order: int
) -> None:
    """At 12 Hz it was named by no check, and by others without a word of how far estimates are off."""
    (check, *_) = sources(flight, "gyro", low_passed(cutoff, order))
    analog = (math.sqrt(2.0) if order == 2 else 1.0) / (2.0 * math.pi * cutoff)
    assert check.verdict is CheckResult.WARNING
    assert "imu_lag" in check.fix
    assert check.numbers["late_s"] == pytest.approx(analog, abs=0.007)  # a filter of sampled rates is not quite as late
    assert {"J_xx", "J_yy", "J_zz", "d"} <= set(check.off)
    assert 0.0 <= check.off["J_xx"] < 1.0


def test_a_slow_low_pass_is_no_scale_of_the_gyro(flight: Flight) -> None:
    """The advice was to multiply the gyro by 1.09."""
    recording, vehicle = flight
    gyro = recording.channels["gyro"]
    changed = {**recording.channels, "gyro": replace(gyro, values=low_passed(3.0, 1)(gyro))}
    (check,) = (c for c in inspect(replace(recording, channels=changed), vehicle).checks if c.name == "gyro_attitude")
    assert "multiply" not in check.fix


@pytest.mark.parametrize("jumps", [(5.0,), (20.0,), (90.0,), (30.0, 60.0, -90.0)])
def test_headings_that_are_reset_in_flight_say_nothing_of_the_gyro(flight: Flight, jumps: tuple[float, ...]) -> None:
    """Jumps that are no faster than the motion once made "multiply the gyro", or "does not follow about z"."""
    recording, vehicle = flight
    attitude = recording.channels["attitude"]
    q = attitude.values.copy()
    for k, half in enumerate(0.5 * np.radians(jumps)):
        later = slice(len(q) * (k + 1) // (len(jumps) + 1), None)
        turn = np.broadcast_to([math.cos(half), 0.0, 0.0, math.sin(half)], q[later].shape)
        q[later] = product(turn, q[later])
    changed = {**recording.channels, "attitude": replace(attitude, values=q)}
    said, right = (
        [c.verdict for c in inspect(log, vehicle).checks if c.name == "gyro_attitude"]
        for log in (replace(recording, channels=changed), recording)
    )
    assert said == right


def test_smoothing_without_a_delay_is_told_from_one_with(flight: Flight) -> None:
    def smooth(c: Channel) -> FloatArray:
        return np.asarray(filtfilt(*butter(2, 4.0, fs=1.0 / sample_period(c.t)), c.values, axis=0))

    check = sources(flight, "gyro", smooth)[0]
    assert "smoothed without a delay" in check.message
    assert check.off["J_xx"] > 0.02


@pytest.mark.parametrize("seconds", [0.03, 0.05, 0.07])
def test_an_attitude_that_comes_late_is_no_gyro_that_was_filtered(flight: Flight, seconds: float) -> None:
    (check,) = sources(flight, "attitude", late(seconds))
    assert "attitude comes" in check.message
    assert check.numbers["late_s"] == pytest.approx(-seconds, abs=0.009)
    assert check.off == {}
    assert sources(flight, "attitude", late(seconds), attitude_delay={"delay": seconds}) == []


def test_a_filter_that_the_vehicle_file_has_is_not_named(flight: Flight) -> None:
    assert sources(flight, "gyro", low_passed(8.0), imu_lag={"cutoff": 8.0}) == []


def test_late_and_early_are_measured_to_milliseconds(flight: Flight) -> None:
    recording, _ = flight
    gyro = recording.channels["gyro"]
    own = response(Log(recording))
    for seconds in (-0.11, -0.04, 0.02, 0.16):
        channels = {**recording.channels, "gyro": replace(gyro, values=late(seconds)(gyro))}
        moved = response(Log(replace(recording, channels=channels)))
        assert own is not None
        assert moved is not None
        assert moved.late - own.late == pytest.approx(seconds, abs=0.004)


def test_attitude_of_which_only_noise_is_left_tells_nothing() -> None:
    """A heading that drifts in hover goes with the gyro's noise by chance."""
    hover = quadid.simulate("pelican_x", seconds=40.0, seed=3, profile="hover", rate=100.0).flight.recording
    assert response(Log(hover)) is None


# --- Rates of angles, or the end of a swing


def hover_after_swing(seed: int) -> Recording:
    """Ten seconds of hover at whose beginning a swing of all axes dies away; the gyro has a low-pass and a bias."""
    rng, step = np.random.default_rng(seed), 0.0025
    t, angles = np.arange(0.0, 12.0, step), np.zeros((4800, 3))
    for axis, size in enumerate((0.2, 0.2, 0.5)):
        omega, damping = rng.uniform(2.0, 5.0), rng.uniform(0.5, 1.0)
        swing = np.cos(omega * math.sqrt(max(1.0 - damping**2, 0.01)) * t + rng.uniform(0.0, 6.0))
        angles[:, axis] = size * rng.normal() * np.exp(-damping * omega * t) * swing
    body = Rotation.from_euler("ZYX", angles[:, ::-1])
    rates = (body[:-1].inv() * body[1:]).as_rotvec() / step
    bias, noise = rng.normal(0.0, 0.002, 3), rng.normal(0.0, 0.0003, rates.shape)
    gyro = lfilter(*butter(2, 20.0, fs=1.0 / step), rates, axis=0) + bias + noise
    first = int(rng.uniform(0.0, 1.5) / step)
    rows = np.arange(first, first + 4000, 8)
    attitude = Channel("attitude", t[rows], body.as_quat()[rows][:, [3, 0, 1, 2]])
    return Recording("hover", "csv", {"gyro": Channel("gyro", t[rows], gyro[rows]), "attitude": attitude})


@pytest.mark.parametrize("seed", [64, 168, 198, 211, 302, 335])
def test_a_swing_that_dies_away_makes_no_rates_of_angles_of_a_gyro(seed: int) -> None:
    """A live flight was blocked so in the first hover after its sticks: one swing looks much like another."""
    assert "Euler" not in gyro_check(Log(hover_after_swing(seed))).message


@pytest.mark.parametrize("name", ["x.bin", "quad_sq.bin"])
def test_rates_of_angles_in_a_flight_are_named_as_before(name: str, data_dir: Path) -> None:
    flight = open_log(data_dir / "ardupilot_sitl" / name)
    attitude = flight.channels["attitude"]
    rows = slice(80 * 400, 100 * 400, 8)
    angles = np.unwrap(Rotation.from_quat(attitude.values[:, [1, 2, 3, 0]]).as_euler("ZYX")[:, ::-1], axis=0)
    rates = np.gradient(angles, attitude.t, axis=0)
    t = attitude.t[rows]
    told = {"gyro": Channel("gyro", t, rates[rows]), "attitude": replace(attitude, t=t, values=attitude.values[rows])}
    assert "Euler" in gyro_check(Log(replace(flight, channels=told))).message
