"""Rotor signals that cannot be true are refused by name: dead, stuck, halved, against the thrust, out of time."""

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log
from scipy.signal import butter, filtfilt, lfilter

from quadid import simulate
from quadid.checks import Check, CheckResult, flying_spans, inspect
from quadid.checks.motion import Log
from quadid.checks.rotors import gyro_filter_check
from quadid.data.rotor_signal import rotor_signal
from quadid.data.window import Channel, Recording, measured_period, sample_period
from quadid.errors import LogError
from quadid.types import FloatArray
from quadid.vehicle import Vehicle


@pytest.fixture(scope="module")
def flight(data_dir: Path) -> tuple[Recording, Vehicle]:
    """Four minutes by an independent simulator."""
    folder = data_dir / "cases" / "case_000"
    vehicle = Vehicle.from_yaml((folder / "vehicle.yaml").read_text(encoding="utf-8"))
    return open_log(folder / "train.csv"), vehicle


def judged(flight: tuple[Recording, Vehicle], change: Callable[[Channel], Channel], name: str) -> Check:
    recording, vehicle = flight
    channel = change(recording.channels["rotor_speed"])
    found = inspect(replace(recording, channels={**recording.channels, "rotor_speed": channel}), vehicle)
    assert not found.usable
    assert not any(c.name in ("geometry", "mass") for c in found.checks), "no advice from a broken signal"
    return next(c for c in found.checks if c.name == name)


def column(channel: Channel, rotor: int, change: Callable[[FloatArray], FloatArray]) -> Channel:
    values = channel.values.copy()
    values[:, rotor - 1] = change(values[:, rotor - 1])
    return replace(channel, values=values)


def part(of: float, change: Callable[[FloatArray], FloatArray]) -> Callable[[FloatArray], FloatArray]:
    """Changes the last share of a column."""
    return lambda x: np.concatenate([x[: round(len(x) * (1 - of))], change(x[round(len(x) * (1 - of)) :])])


@pytest.mark.parametrize("rotor", [1, 2, 3, 4])
def test_a_dead_rotor_signal_is_named(flight: tuple[Recording, Vehicle], rotor: int) -> None:
    check = judged(flight, lambda c: column(c, rotor, part(0.3, np.zeros_like)), "rotor_speed")
    assert check.verdict is CheckResult.ERROR
    assert f"rotor {rotor} reads nothing for 30%" in check.message


@pytest.mark.parametrize("rotor", [1, 4])
def test_a_rotor_that_is_dead_at_first_is_named_and_not_taken_for_ground(
    flight: tuple[Recording, Vehicle], rotor: int
) -> None:
    """Three of four rotors carry less than before a flight counts as begun, but nothing stands on one leg less."""
    check = judged(
        flight, lambda c: column(c, rotor, lambda x: np.where(np.arange(len(x)) < 0.2 * len(x), 0.0, x)), "rotor_speed"
    )
    assert check.verdict is CheckResult.ERROR
    assert f"rotor {rotor} reads nothing for 20%" in check.message


def test_a_stuck_rotor_signal_is_named(flight: tuple[Recording, Vehicle]) -> None:
    check = judged(flight, lambda c: column(c, 3, part(0.02, lambda x: np.full_like(x, x[0]))), "rotor_speed")
    assert check.verdict is CheckResult.ERROR
    assert "rotor 3 holds" in check.message


@pytest.mark.parametrize(("factor", "share"), [(0.5, 1.0), (0.5, 0.3), (2.0, 1.0)])
def test_a_halved_or_doubled_rotor_signal_is_named(
    flight: tuple[Recording, Vehicle], factor: float, share: float
) -> None:
    check = judged(flight, lambda c: column(c, 2, part(share, lambda x: factor * x)), "rotor_speed")
    assert check.verdict is CheckResult.ERROR
    assert "rotor 2 reads" in check.message
    assert check.numbers["speed_ratio"] == pytest.approx(factor, rel=0.05)
    assert check.numbers["share"] == pytest.approx(share, abs=0.05)


