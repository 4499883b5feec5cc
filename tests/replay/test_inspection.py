"""Faults that an inspection notices: wrong units, wrong frames, swapped motors, absent and slow channels, clocks."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log

from quadid.checks import Check, CheckResult, Inspection, inspect, proposed_cuts
from quadid.checks.frames import fit_axes, gyro_check
from quadid.checks.motion import Log, Spans
from quadid.data.window import Channel, Recording
from quadid.flight import fly
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.replay.synthetic import PELICAN, Flight, with_command

FLIGHT = Flight()


@pytest.fixture(scope="module")
def clean() -> Recording:
    """Twenty seconds without a fault."""
    rng = np.random.default_rng(4)
    recording = FLIGHT.recording(seconds=20.0, rate=50.0)
    noisy = {}
    for name, sigma in (("gyro", 0.01), ("accel", 0.1)):
        channel = recording.channels[name]
        noisy[name] = replace(channel, values=channel.values + sigma * rng.normal(size=channel.values.shape))
    return replace(recording, channels={**recording.channels, **noisy})


def changed(recording: Recording, name: str, change: Callable[[FloatArray], FloatArray]) -> Recording:
    channel = recording.channels[name]
    return replace(recording, channels={**recording.channels, name: replace(channel, values=change(channel.values))})


def check(inspection: Inspection, name: str) -> Check:
    return next(c for c in inspection.checks if c.name == name)


def test_a_clean_flight_passes_every_check(clean: Recording) -> None:
    found = inspect(clean, PELICAN)
    assert {c.name: c.verdict for c in found.checks} == dict.fromkeys(
        (
            "clock",
            "gravity",
            "gyro_attitude",
            "velocity_attitude",
            "rotor_speed",
            "hover",
            "motor_order",
            "rotor_timing",
            "geometry",
        ),
        CheckResult.OK,
    )
    assert found.usable
    np.testing.assert_allclose(found.flying, [(0.0, 19.98)])
    assert found.missing == ()
    assert all(p.possible for p in found.parameters)
    gyro = next(c for c in found.channels if c.name == "gyro")
    assert gyro.rate == pytest.approx(50.0)
    assert (gyro.count, gyro.gaps, gyro.saturated) == (1000, 0, 0)


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1 / 9.80665, "in g"), (1000 / 9.80665, "milli-g"), (100.0, "cm/s"), (30.0, "no specific force")],
)
def test_wrong_units_of_the_accelerometer(clean: Recording, factor: float, unit: str, happened: Happened) -> None:
    gravity = check(inspect(changed(clean, "accel", lambda v: v * factor)), "gravity")
    assert gravity.verdict is CheckResult.ERROR
    assert unit in gravity.message
    assert gravity.fix
    happened(10, f"accelerometer times {factor:.4g}: '{gravity.message[-40:]}'; fix: {gravity.fix}")


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axes_that_hardly_turn_are_not_called_swapped(axis: int) -> None:
    """A flight about one axis alone: what the others read is noise, which any axis explains as well as any other."""
    rng = np.random.default_rng(axis)
    t = np.arange(0.0, 20.0, 0.02)
    gyro = 0.02 * rng.standard_normal((len(t), 3))
    gyro[:, axis] += 0.6 * np.cos(2.0 * t) + 0.7 * np.cos(7.0 * t)
    half = 0.15 * np.sin(2.0 * t) + 0.05 * np.sin(7.0 * t)
    attitude = np.zeros((len(t), 4))
    attitude[:, 0], attitude[:, 1 + axis] = np.cos(half), np.sin(half)
    attitude[:, 1:] += 0.002 * rng.standard_normal((len(t), 3))
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    channels = {"gyro": Channel("gyro", t, gyro), "attitude": Channel("attitude", t, attitude)}
    found = gyro_check(Log(Recording("roll", "csv", channels)))
    assert found.verdict is CheckResult.OK, found.message


def with_position(recording: Recording, factor: tuple[float, float, float], shuffle: bool = False) -> Recording:
    """The flight with its own path as position, and a velocity that is `factor` times the change of it."""
    speed = recording.channels["velocity"]
    step = 0.5 * (speed.values[1:] + speed.values[:-1]) * np.diff(speed.t)[:, None]
    path = np.cumsum(np.vstack([np.zeros(3), step]), axis=0)[:, [1, 0, 2] if shuffle else [0, 1, 2]]
    both = {
        "position": replace(speed, name="position", values=path),
        "velocity": replace(speed, values=speed.values * factor),
    }
    return replace(recording, channels={**recording.channels, **both})


def test_a_velocity_that_is_the_change_of_position_is_said_to_be(clean: Recording) -> None:
    found = check(inspect(with_position(clean, (1.0, 1.0, 1.0))), "position_velocity")
    assert found.verdict is CheckResult.OK
    assert found.numbers["scale horizontally"] == pytest.approx(1.0, abs=1e-3)


def test_a_horizontal_velocity_larger_than_the_change_of_position_is_a_finding(clean: Recording) -> None:
    """As the estimator on board of Crazyflies has it, by 8 %; the vertical one is right."""
    recording = with_position(clean, (1.08, 1.08, 1.0))
    found = check(inspect(recording), "position_velocity")
    assert found.verdict is CheckResult.WARNING
    assert "8.0% larger horizontally" in found.message
    assert "vertically than" not in found.message
    assert found.numbers["scale horizontally"] == pytest.approx(1.08, abs=1e-3)


def test_a_position_in_enu_beside_a_velocity_in_ned(clean: Recording) -> None:
    found = check(inspect(with_position(clean, (1.0, 1.0, 1.0), shuffle=True)), "position_velocity")
    assert found.verdict is CheckResult.WARNING
    assert "x = y, y = x" in found.message


def test_recorded_crazyflies_have_a_velocity_that_is_too_large_horizontally(data_dir: Path) -> None:
    for log in ("nanodrone/random_run1.csv", "brushed/jana00.csv", "crazyflie_rpm/figure8_22.csv"):
        found = check(inspect(open_log(data_dir / log)), "position_velocity")
        assert found.verdict is CheckResult.WARNING
        assert 1.05 < found.numbers["scale horizontally"] < 1.11
    right = check(inspect(open_log(data_dir / "nanobench" / "B2_circle_fast_rep1.csv")), "position_velocity")
    assert right.verdict is CheckResult.OK


def known(vehicle: Vehicle, mass: float = 1.0, arm: float = 1.0, turn: float = 0.0) -> Vehicle:
    """The vehicle with b and inertias known to 3 %, its mass and arm wrong by factors, its rotors turned [rad]."""
    data = vehicle.model_dump()
    data["mass"] *= mass
    for rotor in data["rotors"]:
        x, y, z = rotor["position"]
        c, s = arm * np.cos(turn), arm * np.sin(turn)
        rotor["position"] = (c * x - s * y, s * x + c * y, z)
    for name in ("b", "J_xx", "J_yy"):
        data["parameters"][name]["sigma"] = 0.03 * data["parameters"][name]["initial"]
    return Vehicle.model_validate(data)


@pytest.mark.parametrize("effect", ["thrust_curve", "supply_voltage"])
def test_the_vehicle_is_weighed_by_its_whole_model(clean: Recording, effect: str) -> None:
    """Speeds that thrust is no square of: its own curve, or commands on a battery that empties."""
    t = clean.channels["rotor_speed"].t
    volts = np.linspace(12.6, 9.0, len(t))[:, None]
    if effect == "thrust_curve":
        flown = changed(clean, "rotor_speed", lambda v: v - 60.0)
        numbers = {"dead_speed": -60.0}
    else:
        flown = changed(clean, "rotor_speed", lambda v: v * (12.6 / volts) ** 0.8)
        read = np.where(np.arange(len(t))[:, None] % 10 == 3, 0.0, volts)  # a monitor that now and then reads nothing
        flown = replace(flown, channels={**flown.channels, "battery": Channel("battery", t, read)})
        numbers = {"exponent": 0.8}
    vehicle = known(PELICAN).model_copy(update={"reference_voltage": 12.6})
    whole = vehicle.model_copy(update={"effects": {effect: numbers}})
    found = check(inspect(flown, whole), "mass")
    assert found.verdict is CheckResult.OK
    assert found.numbers["mass_kg"] == pytest.approx(PELICAN.mass, rel=0.03)
    assert check(inspect(flown, vehicle), "mass").verdict is CheckResult.WARNING, (
        "by b omega^2 alone it would weigh less"
    )


@pytest.mark.filterwarnings("error")
def test_thrust_that_pulls_down_is_no_flight_by_the_vehicle_file(clean: Recording) -> None:
    pulls = PELICAN.model_copy(update={"effects": {"weak_rotor": {"rotor": 1, "loss": 20.0}}})
    assert check(inspect(clean, pulls), "hover").verdict is not CheckResult.OK


@pytest.mark.parametrize(
    ("what", "name", "factor", "within", "fix"),
    [
        *(("mass", "mass", f, 0.03, "kg would fit") for f in (0.8, 1.2)),
        *(("arm", "geometry", f, 0.1, "measure the arm") for f in (0.7, 1.4)),
    ],
)
def test_a_wrong_mass_and_arm_are_named_with_the_factor_where_thrust_and_inertia_are_known(
    clean: Recording, what: str, name: str, factor: float, within: float, fix: str, happened: Happened
) -> None:
    assert check(inspect(clean, known(PELICAN)), name).verdict is CheckResult.OK
    found = check(inspect(clean, known(PELICAN, **{what: factor})), name)
    assert found.verdict is CheckResult.WARNING
    fits = found.numbers[f"{what}_factor"]
    assert fits == pytest.approx(1.0 / factor, rel=within)
    assert fix in found.fix
    happened(10, f"{what} stated times {factor:g}: '{found.message}'; factor that would fit {fits:.2f}")


def test_beside_a_guess_of_the_thrust_the_mass_is_not_judged(clean: Recording) -> None:
    assert not [c for c in inspect(clean, PELICAN).checks if c.name == "mass"]


@pytest.mark.parametrize("degrees", [45.0, -45.0, 30.0])
def test_a_frame_turned_about_z_is_named_with_the_angle(clean: Recording, degrees: float, happened: Happened) -> None:
    found = check(inspect(clean, known(PELICAN, turn=np.radians(degrees))), "motor_order")
    assert found.verdict is CheckResult.ERROR
    assert np.degrees(found.numbers["turned_rad"]) == pytest.approx(-degrees, abs=5.0)
    happened(10, f"rotor positions turned by {degrees:+.0f} deg (X for +): '{found.message}'")


@pytest.mark.parametrize(("name", "rate"), [("pelican", 100.0), ("pelican", 500.0), ("hexacopter", 200.0)])
def test_a_loop_that_answers_the_noise_of_its_gyro_reverses_no_spins(name: str, rate: float) -> None:
    """Logged at the loop's own rate, the answer looks like the spin-up of rotors that turn the other way."""
    flown = fly(Vehicle.shipped(name), None, 20.0, 5, log_rate=rate).recording
    assert check(inspect(flown, Vehicle.shipped(name)), "motor_order").verdict is CheckResult.OK


