"""Logs as people have them: flights with closed throttle and punches, single impossible readings, other outputs."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from quadid_replay import open_log, write_csv
from quadid_replay.columns import RawChannel, clean_channel, from_euler
from quadid_replay.motors import active_outputs, frame_of, in_pulses, motor_columns, no_multirotor
from scipy.spatial.transform import Rotation

import quadid
from quadid.app.init import vehicle_text
from quadid.app.logs import LogPart, check_conventions
from quadid.checks import Check, CheckResult, inspect
from quadid.checks.motion import attitude_steps_check
from quadid.data.window import Channel, Recording
from quadid.errors import LogError, QuadidError
from quadid.rotation import euler, product
from quadid.types import FloatArray
from quadid.vehicle import Vehicle


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A Pelican of 30 s with velocity and position."""
    path = tmp_path_factory.mktemp("flight") / "flight.csv"
    quadid.simulate(seconds=30.0, seed=5, extras=("velocity", "position")).save(path)
    return open_log(path)


def with_channel(recording: Recording, name: str, values: FloatArray) -> Recording:
    channel = recording.channels[name]
    changed = Channel(name, channel.t, values, channel.source)
    return replace(recording, channels={**recording.channels, name: changed})


def verdict(recording: Recording, name: str, vehicle: Vehicle | None = None) -> Check:
    found = inspect(recording, vehicle or Vehicle.shipped("pelican"))
    return next(c for c in found.checks if c.name == name)


def names(recording: Recording, vehicle: Vehicle | None = None) -> list[str]:
    """Of the checks that were made."""
    return [c.name for c in inspect(recording, vehicle or Vehicle.shipped("pelican")).checks]


def test_commands_that_are_zero_together_are_a_closed_throttle(data_dir: Path) -> None:
    folder = data_dir / "arpl"
    vehicle = Vehicle.from_yaml((folder / "vehicle.yaml").read_text(encoding="utf-8"))
    recording = open_log(folder / "log15.csv")
    commands = recording.channels["motor_command"].values.copy()
    (first, last), *_ = inspect(recording, vehicle).flying
    t = recording.channels["motor_command"].t
    for k in range(12):
        at = first + (k + 0.5) * (last - first) / 12.0
        commands[(t > at) & (t < at + 0.01 * (last - first))] = 0.0
    found = inspect(with_channel(recording, "motor_command", commands), vehicle)
    assert not any("dead" in c.message for c in found.checks)


@pytest.mark.parametrize("wrong", [65535.0 * 2.0 * np.pi / 60.0, 0.0])
def test_single_impossible_readings_are_dropped_and_counted(flight: Recording, wrong: float) -> None:
    channel = flight.channels["rotor_speed"]
    speeds = channel.values.copy()
    speeds[50::100, 1] = wrong
    cleaned = clean_channel(RawChannel("rotor_speed", channel.t, speeds, "made"))
    assert cleaned is not None
    assert cleaned.faults == {"impossible": 15}
    np.testing.assert_array_equal(cleaned.values, np.delete(channel.values, np.s_[50::100], axis=0))


@pytest.mark.parametrize(
    ("name", "wrong", "rows"),
    [
        ("rotor_speed", 65535.0 * 2.0 * np.pi / 60.0, 12),
        ("rotor_speed", 0.0, 12),
        ("rotor_speed", 2500.0, 3),
        ("motor_command", 65535.0, 12),
        ("motor_command", 65535.0, 1),
    ],
)
def test_impossible_readings_of_a_while_are_dropped_and_counted(
    flight: Recording, name: str, wrong: float, rows: int
) -> None:
    """A rotor that read nothing for 0.2 s once ended in "wanders by 107 ms: not in time with the gyro"."""
    channel = flight.channels["rotor_speed"]
    values = channel.values * (1.0 if name == "rotor_speed" else 3.0)
    spoilt = values.copy()
    for k in range(5):
        spoilt[100 + 250 * k : 100 + 250 * k + rows, k % 4] = wrong
    cleaned = clean_channel(RawChannel(name, channel.t, spoilt, "made"))
    assert cleaned.faults == {"impossible": 5 * rows}
    np.testing.assert_array_equal(cleaned.values, values[(spoilt == values).all(axis=1)])


def test_commands_that_are_closed_or_full_for_one_reading_stay() -> None:
    commands = np.random.default_rng(1).uniform(0.1, 0.2, (1000, 4))
    commands[100::50] = 0.0
    commands[120::50, 1] = 1.0
    cleaned = clean_channel(RawChannel("motor_command", 0.01 * np.arange(1000.0), commands, "made"))
    assert not cleaned.faults