def test_speeds_that_disagree_with_the_thrust_felt_are_refused(flight: tuple[Recording, Vehicle]) -> None:
    def raise_all(channel: Channel) -> Channel:
        values = channel.values.copy()
        values[len(values) // 2 :] *= 1.45
        return replace(channel, values=values)

    check = judged(flight, raise_all, "rotor_speed")
    assert check.verdict is CheckResult.ERROR
    assert check.numbers["thrust_range"] == pytest.approx(1.45**2, rel=0.1)


def test_a_rotor_that_lost_a_third_of_its_thrust_is_no_broken_signal(flight: tuple[Recording, Vehicle]) -> None:
    recording, vehicle = flight
    speeds = column(recording.channels["rotor_speed"], 1, lambda x: x / np.sqrt(0.67))
    found = inspect(replace(recording, channels={**recording.channels, "rotor_speed": speeds}), vehicle)
    assert next(c for c in found.checks if c.name == "rotor_speed").verdict is CheckResult.OK


def test_a_signal_that_drifts_out_of_time_is_refused(flight: tuple[Recording, Vehicle]) -> None:
    check = judged(flight, lambda c: replace(c, t=c.t * (1.0 + 0.05 / 120.0)), "rotor_timing")
    assert check.verdict is CheckResult.ERROR
    assert "not in time" in check.message
    assert 0.02 < check.numbers["wander_s"] < 0.05


def test_a_clock_that_runs_away_is_refused_too(flight: tuple[Recording, Vehicle]) -> None:
    """After half a minute it is beyond the lags that a block is searched for."""
    check = judged(flight, lambda c: replace(c, t=c.t * 1.01), "rotor_timing")
    assert "not in time" in check.message
    assert check.numbers["wander_s"] > 0.5


def test_correlation_and_lag_are_reported(flight: tuple[Recording, Vehicle]) -> None:
    recording, vehicle = flight
    check = next(c for c in inspect(recording, vehicle).checks if c.name == "rotor_timing")
    assert check.verdict is CheckResult.OK
    assert check.numbers["correlation"] > 0.9
    assert abs(check.numbers["lag_s"] - 0.01) < 0.005  # half of a held sample


@pytest.mark.parametrize(
    ("log", "vehicle", "usable"),
    [
        ("jana00.csv", "vehicle.yaml", True),
        ("jana24.csv", "vehicle.yaml", False),
        ("jana02_pwm.csv", "vehicle_pwm.yaml", True),
    ],
)
def test_the_recorded_dead_sensor_is_refused_and_its_sisters_are_not(
    data_dir: Path, log: str, vehicle: str, usable: bool
) -> None:
    described = Vehicle.from_yaml((data_dir / "brushed" / vehicle).read_text(encoding="utf-8"))
    found = inspect(open_log(data_dir / "brushed" / log), described)
    assert found.usable is usable
    if not usable:
        check = next(c for c in found.checks if c.name == "rotor_speed")
        assert "rotor 1 reads nothing" in check.message


def test_speeds_that_are_all_zero_do_not_advise_another_vehicle_file(flight: tuple[Recording, Vehicle]) -> None:
    """As before take-off: the file describes rotor speeds, and they come as soon as the rotors turn."""
    recording, vehicle = flight
    speed = recording.channels["rotor_speed"]
    still = replace(speed, values=np.zeros_like(speed.values))
    pulses = Channel("motor_command", speed.t, np.full_like(speed.values, 1000.0), "RCOU")
    channels = {**recording.channels, "rotor_speed": still, "motor_command": pulses}
    with pytest.raises(LogError, match="all zero: the motors are off, or the ESCs do not report") as caught:
        rotor_signal(replace(recording, channels=channels), vehicle)
    assert str(caught.value.fix).startswith("fly; if the ESCs never report, write command: {kind: pwm")


@pytest.mark.parametrize("log", ["crazyflie_rpm/figure8_17.csv", "brushed/jana00.csv"])
def test_a_gyro_that_was_smoothed_is_told_from_one_that_was_not(data_dir: Path, log: str) -> None:
    recording = open_log(data_dir / log)
    vehicle = Vehicle.named(str(data_dir / log.split("/")[0] / "vehicle.yaml"))
    gyro = recording.channels["gyro"]

    def told(values: FloatArray) -> list[str]:
        channels = {**recording.channels, "gyro": replace(gyro, values=np.asarray(values))}
        checks = inspect(replace(recording, channels=channels), vehicle).checks
        return [check.message for check in checks if check.name == "gyro_source"]

    filtered = butter(2, 4.0, fs=1.0 / sample_period(gyro.t))
    assert told(gyro.values) == []
    assert "smoothed without a delay" in told(filtfilt(*filtered, gyro.values, axis=0))[0]


@pytest.mark.parametrize("seconds", [-0.03, 0.02, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("log", ["cases/case_000/train.csv", "brushed/jana00.csv", "nanodrone/random_run1.csv"])
def test_an_accelerometer_at_another_time_than_the_gyro_is_named(data_dir: Path, log: str, seconds: float) -> None:
    """No check asked it: rotors move both."""
    recording, vehicle = open_log(data_dir / log), Vehicle.named((data_dir / log).parent / "vehicle.yaml")
    late: list[float] = []
    for moved in (0.0, seconds):
        accel = recording.channels["accel"]
        channels = {**recording.channels, "accel": replace(accel, t=accel.t + moved)}
        checks = inspect(replace(recording, channels=channels), vehicle).checks
        late += [check.numbers["late_s"] for check in checks if check.name == "accel_timing"]
    assert len(late) == 1, "nothing is said of the right log"
    assert late[0] == pytest.approx(seconds, abs=0.013)  # of the right log it is up to 11 ms


def test_a_low_passed_gyro_is_named_where_nothing_else_turns(flight: tuple[Recording, Vehicle]) -> None:
    recording, vehicle = flight
    channels = {n: c for n, c in recording.channels.items() if n in ("gyro", "accel", "rotor_speed")}
    gyro = channels["gyro"]
    late = np.asarray(lfilter(*butter(2, 10.0, fs=1.0 / sample_period(gyro.t)), gyro.values, axis=0))
    channels["gyro"] = replace(gyro, values=late)
    (check,) = (c for c in inspect(replace(recording, channels=channels), vehicle).checks if c.name == "accel_timing")
    assert check.message.startswith("gyro answers the rotors 2")


@pytest.mark.parametrize("seconds", [0.5, -0.5, 1.5])
def test_a_rotor_signal_that_is_far_out_of_time_is_refused(flight: tuple[Recording, Vehicle], seconds: float) -> None:
    """Beyond a quarter of a second it was "too weak to tell", and the log was usable."""
    check = judged(flight, lambda channel: replace(channel, t=channel.t + seconds), "rotor_timing")
    assert check.verdict is CheckResult.ERROR
    assert check.numbers["lag_s"] == pytest.approx(-seconds, abs=0.03)


def test_steps_that_hide_the_motion_are_no_wandering_clock() -> None:
    made = simulate(seconds=30.0, seed=5).flight.recording
    speeds = made.channels["rotor_speed"]
    coarse = replace(speeds, values=40.0 * np.round(speeds.values / 40.0))
    found = inspect(replace(made, channels={**made.channels, "rotor_speed": coarse}), Vehicle.shipped("pelican"))
    assert not [check for check in found.checks if check.verdict is CheckResult.ERROR]
    assert any("in steps of 40 rad/s" in check.message for check in found.checks)


def test_a_gyro_behind_a_slow_filter_is_named_where_speeds_are_measured(data_dir: Path) -> None:
    recording = open_log(data_dir / "crazyflie_rpm" / "figure8_17.csv")
    vehicle = Vehicle.named(data_dir / "crazyflie_rpm" / "vehicle.yaml")
    gyro = recording.channels["gyro"]
    late = np.asarray(lfilter(*butter(2, 2.5, fs=1.0 / sample_period(gyro.t)), gyro.values, axis=0))
    slow = replace(recording, channels={**recording.channels, "gyro": replace(gyro, values=late)})
    check = gyro_filter_check(Log(slow, vehicle, flying_spans(slow, vehicle)))
    assert check is not None
    assert "low-passed" in check.message
    assert "imu_lag" in check.fix
    modelled = vehicle.model_copy(update={"effects": {"imu_lag": {"cutoff": 2.5}}})
    assert gyro_filter_check(Log(slow, modelled, flying_spans(slow, modelled))) is None


def test_an_arm_that_no_inertia_fits_is_asked_for(data_dir: Path) -> None:
    folder = data_dir / "cases_hub" / "case_008"
    right = Vehicle.named(folder / "vehicle.yaml")
    recording = open_log(folder / "train.csv")
    places = np.array([r.position for r in right.rotors])
    for factor, asked in ((1.0, False), (2.0, True)):
        rotors = tuple(
            r.model_copy(update={"position": tuple(factor * p)}) for r, p in zip(right.rotors, places, strict=True)
        )
        checks = inspect(recording, right.model_copy(update={"rotors": rotors})).checks
        geometry = next(check for check in checks if check.name == "geometry")
        assert (geometry.verdict is CheckResult.WARNING) is asked
        if asked:
            low, high = (float(x) for x in re.findall(r"([0-9.]+) to ([0-9.]+) m would fit", geometry.fix)[0])
            assert low < right.arm < high < 2.0 * right.arm


@pytest.mark.parametrize(
    ("folder", "log", "arm", "mass", "asked"),
    [
        *(("findings/vehicles/2_hexa_wrong_logs", "clean.csv", *x) for x in ((1.0, 1.0, ""), (1.35, 1.0, "arm"))),
        *(("findings/vehicles/6_bob_gyro_scale", "train.csv", *x) for x in ((1.0, 1.0, ""), (1.35, 1.0, "arm"))),
        *(("cases_hub/case_001", "train.csv", *x) for x in ((1.0, 1.0, ""), (1.0, 1.3, "mass"), (0.7, 1.0, "arm"))),
    ],
)
def test_an_arm_or_a_mass_that_guesses_and_motion_make_unlikely_is_asked_for(
    data_dir: Path, folder: str, log: str, arm: float, mass: float, asked: str
) -> None:
    """Only an arm that leaves no possible inertia was."""
    right = Vehicle.named(data_dir / folder / "vehicle.yaml")
    rotors = tuple(
        r.model_copy(update={"position": (arm * r.position[0], arm * r.position[1], r.position[2])})
        for r in right.rotors
    )
    vehicle = right.model_copy(update={"rotors": rotors, "mass": mass * right.mass})
    checks = inspect(open_log(data_dir / folder / log, "auto", right.columns), vehicle).checks
    said = [check.message for check in checks if check.name == "geometry" and check.verdict is CheckResult.WARNING]
    assert [line.split()[2] for line in said] == [asked] * bool(asked)


@pytest.mark.parametrize("tau", [0.02, 0.05, 0.1])
def test_the_arm_is_judged_behind_the_motor_lag_of_the_file(tau: float) -> None:
    """A lag of 50 ms, in the file, made its arm 0.79 times as long, and every inertia of a later fit unreliable."""
    flown = simulate(seconds=60.0, seed=1, effects=[f"motor_lag:tau={tau}"]).flight
    truth = flown.truth.parameters.as_dict()
    pelican = Vehicle.shipped("pelican")
    known = {
        name: prior.model_copy(update={"initial": truth[name], "sigma": 0.01 * truth[name], "bounds": None})
        for name, prior in pelican.parameters.items()
    }
    right = pelican.model_copy(update={"parameters": known, "effects": {"motor_lag": {"tau": tau}}})
    for factor in (1.0, 1.5):
        rotors = tuple(r.model_copy(update={"position": tuple(factor * x for x in r.position)}) for r in right.rotors)
        checks = inspect(flown.recording, right.model_copy(update={"rotors": rotors})).checks
        (geometry,) = (check for check in checks if check.name == "geometry")
        assert geometry.numbers["arm_factor"] == pytest.approx(1.0 / factor, rel=0.1)
        assert (geometry.verdict is CheckResult.WARNING) == (factor > 1.0)


@pytest.mark.parametrize("effects", [(), ("imu_misalignment",)])
def test_a_tilted_gyro_is_no_pair_of_reversed_spins(effects: tuple[str, ...]) -> None:
    vehicle = Vehicle.shipped("hexacopter")
    recording = simulate(vehicle, seconds=30.0, seed=3, effects=effects).flight.recording
    (own,) = (check for check in inspect(recording, vehicle).checks if check.name == "motor_order")
    assert own.verdict is CheckResult.OK


def test_a_pair_of_reversed_spins_on_six_rotors_is_asked_for() -> None:
    vehicle = Vehicle.shipped("hexacopter")
    recording = simulate(vehicle, seconds=30.0, seed=3).flight.recording
    rotors = tuple(r.model_copy(update={"spin": -r.spin}) if k in (0, 3) else r for k, r in enumerate(vehicle.rotors))
    (check,) = (
        check
        for check in inspect(recording, vehicle.model_copy(update={"rotors": rotors})).checks
        if check.name == "motor_order"
    )
    assert check.verdict is CheckResult.WARNING
    assert "rotor 1 and 4, and how the IMU is mounted" in check.fix


def test_ground_before_a_flight_does_not_hide_that_a_signal_was_held() -> None:
    t = np.arange(0.0, 60.0, 0.01)
    speeds = np.random.default_rng(1).normal(500.0, 20.0, (len(t) // 10, 4)).repeat(10, axis=0)
    speeds[t < 35.0] = 0.0
    assert measured_period(t, speeds) == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("name", ["pelican", "hexacopter"])
def test_one_rotor_read_too_fast_is_a_question_of_balance(name: str) -> None:
    """b came out 7 % and an inertia 18 % low, "identified", without a word."""
    recording, vehicle = simulate(name, seconds=20.0, seed=3).flight.recording, Vehicle.shipped(name)
    channel = recording.channels["rotor_speed"]

    def asked(log: Recording, file: Vehicle = vehicle) -> list[Check]:
        return [c for c in inspect(log, file).checks if c.name == "balance"]

    assert asked(recording) == []
    fast = replace(recording, channels={**recording.channels, "rotor_speed": column(channel, 2, lambda w: 1.15 * w)})
    (found,) = asked(fast)
    assert found.verdict is CheckResult.WARNING
    assert "as if rotor 2 read 1.1" in found.message
    assert found.numbers["speed_ratio"] == pytest.approx(1.15, abs=0.01)
    known = vehicle.model_copy(update={"effects": {"cg_offset": {"x": 0.01, "y": 0.0}}})
    assert asked(fast, known) == [], "the file says where it balances"


@pytest.mark.parametrize("still", ["rotor_speed", "gyro"])
def test_the_gyro_filter_is_not_asked_for_without_torque_or_motion(still: str) -> None:
    """0 / 0 was printed as a warning of NumPy."""
    recording, vehicle = simulate("pelican", seconds=20.0, seed=3).flight.recording, Vehicle.shipped("pelican")
    spans, channel = flying_spans(recording, vehicle), recording.channels[still]
    held = replace(channel, values=np.full_like(channel.values, 450.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (
            gyro_filter_check(Log(replace(recording, channels={**recording.channels, still: held}), vehicle, spans))
            is None
        )


@pytest.mark.parametrize("late", [0.03, 0.06])
def test_an_order_that_is_wrong_beside_a_signal_that_is_late_is_named_with_it(
    flight: tuple[Recording, Vehicle], late: float
) -> None:
    """No order explained the motion at one lag, the log was usable, and once the arm was asked for."""
    recording, vehicle = flight
    speed = recording.channels["rotor_speed"]
    values = np.column_stack([np.interp(speed.t - late, speed.t, x) for x in speed.values.T])
    other = vehicle.model_copy(update={"rotors": tuple(vehicle.rotors[k] for k in (1, 0, 2, 3))})
    moved = replace(recording, channels={**recording.channels, "rotor_speed": replace(speed, values=values)})
    found = {c.name: c for c in inspect(moved, other).checks}
    assert "order 2, 1, 3, 4" in found["motor_order"].message
    assert "turn" not in found["motor_order"].fix
    assert found["rotor_timing"].numbers["lag_s"] == pytest.approx(0.01 - late, abs=0.005)
    assert "motor_order" not in {c.name for c in inspect(moved, vehicle).checks if c.verdict is CheckResult.ERROR}


@pytest.mark.parametrize(
    ("name", "profile"), [("pelican_x", "hover"), ("hexacopter", "gentle"), ("hexacopter", "hover")]
)
def test_a_loop_that_answers_the_noise_of_its_gyro_asks_for_no_arm_and_no_order(name: str, profile: str) -> None:
    """Inertias seemed half as large, for the motion is mostly noise that the torque follows."""
    vehicle = Vehicle.shipped(name)
    recording = simulate(name, seconds=40.0, seed=3, profile=profile, rate=100.0).flight.recording
    assert [c.name for c in inspect(recording, vehicle).checks if c.off] == []
    gyro = recording.channels["gyro"]
    slow = np.asarray(lfilter(*butter(2, 4.0, fs=1.0 / sample_period(gyro.t)), gyro.values, axis=0))
    filtered = replace(recording, channels={**recording.channels, "gyro": replace(gyro, values=slow)})
    assert [c.message for c in inspect(filtered, vehicle).checks if c.verdict is CheckResult.ERROR] == []