def test_the_wrong_vehicle_is_an_error_of_hover(clean: Recording) -> None:
    found = check(inspect(clean, Vehicle.shipped("hexacopter")), "hover")
    assert found.verdict is CheckResult.ERROR
    assert "4 rotor columns" in found.message


@pytest.mark.parametrize("kind", ["csv", "mcap", "ulog", "dataflash", "tlog"])
def test_what_is_missing_is_named_with_the_way_to_log_it(kind: str) -> None:
    t = np.arange(0.0, 10.0, 0.02)
    nothing = replace(FLIGHT.at({"attitude": t}), format=kind)
    found = inspect(nothing)
    assert [m.channel for m in found.missing] == ["rotor", "gyro", "accel"]
    assert all(m.how and m.why for m in found.missing)
    assert not any(p.possible for p in found.parameters)
    assert not found.usable
    slow = replace(FLIGHT.at({"gyro": t, "accel": t, "attitude": t, "rotor_speed": t[::5]}), format=kind)
    found = inspect(slow)
    assert "10 Hz is too slow" in found.missing[0].why
    assert [p.parameter for p in found.parameters if p.possible] == ["b"]


def test_flying_spans_leave_out_the_ground(clean: Recording) -> None:
    t = clean.channels["rotor_speed"].t
    idle = (t < 4.0) | (t > 15.0)

    def landed(speed: FloatArray) -> FloatArray:
        return np.where(idle[:, None], 60.0, speed)

    (span,) = inspect(changed(clean, "rotor_speed", landed), PELICAN).flying
    np.testing.assert_allclose(span, (4.0, 15.0), atol=0.03)
    command = Channel(
        "motor_command", t, np.where(idle[:, None], 1050.0, 1500.0 + 20 * np.sin(t)[:, None] + np.zeros(4))
    )
    pulses = replace(clean, channels={"gyro": clean.channels["gyro"], "motor_command": command})
    (span,) = inspect(pulses).flying
    np.testing.assert_allclose(span, (4.0, 15.0), atol=0.03)
    armed = replace(command, values=np.full((len(t), 4), 1100.0))
    assert inspect(replace(pulses, channels={"motor_command": armed})).flying == ()