@pytest.mark.parametrize(
    ("name", "wrong"), [("gyro", 1e6), ("gyro", 200.0), ("accel", -1e6), ("velocity", 1e6), ("position", -1e6)]
)
def test_single_wild_readings_of_motion_are_dropped_and_counted(flight: Recording, name: str, wrong: float) -> None:
    """They once ended in "does not follow about x", in unreliable values without a reason, or in a traceback."""
    channel = flight.channels[name]
    values = channel.values.copy()
    values[[300, 700, 1100], 2] = wrong
    cleaned = clean_channel(RawChannel(name, channel.t, values, "made"))
    assert cleaned is not None
    assert cleaned.faults == {"impossible": 3}
    np.testing.assert_array_equal(cleaned.values, np.delete(channel.values, [300, 700, 1100], axis=0))
    untouched = clean_channel(RawChannel(name, channel.t, channel.values, "made"))
    assert untouched is not None
    assert not untouched.faults


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("degrees", "result"), [(5.0, CheckResult.WARNING), (12.0, CheckResult.ERROR)])
def test_a_turned_imu_is_named_with_its_angles_and_the_advice_mends_it(
    flight: Recording, axis: int, degrees: float, result: CheckResult
) -> None:
    turned = {"gyro", "accel"}
    matrix = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix()
    channels = {
        name: replace(c, values=c.values @ matrix.T) if name in turned else c for name, c in flight.channels.items()
    }
    log = replace(flight, channels=channels)
    found = verdict(log, "gyro_attitude")
    assert found.verdict is result
    told = [float(angle) for angle in re.findall(r"(?:roll|pitch|yaw) (\S+?),? ", found.message)]
    np.testing.assert_allclose(told, -degrees * np.eye(3)[axis], atol=0.2)
    pelican = Vehicle.shipped("pelican").to_yaml()
    mended = Vehicle.from_yaml(f"{pelican}\n{re.sub(' in the .*', '', found.fix)}\n")
    assert verdict(log, "gyro_attitude", mended).verdict is CheckResult.OK


def test_an_accelerometer_off_zero_is_named(flight: Recording) -> None:
    """Its drag-like force was "identified" as it was."""
    for off, result in ((1.5, CheckResult.WARNING), (3.0, CheckResult.ERROR)):
        log = with_channel(flight, "accel", flight.channels["accel"].values + [off, 0.0, 0.0])
        found = [c for c in inspect(log, Vehicle.shipped("pelican")).checks if c.name == "gravity"][-1]
        assert found.verdict is result
        assert f"specific force is +{off:.2g} m/s^2 along x" in found.message


@pytest.mark.parametrize("vehicle", ["pelican", "hexacopter"])
@pytest.mark.parametrize(
    ("unit", "made"),
    [
        ("in rpm", lambda w: w * 30.0 / np.pi),
        ("a square", lambda w: w**2),
        ("in rev/s", lambda w: w * 0.5 / np.pi),
        ("a command from 0 to 1", lambda w: w / 900.0),
    ],
)
def test_one_rotor_in_another_unit_is_named(vehicle: str, unit: str, made: Callable[[FloatArray], FloatArray]) -> None:
    """On a hexacopter all rotors were to be multiplied by 1/7, or the rotor was dead."""
    recording = quadid.simulate(vehicle, seconds=20.0, seed=5).flight.recording
    speeds = recording.channels["rotor_speed"].values.copy()
    speeds[:, 1] = made(speeds[:, 1])
    found = verdict(with_channel(recording, "rotor_speed", speeds), "rotor_speed", Vehicle.shipped(vehicle))
    assert found.verdict is CheckResult.ERROR
    assert found.message.startswith("rotor 2 reads")
    assert f"is it {unit}?" in found.message


def test_thousands_of_rpm_and_thrusts_are_named(flight: Recording) -> None:
    speeds = flight.channels["rotor_speed"].values
    for unit, values in (("in thousands of rpm", 0.03 / np.pi * speeds), ("thrusts in N", 2.33e-5 * speeds**2)):
        found = verdict(with_channel(flight, "rotor_speed", values), "hover")
        assert found.verdict is CheckResult.ERROR
        assert unit in found.message


@pytest.mark.parametrize(("factor", "unit"), [(60.0, "minutes"), (3600.0, "hours")])
def test_times_in_minutes_are_named(flight: Recording, factor: float, unit: str) -> None:
    """It said that the log was too short, and to log at a steady rate."""
    channels = {name: replace(c, t=c.t / factor) for name, c in flight.channels.items()}
    found = verdict(replace(flight, channels=channels), "gyro_attitude")
    assert found.verdict is CheckResult.ERROR
    assert f"time seems to be in {unit}" in found.message