def test_a_flight_begins_when_the_rotors_carry_the_weight(clean: Recording) -> None:
    t = clean.channels["rotor_speed"].t
    slowly = np.clip((t - 4.0) / 4.0, 0.05, 1.0)  # thrust rises for four seconds, and carries the weight at the end
    rising = changed(clean, "rotor_speed", lambda speed: np.sqrt(slowly)[:, None] * speed)
    (span,) = inspect(rising, PELICAN).flying
    assert 7.2 < span[0] < 8.2


def test_lying_on_the_back_with_turning_motors_is_no_flight(clean: Recording, happened: Happened) -> None:
    late = clean.channels["accel"].t > 12.0
    crashed = changed(clean, "accel", lambda v: np.where(late[:, None], [0.0, 3.0, 9.0], v))
    (span,) = inspect(crashed, PELICAN).flying
    assert span[1] == pytest.approx(12.0, abs=0.6)
    happened(18, "on its back with turning motors from 12 s on: flight ends at 12 s")


def test_stuck_clipped_and_jumping_sensors(clean: Recording, happened: Happened) -> None:
    def stuck(v: FloatArray) -> FloatArray:
        out = v.copy()
        out[300:400] = out[300]
        return out

    found = inspect(changed(clean, "gyro", stuck))
    assert check(found, "stuck").message.startswith("gyro: does not change for 2 s")
    clipped = inspect(changed(clean, "gyro", lambda v: np.clip(v, -0.8, 0.8)))
    assert "at the limit" in check(clipped, "saturated").message
    broken = inspect(replace(clean, breaks=(5.0,)))
    assert "1 breaks" in check(broken, "clock").message
    happened(6, "inspection names a stuck gyro ('does not change for 2 s') and a clipped one")