def test_slips_of_a_vehicle_file_are_named() -> None:
    file = yaml.safe_load(Vehicle.shipped("pelican").to_yaml())
    b, d = (file["parameters"][name] for name in "bd")
    with pytest.raises(QuadidError, match="are b and d exchanged"):
        Vehicle.from_yaml(yaml.safe_dump({**file, "parameters": {**file["parameters"], "b": d, "d": b}}))
    inches = [{**rotor, "position": [x / 0.0254 for x in rotor["position"]]} for rotor in file["rotors"]]
    with pytest.raises(QuadidError, match="rotor positions in inches"):
        Vehicle.from_yaml(yaml.safe_dump({**file, "rotors": inches}))


def test_a_signal_that_moves_keeps_every_reading(flight: Recording) -> None:
    for name in ("crash", "noise", "start"):
        rng, n = np.random.default_rng(0), 400
        speeds = {
            "crash": np.where(np.arange(n) < 200, 400.0, 0.0),
            "noise": 400.0 + 200.0 * rng.standard_normal(n),
            "start": np.clip(np.arange(n) - 100.0, 0.0, 200.0),
        }[name][:, None] * np.ones(4)
        cleaned = clean_channel(RawChannel("rotor_speed", np.linspace(0.0, 0.02 * (n - 1), n), speeds, "made"))
        assert cleaned is not None
        assert len(cleaned.t) == n, name


@pytest.mark.parametrize(("climb", "share"), [(0.6, 0.2), (0.33, 0.7)])
def test_punches_and_falls_are_part_of_the_flight(climb: float, share: float) -> None:
    """Hover at a quarter of full command with climbs and falls at idle, between two rests on the ground.

    Where climbs took most of the time, the flight began with the first of them.
    """
    t = np.linspace(0.0, 39.98, 2000)
    command = np.full(len(t), 0.25)
    command[t % 8.0 > 8.0 * (1.0 - share)] = climb
    command[(t % 8.0 > 5.0) & (t % 8.0 < 6.0)] = 0.02
    ground = (t < 4.0) | (t > 36.0)
    command[ground] = 0.0
    rng = np.random.default_rng(1)
    force = np.where(ground, -9.81, -9.81 * (command / 0.25) ** 2)
    accel = np.column_stack([0.1 * rng.standard_normal((len(t), 2)), force + 0.1 * rng.standard_normal(len(t))])
    made = {
        "gyro": Channel("gyro", t, 0.1 * rng.standard_normal((len(t), 3)), "made"),
        "accel": Channel("accel", t, accel, "made"),
        "motor_command": Channel("motor_command", t, np.tile(command[:, None], 4), "made"),
    }
    found = inspect(Recording("made", "csv", made))
    ((begin, end),) = found.flying
    assert begin == pytest.approx(4.0, abs=0.3)
    assert end == pytest.approx(36.0, abs=0.3)
    assert next(c for c in found.checks if c.name == "gravity").verdict is CheckResult.OK


def test_without_a_velocity_the_position_is_compared_with_the_force(flight: Recording) -> None:
    high = with_channel(flight, "position", flight.channels["position"].values * [1.0, 1.0, -1.0])
    for recording, said in ((high, "vertical position rises"), (flight, "position follows tilt and thrust")):
        channels = {name: channel for name, channel in recording.channels.items() if name != "velocity"}
        assert said in verdict(replace(recording, channels=channels), "velocity_attitude").message


@pytest.mark.parametrize(
    ("channel", "scale", "zero", "error", "said"),
    [
        ("gyro", [1.0, 0.5, 1.0], [0.0, 0.0, 0.0], True, r"attitude rate / gyro = (1\.9\d|2|2\.0\d) about y"),
        ("gyro", [1.0, 1.0, 1.0], [0.5, 0.0, 0.0], False, r"gyro reads \+0\.5 rad/s about x"),
        ("accel", [0.8, 0.8, 0.8], [0.0, 0.0, 0.0], True, r"force is 7\.[89]\d? m"),
        ("accel", [1.0, 1.0, 1.0], [0.0, 0.0, 1.0], False, r"force is 8\.[89]\d? m"),
        ("velocity", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], False, "velocity: does not change for .* or one axis does not"),
        ("velocity", [1.0, 1.0, 0.0], [0.0, 0.0, 0.0], False, "velocity: does not change for .* or one axis does not"),
        ("accel", [1.0, 1.0, 0.0], [0.0, 0.0, -9.81], False, "accel: does not change for .* or one axis does not"),
    ],
)
def test_one_axis_and_zero_of_a_sensor(
    flight: Recording, channel: str, scale: list[float], zero: list[float], error: bool, said: str
) -> None:
    recording = with_channel(flight, channel, flight.channels[channel].values * scale + zero)
    wanted = CheckResult.ERROR if error else CheckResult.WARNING
    told = [check.message for check in inspect(recording, Vehicle.shipped("pelican")).checks if check.verdict is wanted]
    assert any(re.search(said, line) for line in told), told