def test_a_sensor_that_repeats_itself_on_the_ground_is_not_stuck(clean: Recording) -> None:
    """A simulator's gyro, and one of few bits, repeat themselves while the vehicle stands; in flight none does."""
    t = clean.channels["gyro"].t

    def still(until: float) -> Recording:
        stands = changed(clean, "rotor_speed", lambda v: np.where(t[:, None] < 5.0, 60.0, v))
        return changed(stands, "gyro", lambda v: np.where(t[:, None] < until, 0.0, v))

    assert not [c for c in inspect(still(5.0), PELICAN).checks if c.name == "stuck"]
    assert check(inspect(still(7.0), PELICAN), "stuck").message.startswith("gyro: does not change for 2 s of flight")
    nowhere = changed(still(20.0), "rotor_speed", lambda v: 0.0 * v)
    assert not [c for c in inspect(nowhere, PELICAN).checks if c.name == "stuck"], "it stands all the time"


def test_a_signal_brought_to_a_faster_rate_counts_as_slow_as_it_was(clean: Recording) -> None:
    speed = clean.channels["rotor_speed"]
    few = np.column_stack([np.interp(speed.t, speed.t[::5], column[::5]) for column in speed.values.T])
    found = inspect(changed(clean, "rotor_speed", lambda _: few), PELICAN)
    assert next(c for c in found.channels if c.name == "rotor_speed").rate == pytest.approx(10.0, rel=0.05)
    assert "rotor_speed: 50 rows a second were interpolated between samples at 10 Hz" in check(found, "timing").message
    assert {p.parameter for p in found.parameters if p.possible} == {"b"}


def test_faults_of_the_reader_are_counted(clean: Recording) -> None:
    gyro = replace(clean.channels["gyro"], faults={"duplicate": 3, "not_finite": 2})
    found = inspect(replace(clean, channels={**clean.channels, "gyro": gyro}))
    assert check(found, "clock").numbers["duplicate"] == 3.0
    assert next(c for c in found.channels if c.name == "gyro").dropped == {"duplicate": 3, "not_finite": 2}