def test_a_heading_that_was_held_is_named(flight: Recording) -> None:
    angles = euler(flight.channels["attitude"].values) * [1.0, 1.0, 0.0]
    check = verdict(with_channel(flight, "attitude", from_euler(angles)), "gyro_attitude")
    assert check.verdict is CheckResult.ERROR
    assert "does not follow the attitude about z" in check.message


def test_thrust_per_rpm_is_named(flight: Recording) -> None:
    made = yaml.safe_load(Vehicle.shipped("pelican").to_yaml())
    made["parameters"] |= {"b": 2.0e-5 / 91.2, "d": 4.0e-7 / 91.2}
    check = verdict(flight, "hover", Vehicle.from_yaml(yaml.safe_dump(made), "mine"))
    assert "b by 91.2" in check.fix


@pytest.mark.parametrize(
    ("channel", "factor", "check", "said"),
    [
        ("gyro", 1e3, "gyro_attitude", "scale of one is wrong"),
        ("gyro", 10.0, "gyro_attitude", "multiply gyro by 0."),
        ("position", 1e3, "position_velocity", "different units"),
        ("velocity", 3.6, "velocity_attitude", "by 3."),
        ("rotor_speed", 60.0, "hover", "check mass, the unit"),
        ("rotor_speed", 0.004, "hover", "check mass, the unit"),
    ],
)
def test_a_unit_that_nobody_named_is_an_error_all_the_same(
    flight: Recording, channel: str, factor: float, check: str, said: str
) -> None:
    found = verdict(with_channel(flight, channel, flight.channels[channel].values * factor), check)
    assert found.verdict is CheckResult.ERROR
    assert said in f"{found.message}; {found.fix}"