def test_json_holds_only_what_json_knows(clean: Recording) -> None:
    rows = ({"name": "b", "relative_sigma": 0.01},)
    data = replace(inspect(clean, PELICAN), excitation=rows).to_dict()
    text = json.dumps(data, allow_nan=False)
    assert json.loads(text)["schema"] == "quadid.inspect/1"
    assert data["excitation"] == [{"name": "b", "relative_sigma": 0.01}]
    assert data["checks"][0]["verdict"] == "ok"
    single = Recording("one", "csv", {"battery": Channel("battery", np.array([1.0]), np.array([[12.0]]))})
    assert inspect(single).to_dict()["channels"][0]["rate"] is None


def test_axis_fits_find_any_signed_permutation() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=(400, 3)) * [1.0, 2.0, 0.5]
    y = 2.5 * x[:, [2, 0, 1]] * [1.0, -1.0, -1.0] + 0.01 * rng.normal(size=(400, 3))
    fit = fit_axes(x, y)
    assert (fit.axes, fit.signs) == ((2, 0, 1), (1, -1, -1))
    assert fit.scale == pytest.approx(2.5, rel=1e-2)
    assert fit.r2 > 0.99


@pytest.mark.parametrize(
    ("log", "vehicle"),
    [
        ("nanodrone/chirp_run1.csv", "nanodrone/vehicle.yaml"),
        ("crazyflie_rpm/figure8_30.csv", "crazyflie_rpm/vehicle.yaml"),
        ("crazyflie_rpm/figure8_27_pwm.csv", "crazyflie_rpm/vehicle_pwm.yaml"),
        ("cases/case_014/train.csv", "cases/case_014/vehicle.yaml"),
        ("mcap/crazyflie_rollpitch.mcap", "crazyflie_rpm/vehicle_pwm.yaml"),
    ],
)
def test_real_flights_are_believed_and_their_motors_in_order(data_dir: Path, log: str, vehicle: str) -> None:
    found = inspect(open_log(data_dir / log), Vehicle.from_yaml((data_dir / vehicle).read_text()))
    assert not [c for c in found.checks if c.verdict is CheckResult.ERROR]
    assert check(found, "motor_order").verdict is CheckResult.OK
    assert found.usable


def test_a_crash_ends_the_flight_of_a_real_log(data_dir: Path, happened: Happened) -> None:
    recording = open_log(data_dir / "ardupilot" / "log171.bin")
    spans = inspect(recording, with_command(PELICAN, kind="pwm", max_speed=800.0)).flying
    zero = float(recording.channels["gyro"].t[0])
    assert spans[-1][0] - zero < 83.0
    assert 216.0 < spans[-1][1] - zero < 230.0
    happened(18, "recorded crash (log171.bin): the flying span ends there")


@pytest.mark.parametrize(("profile", "verdict"), [("hover", "unknown"), ("gentle", "ok"), ("excited", "ok")])
def test_a_flight_that_hardly_turns_is_not_called_wrong(profile: str, verdict: str) -> None:
    from quadid.flight import fly

    pelican = Vehicle.shipped("pelican")
    for seed in (1, 2):
        found = inspect(fly(pelican, seconds=40.0, seed=seed, profile=profile).recording, pelican)
        (check,) = (c for c in found.checks if c.name == "gyro_attitude")
        assert check.verdict.value == verdict, check.message


@pytest.mark.parametrize(
    ("spans", "cuts"),
    [
        (((0.0, 60.0),), ()),
        (((1.0, 59.5),), ()),
        (((12.0, 50.0),), ((14.0, 48.0),)),
        (((0.2, 40.0),), ((0.0, 38.0),)),
        (((12.0, 20.0), (20.6, 50.0)), ((14.0, 48.0),)),
        (((5.0, 20.0), (30.0, 60.0)), ((7.0, 18.0), (32.0, 60.0))),
        (((5.0, 8.0), (30.0, 60.0)), ((32.0, 60.0),)),
        ((), ()),
    ],
)
def test_what_is_in_the_air_is_proposed(spans: Spans, cuts: Spans) -> None:
    """Take-off and landing are left out, a short unloading of the rotors is not, nor is a flight cut for a second."""
    later = tuple((a + 100.0, b + 100.0) for a, b in spans)
    assert proposed_cuts(later, 100.0, 160.0) == cuts