@pytest.mark.parametrize(
    ("channel", "noise", "check"), [("gyro", 0.4, "gyro_attitude"), ("accel", 1.5, "velocity_attitude")]
)
def test_noise_makes_a_slope_small_and_no_scale_wrong(
    flight: Recording, channel: str, noise: float, check: str
) -> None:
    values = flight.channels[channel].values
    slow = np.repeat(np.random.default_rng(2).normal(0.0, noise, (len(values) // 25 + 1, 3)), 25, axis=0)
    found = verdict(with_channel(flight, channel, values + slow[: len(values)]), check)
    assert found.numbers["scale"] < 0.66
    assert "scale is wrong" not in found.message


def turned(vehicle: Vehicle, *spins: int) -> Vehicle:
    """The vehicle with the spins of some rotors, counted from 0, the other way."""
    rotors = [r.model_copy(update={"spin": -r.spin if k in spins else r.spin}) for k, r in enumerate(vehicle.rotors)]
    return vehicle.model_copy(update={"rotors": tuple(rotors)})


@pytest.mark.parametrize(("rate", "seconds"), [(50.0, 25.0), (250.0, 15.0)])
@pytest.mark.parametrize("name", ["pelican", "pelican_x", "hexacopter"])
def test_spins_are_judged_by_drag_at_every_rate(name: str, rate: float, seconds: float) -> None:
    vehicle = Vehicle.shipped(name)
    recording = quadid.simulate(vehicle, seconds=seconds, seed=9, rate=rate).flight.recording
    count = len(vehicle.rotors)
    wrong: dict[tuple[int, ...], str] = {(k,): f"spin of rotor {k + 1} in" for k in range(count)}
    wrong |= {(0, 1): "spin of rotor 1 and 2", (1, 2): "2 and 3"} if count == 4 else {}
    wrong[tuple(range(count))] = "negate the spins in"
    answers = {which: verdict(recording, "motor_order", turned(vehicle, *which)).fix for which in wrong}
    assert {which: fix for which, fix in answers.items() if wrong[which] not in fix} == {}
    assert verdict(recording, "motor_order", vehicle).verdict is CheckResult.OK


@pytest.mark.parametrize("rate", [250.0, 500.0])
@pytest.mark.parametrize("effects", [(), ("imu_misalignment:x=0.05,y=-0.06,z=0.05",)])
@pytest.mark.parametrize("name", ["pelican", "hexacopter"])
def test_a_loop_that_holds_its_heading_does_not_look_reversed(name: str, effects: tuple[str, ...], rate: float) -> None:
    """Rotors that answer disturbances and noise speed up against the turn, as reversed ones would with it.

    On six rotors a gyro tilted by 4 degrees may look like a pair of them: then both are asked for.
    """
    simulated = quadid.simulate(name, seconds=15.0, seed=11, rate=rate, profile="roll_pitch", effects=effects)
    found = verdict(simulated.flight.recording, "motor_order", Vehicle.shipped(name))
    assert found.verdict is CheckResult.OK or (effects and "or the gyro were tilted" in found.message)


def test_positions_that_are_exchanged_without_their_spins_are_both_named(flight: Recording) -> None:
    vehicle = Vehicle.shipped("pelican")
    first, second, *others = vehicle.rotors
    moved = [a.model_copy(update={"position": b.position}) for a, b in ((first, second), (second, first))]
    found = verdict(flight, "motor_order", vehicle.model_copy(update={"rotors": (*moved, *others)}))
    assert found.fix.startswith("reorder the rotors of the vehicle file to take columns 2, 1, 3, 4")
    assert "negate the spin of rotor 1 and 2" in found.fix


@pytest.mark.parametrize(("flew", "file", "degrees"), [("pelican_x", "pelican", -45), ("pelican", "pelican_x", 45)])
def test_another_frame_numbered_otherwise_is_answered_with_turn_and_order(flew: str, file: str, degrees: int) -> None:
    recording = quadid.simulate(flew, seconds=25.0, seed=13).flight.recording
    found = verdict(recording, "motor_order", Vehicle.shipped(file))
    assert found.verdict is CheckResult.ERROR
    assert np.degrees(found.numbers["turned_rad"]) == pytest.approx(degrees, abs=3.0)
    assert "turn the rotor positions" in found.fix
    assert "reorder the rotors of the vehicle file to take columns 2, 1, 4, 3" in found.fix


@pytest.mark.parametrize(
    ("full", "zero", "said"),
    [
        (100.0, 0.0, "divide by 100"),
        (255.0, 0.0, "divide by 255"),
        (1000.0, 0.0, "divide by 1000"),
        (65535.0, 0.0, "divide by 65535"),
        (2.0, -1.0, "write 0 for standing still"),
    ],
)
def test_commands_that_count_to_another_number_are_no_pulses_nor_speeds(full: float, zero: float, said: str) -> None:
    vehicle = Vehicle.shipped("crazyflie")
    recording = quadid.simulate(vehicle, seconds=10.0, seed=14).flight.recording
    counted = with_channel(recording, "motor_command", zero + full * recording.channels["motor_command"].values)
    found = verdict(counted, "hover", vehicle)
    assert found.verdict is CheckResult.ERROR
    assert said in found.fix


def test_speeds_with_a_sign_are_named(flight: Recording) -> None:
    speeds = flight.channels["rotor_speed"].values
    signed = verdict(with_channel(flight, "rotor_speed", speeds * [1.0, -1.0, 1.0, -1.0]), "hover")
    assert "rotor 2, 4" in signed.message


def test_what_lies_on_its_back_and_never_flies_is_no_wrong_frame() -> None:
    t = np.arange(0.0, 10.0, 0.02, dtype=np.float64)
    noise = np.random.default_rng(1).normal(0.0, 0.02, (500, 6))
    made = {
        "gyro": Channel("gyro", t, 0.1 * noise[:, :3]),
        "accel": Channel("accel", t, noise[:, 3:] + [0.0, 0.0, 9.81]),
    }
    found = inspect(Recording("made", "csv", made))
    assert [c.verdict for c in found.checks if c.name == "gravity"] == [CheckResult.UNKNOWN]


def test_after_an_error_nothing_later_is_asked(flight: Recording) -> None:
    degrees = with_channel(flight, "gyro", np.degrees(flight.channels["gyro"].values))
    assert not {"hover", "motor_order", "rotor_timing", "geometry"} & {*names(degrees)}
    swapped = with_channel(flight, "rotor_speed", flight.channels["rotor_speed"].values[:, [1, 0, 2, 3]])
    made = names(swapped)
    assert "rotor_speed" not in made
    assert verdict(swapped, "motor_order").fix.endswith("columns 2, 1, 3, 4")


@pytest.mark.parametrize(("rate", "drift"), [(50.0, 0.002), (200.0, 0.002), (100.0, -0.002)])
def test_a_clock_of_the_rotors_that_drifts_is_seen_in_half_a_minute(rate: float, drift: float) -> None:
    recording = quadid.simulate(seconds=30.0, seed=5, rate=rate).flight.recording
    speeds = recording.channels["rotor_speed"]
    late = Channel("rotor_speed", speeds.t * (1.0 + drift), speeds.values, speeds.source)
    found = verdict(replace(recording, channels={**recording.channels, "rotor_speed": late}), "rotor_timing")
    assert found.verdict is CheckResult.ERROR
    assert "not in time with the gyro" in found.message


def test_a_centre_of_gravity_that_is_off_is_no_clock() -> None:
    flown = quadid.simulate("pelican_x", seconds=25.0, seed=6, effects=("cg_offset:x=0.02,y=-0.02",)).flight.recording
    assert verdict(flown, "rotor_timing", Vehicle.shipped("pelican_x")).verdict is CheckResult.OK


def test_a_hover_between_manoeuvres_does_not_place_the_rotors(data_dir: Path) -> None:
    """A motor that weakens in hover, and a payload, disturb it: rotors follow what turns the vehicle, not before it."""
    folder = data_dir / "findings" / "ardupilot"
    vehicle = Vehicle.from_yaml((folder / "mine_pwm.yaml").read_text(encoding="utf-8"))
    found = verdict(open_log(folder / "payload_hover_378s_no_alarm.tlog"), "rotor_timing", vehicle)
    assert found.verdict is CheckResult.OK
    assert found.numbers["lag_s"] == pytest.approx(0.013, abs=0.002)


def test_held_readings_count_at_the_rate_at_which_they_change(flight: Recording) -> None:
    speeds = flight.channels["rotor_speed"].values
    held = with_channel(flight, "rotor_speed", speeds[np.arange(len(speeds)) // 5 * 5])
    assert "10 Hz is too slow" in verdict(held, "motor_order").message


@pytest.mark.parametrize("factor", [0.1, 7.0, 60.0 / (2.0 * np.pi)])
def test_init_bounds_the_thrust_coefficient_by_the_size_of_the_frame(data_dir: Path, factor: float) -> None:
    """Its value once came from the very speeds that it had to judge: any scale was right."""
    log = open_log(data_dir / "ardupilot_sitl" / "x.bin")
    wrong = with_channel(log, "rotor_speed", factor * log.channels["rotor_speed"].values)
    made = Vehicle.from_yaml(vehicle_text(wrong, "mine", mass=3.0, arm=0.35))
    said = verdict(wrong, "hover", made)
    assert said.verdict in (CheckResult.ERROR, CheckResult.WARNING)
    assert "rotor speeds" in said.fix
    right = Vehicle.from_yaml(vehicle_text(log, "mine", mass=3.0, arm=0.35))
    assert verdict(log, "hover", right).verdict is CheckResult.OK


def test_betaflight_says_which_way_its_propellers_turn() -> None:
    spins = [
        [r.spin for r in frame.rotors]
        for told in (0.0, 1.0)
        if (frame := frame_of({"yaw_motors_reversed": told}, 0.1)) is not None
    ]
    assert spins == [[-1, 1, 1, -1], [1, -1, -1, 1]]


@pytest.mark.parametrize(
    ("parameters", "kind", "firmware", "word"),
    [
        ({}, 1, "", "MAV_TYPE 1"),
        ({"MAV_TYPE": 22.0}, 0, "", "MAV_TYPE 22"),
        ({}, 0, "Plane", "ArduPlane"),
        ({"CA_AIRFRAME": 2.0}, 0, "", "VTOL"),
        ({"FRAME_CLASS": 6.0}, 2, "Copter", "helicopter"),
        ({"Q_ENABLE": 1.0}, 0, "", "Q_ENABLE"),
        ({"MAV_TYPE": 2.0, "CA_AIRFRAME": 0.0}, 0, "", ""),
        ({"FRAME_CLASS": 1.0}, 13, "Copter", ""),
        ({}, 0, "", ""),
    ],
)
def test_what_is_no_multirotor(parameters: dict[str, float], kind: int, firmware: str, word: str) -> None:
    said = no_multirotor(parameters, kind, firmware)
    assert (word in said) if word else said == ""


@pytest.mark.parametrize(("least", "full"), [(1000.0, 2000.0), (125.0, 250.0), (42.0, 84.0), (5.0, 25.0)])
def test_short_pulses_are_those_that_they_stand_for(least: float, full: float) -> None:
    pulses = np.hstack([np.linspace(1100.0, 1800.0, 30)[:, None] + [0.0, 20.0, 40.0, 60.0], np.zeros((30, 2))])
    short = np.where(pulses > 0.0, least + (full - least) * (pulses - 1000.0) / 1000.0, 0.0)
    read, _ = in_pulses(short)
    np.testing.assert_allclose(read, pulses, rtol=1e-12)
    assert active_outputs(read) == [0, 1, 2, 3]


@pytest.mark.parametrize("outputs", [[0.1, 0.5, 0.6, 0.9], [100.0, 500.0, 700.0, 1900.0], [0.0, 0.0, 0.0, 0.0]])
def test_numbers_that_are_no_pulses_stay_as_they_are(outputs: list[float]) -> None:
    np.testing.assert_array_equal(in_pulses(np.array([outputs] * 30))[0], [outputs] * 30)


def test_motors_by_function() -> None:
    assert motor_columns([103, 0, 101, 102]) == [2, 3, 0]
    assert motor_columns([101, 103]) == []
    assert motor_columns([0, 0]) == []


@pytest.mark.parametrize("seed", range(4))
def test_several_heading_resets_in_a_hover_are_no_rotation(data_dir: Path, seed: int) -> None:
    """Four within 6 s, each too small to stand out of the noise, were "gyro does not follow the attitude"."""
    hover = open_log(data_dir / "findings" / "logs" / "heading_reset_hover" / "hover.csv")
    attitude, rng = hover.channels["attitude"], np.random.default_rng(seed)
    heading = np.zeros(len(attitude.t))
    for at in rng.uniform(2.0, 8.0, 4):
        heading[attitude.t > at] += np.radians(rng.choice([-8, -5, -3, -2, 2, 3, 5, 8]))
    turned = product(from_euler(np.outer(heading, [0.0, 0.0, 1.0])), attitude.values)
    found = verdict(with_channel(hover, "attitude", turned), "gyro_attitude")
    assert found.verdict is CheckResult.UNKNOWN
    assert "too little rotation" in found.message


def test_an_accelerometer_that_reads_too_little_shortens_no_flight(flight: Recording) -> None:
    found = inspect(with_channel(flight, "accel", 0.75 * flight.channels["accel"].values), None).flying
    np.testing.assert_allclose(found, inspect(flight, None).flying, atol=0.5)


@pytest.mark.parametrize("every", [2.5, 12.0])
def test_flips_are_followed_by_the_attitude(every: float) -> None:
    """Over steps of 0.4 s a flip in half a second is another turn: the log was refused as if nothing agreed."""
    t, rng = np.arange(0.0, 30.0, 0.01), np.random.default_rng(3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    rates = 0.3 * np.sin(2.0 * np.pi * np.outer(t, [0.7, 1.1, 0.4]) + phases)
    for k, at in enumerate(np.arange(4.0, 28.0, every)):
        flip = (t >= at) & (t < at + 0.5)
        rates[flip] = np.outer(8.0 * np.pi * np.sin(2.0 * np.pi * (t[flip] - at)) ** 2, np.eye(3)[k % 2])
    turned = [Rotation.identity()]
    for rate in rates[:-1]:
        turned.append(turned[-1] * Rotation.from_rotvec(0.01 * rate))
    noisy = Rotation.concatenate(turned) * Rotation.from_rotvec(0.002 * rng.standard_normal((len(t), 3)))
    channels = {
        "gyro": Channel("gyro", t + 0.005, rates + 0.01 * rng.standard_normal(rates.shape), "made"),
        "attitude": Channel("attitude", t, noisy.as_quat()[:, [3, 0, 1, 2]], "made"),
    }
    found = next(c for c in inspect(Recording("made", "csv", channels)).checks if c.name == "gyro_attitude")
    assert found.verdict is CheckResult.OK, found.message


def test_a_gyro_that_reads_nothing_is_named_beside_an_attitude_that_moves(flight: Recording) -> None:
    still = with_channel(
        flight, "gyro", 1e-3 * np.random.default_rng(1).normal(size=(len(flight.channels["gyro"].t), 3))
    )
    assert verdict(still, "gyro_attitude").verdict is CheckResult.ERROR


def test_a_ground_contact_inside_the_flight_is_left_out(flight: Recording) -> None:
    """Two seconds on the ground at 60 % of hover thrust, between two parts of a flight."""
    t = flight.channels["gyro"].t
    down = (t > 14.0) & (t < 16.0)
    rng = np.random.default_rng(1)
    still = {
        "gyro": 0.003 * rng.standard_normal((len(t), 3)),
        "accel": [0.0, 0.0, -9.81] + 0.05 * rng.standard_normal((len(t), 3)),
        "rotor_speed": np.sqrt(0.6) * np.median(flight.channels["rotor_speed"].values) * np.ones((len(t), 4)),
    }
    made = flight
    for name, values in still.items():
        made = with_channel(made, name, np.where(down[:, None], values, flight.channels[name].values))
    found = inspect(made, Vehicle.shipped("pelican")).flying
    assert len(found) == 2
    assert found[0][1] == pytest.approx(14.0, abs=0.5)
    assert found[1][0] == pytest.approx(16.0, abs=0.8)
    assert len(inspect(flight, Vehicle.shipped("pelican")).flying) == 1


@pytest.mark.parametrize(("sigmas", "verdict_"), [(2.1, CheckResult.WARNING), (1.2, CheckResult.ERROR)])
def test_a_clipped_gyro_is_an_error_where_inertias_come_out_wrong(
    flight: Recording, sigmas: float, verdict_: CheckResult
) -> None:
    rates = flight.channels["gyro"].values
    most = np.array([sigmas * np.std(rates[:, 0]), np.inf, np.inf])
    assert verdict(with_channel(flight, "gyro", np.clip(rates, -most, most)), "saturated").verdict is verdict_


def test_what_to_turn_is_what_the_attitude_and_the_velocity_agree_with(flight: Recording) -> None:
    accel = flight.channels["accel"].values * [1.0, -1.0, -1.0]
    assert verdict(with_channel(flight, "accel", accel), "gravity").fix == "negate y and z of the accelerometer alone"


def test_an_attitude_in_a_world_with_z_up_is_refused_where_logs_are_loaded(flight: Recording, tmp_path: Path) -> None:
    """`inspect` named it, but `load` let it through: its check carried no number."""
    q = flight.channels["attitude"].values
    up = np.column_stack([-q[:, 1], q[:, 0], -q[:, 3], q[:, 2]])  # turned by 180 deg about the world's x
    others = {n: flight.channels[n].values * [1.0, -1.0, -1.0] for n in ("velocity", "position")}
    made = with_channel(flight, "attitude", up)
    for name, values in others.items():
        made = with_channel(made, name, values)
    with pytest.raises(LogError, match="z up"):
        check_conventions(made, Vehicle.shipped("pelican"), LogPart(tmp_path))


def test_a_gyro_of_a_few_readings_a_second_is_not_compared_with_the_attitude(flight: Recording) -> None:
    gyro = flight.channels["gyro"]
    slow = replace(flight, channels={**flight.channels, "gyro": Channel("gyro", gyro.t[::12], gyro.values[::12])})
    assert "too slow to compare" in verdict(slow, "gyro_attitude").message


@pytest.mark.parametrize(("digits", "said"), [(0.02, "2.3 deg"), (0.01, "1.1 deg"), (0.005, "0.57 deg"), (0.001, "")])
@pytest.mark.parametrize("single", [False, True])
def test_rounded_quaternions_are_named_as_such(flight: Recording, digits: float, said: str, single: bool) -> None:
    """Only angles were: quaternions that are made unit again lie on no lattice of angles."""
    q = np.round(flight.channels["attitude"].values / digits) * digits
    q = q.astype(np.float32).astype(np.float64) if single else q
    made = with_channel(flight, "attitude", q / np.linalg.norm(q, axis=1, keepdims=True))
    found = attitude_steps_check(made)
    assert said in found.message if found is not None else said == ""
    assert "attitude_steps" not in names(flight)


@pytest.mark.parametrize(("degrees", "axes"), [(10.0, "roll pitch yaw"), (5.0, "roll pitch yaw"), (5.0, "yaw")])
@pytest.mark.parametrize("profile", ["excited", "hover"])
def test_angles_in_steps_are_named_and_nothing_else_is_told_of_them(degrees: float, axes: str, profile: str) -> None:
    """Steps of 10 deg ended in a mathematical error, those of a heading alone were none, and a hover was refused."""
    flown = quadid.simulate(seconds=40.0, seed=3, profile=profile).flight.recording
    angles, step = euler(flown.channels["attitude"].values), np.radians(degrees)
    which = [k for k, axis in enumerate(("roll", "pitch", "yaw")) if axis in axes]
    angles[:, which] = step * np.round(angles[:, which] / step)
    found = inspect(with_channel(flown, "attitude", from_euler(angles)), Vehicle.shipped("pelican"))
    told = {c.name: c.verdict for c in found.checks}
    assert told["gyro_attitude"] in (CheckResult.UNKNOWN, CheckResult.OK)
    assert profile == "hover" or told["attitude_steps"] is CheckResult.WARNING
    assert CheckResult.ERROR not in told.values()


@pytest.mark.parametrize("log", ["iris/sideways.csv", "brushed/jana00.csv"])
def test_a_velocity_upwards_is_named_in_flights_that_hardly_climb(data_dir: Path, log: str) -> None:
    """A tenth of a m/s^2 went for too little motion."""
    recording = open_log(data_dir / log)
    vehicle = Vehicle.from_yaml((data_dir / log).with_name("vehicle.yaml").read_text(encoding="utf-8"))
    assert verdict(recording, "velocity_attitude", vehicle).verdict is not CheckResult.ERROR
    upwards = with_channel(recording, "velocity", recording.channels["velocity"].values * [1.0, 1.0, -1.0])
    assert "points up" in verdict(upwards, "velocity_attitude", vehicle).message


def test_a_second_of_flight_is_not_usable_as_identify_refuses_it(flight: Recording, tmp_path: Path) -> None:
    write_csv(tmp_path / "flight.csv", flight)
    found = quadid.inspect(tmp_path / "flight.csv", vehicle="pelican", start=5.0, stop=6.5).found
    assert not found.usable
    assert "longest stretch" in next(c for c in found.checks if c.name == "data").message
