"""A change of flight state is no change of the vehicle: regressors, velocity, and flights of a real autopilot."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from quadid_evaluation.studies.alarms import watched
from quadid_evaluation.studies.autopilot import until
from quadid_node.messages import Output
from quadid_node.recording import play, stream
from quadid_node.service import Service, session_settings
from quadid_node.worker import InlineWorker
from quadid_replay import open_log

from quadid.flight import Segment, draw_truth, fly
from quadid.online import Event, OnlineDiagnosis, Publish
from quadid.online.change_job import ChangeWatch
from quadid.online.changes import CHUNK, ChangeDetector, FlightState, Velocity, learned, step_beside
from quadid.online.fusion import Estimator
from quadid.online.grid_buffer import GridBuffer, Rows
from quadid.online.stream import Resampler
from quadid.rotation import conjugate, rotated
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from tests.samples import gathered

RATE = 50.0


@lru_cache(maxsize=2)
def read(log: Path, vehicle: Path) -> tuple[Rows, ...]:
    """Rows of the grid of the session; tests of one flight that follow each other share them."""
    return tuple(resampled(log, Vehicle.from_yaml(vehicle.read_text())))


def rows_of(log: Path, vehicle: Path) -> Iterator[Rows]:
    """Rows of the grid of the session, with a known attitude all along, which may be written to."""
    for rows in read(log, vehicle):
        yield replace(rows, columns={name: values.copy() for name, values in rows.columns.items()})


def resampled(log: Path, vehicle: Vehicle) -> Iterator[Rows]:
    """Rows as they come."""
    resampler, messages = Resampler(vehicle, RATE), stream(open_log(str(log), "auto", vehicle.columns))
    while portion := list(gathered(islice(messages, 200))):
        for block in portion:
            resampler.push(block)
        while (rows := resampler.next_rows()) is not None:
            yield rows


def steps(
    log: Path, file: Path, scale: float = 1.0, at: float = np.inf, velocity: bool = True
) -> list[tuple[float, str, float]]:
    """Changes seen: when [s], channel, size; from `at` [s] on rotors give only `scale` as much for their speed."""
    vehicle = Vehicle.from_yaml(file.read_text())
    store, estimator = GridBuffer(RATE, 60.0), Estimator(vehicle, 60.0, 10.0, 0)
    supervisor, seen, first, tick = ChangeWatch(vehicle, store), list[tuple[float, str, float]](), 0.0, 0.0
    for rows in rows_of(log, file):
        if rows.fresh:
            first, tick = float(rows.t[0]), np.floor(rows.t[0] + 1.0)
        rows.columns["rotor_speed"][rows.t - first > at] /= np.sqrt(scale)
        if not velocity:
            rows.columns.pop("velocity", None)
        store.add(rows)
        while rows.t[-1] >= tick:
            found = supervisor.look(tick, 1.0, estimator)
            if found is not None:
                seen.append((tick - first, found.channel, found.size))
                supervisor.restart()
            tick += 1.0
    return seen


FLIGHTS = [
    pytest.param("x.tlog", "sitl_x.yaml", marks=pytest.mark.slow),
    pytest.param("quad_sq.bin", "quad_sq.yaml", marks=pytest.mark.slow),
    pytest.param("quad_sq.tlog", "quad_sq.yaml", marks=pytest.mark.slow),
    ("quad_sq_pwm.tlog", "quad_sq_pwm.yaml"),
    ("x_zero_rpm.tlog", "sitl_x_pwm.yaml"),
    ("x.bin", "sitl_x.yaml"),
]
"""Both formats and both frames at once, the others of the two vehicles with the slow tests."""


@pytest.mark.parametrize(("log", "file"), FLIGHTS)
def test_take_off_climbs_manoeuvres_descents_and_landing_are_no_change(log: str, file: str, data_dir: Path) -> None:
    folder = data_dir / "ardupilot_sitl"
    assert steps(folder / log, folder / file) == []


def test_velocity_that_nobody_measures_may_be_off(data_dir: Path) -> None:
    folder = data_dir / "ardupilot_sitl"
    flight = folder / "x_zero_rpm.tlog", folder / "sitl_x_pwm.yaml"
    assert steps(*flight, velocity=False) == []
    found = steps(*flight, 0.85, 120.0, velocity=False)
    assert [channel for _, channel, _ in found] == ["thrust"]
    assert 120.0 < found[0][0] < 123.5


def test_a_wrong_guess_of_the_yaw_inertia_moves_no_moment(data_dir: Path) -> None:
    """Coupling of roll and pitch with yaw: this flight has none, and the guess would make six times what a body may."""
    folder = data_dir / "ardupilot_sitl"
    file = folder / "sitl_x.yaml"
    vehicle = Vehicle.from_yaml(file.read_text())
    detector, seen, first, tick = ChangeDetector(vehicle), [], 0.0, 0.0
    store = GridBuffer(RATE, 60.0)
    for rows in rows_of(folder / "x.bin", file):
        if rows.fresh:
            first, tick = float(rows.t[0]), np.floor(rows.t[0] + 20.0)
        store.add(rows)
        while rows.t[-1] >= tick:
            detector.add(store.span(tick - CHUNK - 1e-6, tick - 1e-6))
            seen.append(detector.look(4.24e-5, np.array([0.023, 0.023, 0.18]), np.array([0.05, 0.05])))
            tick += CHUNK
        if rows.t[0] - first > 70.0:
            break
    assert [s for s in seen if s is not None and s.channel != "thrust"] == []


@pytest.mark.parametrize("scale", [1.0 / 1.15, 1.0 / 0.85, 0.9])
def test_in_the_same_flight_a_real_step_is_seen(scale: float, data_dir: Path) -> None:
    folder = data_dir / "ardupilot_sitl"
    seen = steps(folder / "x.bin", folder / "sitl_x.yaml", scale, 120.0)
    (when, channel, size), *others = seen
    assert not others
    assert channel == "thrust"
    assert 120.0 < when < 125.0
    assert size == pytest.approx(np.log(scale), abs=0.05)


def moving(seconds: float, velocity: bool) -> tuple[Rows, FloatArray]:
    """A tilted, turning vehicle that gathers speed: rows, and its velocity in body axes."""
    t = np.arange(0.0, seconds, 1.0 / RATE)
    q = np.column_stack([np.cos(0.1 * t), 0.2 * np.sin(0.1 * t), 0.1 * np.sin(0.1 * t), np.sin(0.1 * t)])
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    world = np.column_stack([np.sin(t), 0.5 * t, -1.0 + np.cos(t)])
    gained = np.column_stack([np.cos(t), np.full_like(t, 0.5), -np.sin(t)])
    columns = {"attitude": q, "accel": rotated(conjugate(q), gained - [0.0, 0.0, GRAVITY])}
    if velocity:
        columns["velocity"] = np.where(np.arange(len(t))[:, None] % 10 == 0, world, np.nan)
    return Rows(t, columns, "held", ""), rotated(conjugate(q), world)


@pytest.mark.parametrize("measured", [True, False])
def test_velocity_is_measured_or_integrated(measured: bool) -> None:
    rows, truth = moving(3.0, measured)
    np.testing.assert_allclose(Velocity().body(rows), truth, atol=0.02)


def test_without_attitude_velocity_is_not_known() -> None:
    rows, _ = moving(1.0, False)
    blind = Rows(rows.t, {"accel": rows.columns["accel"]}, "held", "")
    assert not Velocity().body(blind).any()


def test_payload_and_weak_motors_of_a_recorded_flight_are_seen_and_nothing_else(data_dir: Path) -> None:
    """Weak motor 3 from 313.6 to 328.6 s, 0.25 kg more from 378.7 to 398.8 s, weak motor 2 from 423.8 s (boot time)."""
    folder = data_dir / "findings" / "ardupilot"
    log, file = folder / "payload_hover_378s_no_alarm.tlog", folder / "mine_pwm.yaml"
    begin = float(next(rows_of(log, file)).t[0])
    truth = np.array([313.6, 328.6, 378.7, 398.8, 423.8]) - begin
    seen = steps(log, file)
    delays = [min(when - at for at in truth if at < when) for when, _, _ in seen]
    assert max(delays) < 5.0
    taken, dropped = ([size for when, _, size in seen if at < when < at + 5.0] for at in truth[2:4])
    assert taken == pytest.approx([-np.log(1.0 + 0.25 / 1.35)], abs=0.03)
    assert dropped == pytest.approx([np.log(1.0 + 0.25 / 1.35)], abs=0.04)


def session_of(log: Path, file: Path, seconds: float = np.inf) -> list[Output]:
    """Outputs of a session that flies the first `seconds` of a recorded flight."""
    vehicle = Vehicle.from_yaml(file.read_text())
    flown = until(stream(open_log(str(log), "auto", vehicle.columns)), seconds)
    return play(Service(vehicle, session_settings("auto", seed=0), InlineWorker()), flown)


def test_each_of_them_is_named_and_so_is_a_recovery(data_dir: Path) -> None:
    """The vehicle is not known yet, or no longer: causes are told apart by the motion before, and by arms."""
    folder = data_dir / "findings" / "ardupilot"
    said = session_of(folder / "payload_hover_378s_no_alarm.tlog", folder / "mine_pwm.yaml")
    found = [one.findings[0] for one in said if isinstance(one, OnlineDiagnosis)]
    load, weak = 0.25 / 1.35, 0.155
    told = [(f.effect, f.values.get("rotor"), f.values.get("loss", f.values.get("fraction"))) for f in found]
    assert [(effect, rotor) for effect, rotor, _ in told] == [
        ("weak_rotor", 3.0),
        ("weak_rotor", 3.0),
        ("mass_change", None),
        ("mass_change", None),
        ("weak_rotor", 2.0),
    ]
    sizes = [weak, -weak / (1.0 - weak), load, -load / (1.0 + load), weak]
    assert [size for *_, size in told] == pytest.approx(sizes, abs=0.03)
    assert "rotor 3 gives 18% more than before: it has recovered" in found[1].evidence


def test_a_first_fit_that_knows_less_than_the_vehicle_file_is_not_believed(data_dir: Path) -> None:
    """At the first sticks after a hover b came out 13 times too large: all that followed was no flight of this one."""
    folder = data_dir / "findings" / "ardupilot"
    said = session_of(folder / "first_sticks_57s_false_pitch_step.tlog", folder / "mine_pwm.yaml", 42.0)
    assert [one.text for one in said if isinstance(one, Event) and one.kind == "not_flying"] == [
        "rotors carry 0% of the weight: on the ground"
    ]
    sets = [one.item for one in said if isinstance(one, Publish) and one.topic == "candidate"]
    assert [s.parameters["b"].value for s in sets] == pytest.approx([1.9386e-5] * len(sets), rel=0.02)
    assert sets


def test_a_step_that_a_regressor_explains_is_none_and_its_doubt_counts() -> None:
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.normal(0.0, 0.004, 60), rng.normal(0.4, 0.02, 8)])[:, None]
    y = 0.25 * x[:, 0] + rng.normal(0.0, 0.002, 68)
    sized = np.array([0.3])
    assert step_beside(y, x, sized, 60, 0.03)[0] < 3.0
    assert step_beside(y, np.zeros_like(x), sized, 60, 0.03)[0] > 7.0, "without the regressor it is a step"
    assert step_beside(y - 0.2 * (np.arange(68) >= 60), x, sized, 60, 0.03)[0] < 5.0, "the coefficient may be so large"


@pytest.mark.parametrize("climb", [4.0, 5.0])
def test_what_follows_a_long_climb_is_no_step_and_a_real_one_is_seen(climb: float) -> None:
    """Nine seconds of one state, to which all others are outliers at first: their regression has to settle."""
    state = FlightState(Vehicle.shipped("pelican"))
    for seed in range(10):
        rng = np.random.default_rng(seed)
        along = np.concatenate([rng.normal(-climb, 0.02, 19), rng.normal(0.0, 0.4, 18)])
        flat = np.concatenate([np.zeros(19), rng.exponential(1.0, 18)])
        speed = 440.0 + np.concatenate([np.zeros(19), rng.normal(0.0, 3.0, 18)])
        drag = np.sqrt(flat + along**2) * along
        x = np.column_stack([-1.0 / speed, along / GRAVITY, flat / GRAVITY, drag / GRAVITY])
        y = x @ [0.0, 0.25, 0.008, 0.03] + rng.normal(0.0, 0.001, 37)
        assert step_beside(y, x, state.typical, 30, 0.03)[0] < 2.0
        errors, size, place = step_beside(y - 0.1 * (np.arange(37) >= 32), x, state.typical, 30, 0.03)
        assert errors > 5.0
        assert size == pytest.approx(-0.1, abs=0.02)
        assert place in (31, 32)


def gusts(count: int, seed: int, memory: float = 0.5) -> FloatArray:
    """Random force with a memory, standard deviation 0.03, shape (count,)."""
    new = 0.03 * np.sqrt(1.0 - memory**2) * np.random.default_rng(seed).standard_normal(count + 50)
    out = np.zeros(count + 50)
    for k in range(1, len(out)):
        out[k] = memory * out[k - 1] + new[k]
    return out[50:]


def test_what_the_autopilot_does_about_a_gust_is_not_learned_as_an_effect_of_the_rotors() -> None:
    """The rotors give way to the gust within the same value, which as a slope would take up half of every step."""
    slopes, found = [], 0
    for seed in range(10):
        force, own = gusts(90, seed), gusts(90, 100 + seed, 0.8)
        x = (own - 0.7 * force)[:, None]
        slopes.append(float(learned(force[:80], x[:80], np.array([1.0]), 0.006).value[1]))
        payload = force - 0.16 * (np.arange(90) >= 81)
        found += step_beside(payload, x, np.array([1.0]), 80, 0.03)[0] > 5.0
        assert step_beside(force, x, np.array([1.0]), 80, 0.03)[0] < 4.0
    assert abs(np.mean(slopes)) < 0.25
    assert found == 10


@pytest.mark.parametrize(("memory", "large"), [(0.0, 10.0), (0.5, 8.0), (0.9, 8.0)])
def test_a_step_counts_by_the_memory_of_the_random_forces(memory: float, large: float) -> None:
    nothing, told = np.zeros((90, 0)), []
    for seed in range(10):
        force = gusts(90, seed, memory)
        told.append(step_beside(force - 0.15 * (np.arange(90) >= 80), nothing, np.zeros(0), 78, 0.03)[0])
        assert step_beside(force, nothing, np.zeros(0), 78, 0.03)[0] < 4.5
    assert 0.6 * large < np.median(told) < 1.6 * large


def test_forces_larger_than_those_that_were_learned_are_no_step() -> None:
    for seed in range(20):
        force = gusts(90, seed)
        force[80:] *= 4.0
        assert step_beside(force, np.zeros((90, 0)), np.zeros(0), 80, 0.03)[0] < 5.0


def test_one_odd_value_is_no_step() -> None:
    for place in range(80, 90):
        force = gusts(90, 3)
        force[place] += 1.0
        assert step_beside(force, np.zeros((90, 0)), np.zeros(0), 80, 0.03)[0] < 5.0


@pytest.mark.parametrize("name", ["hummingbird", "pelican_x", "pelican"])
def test_first_sticks_after_a_hover_are_no_step_of_a_moment(name: str) -> None:
    """Rotors follow commands 35 ms late, which forty seconds of calm hover did not show."""
    vehicle = Vehicle.shipped(name)
    sticks = [Segment("roll", "doublet", 41.0, 1.5, 0.35), Segment("pitch", "doublet", 43.0, 1.5, 0.35)]
    effects = {"motor_lag": {"tau": 0.035}, "rotor_drag": {"k_x": 0.3, "k_y": 0.2}, "axial_inflow": {"k_z": 0.3}}
    flight = fly(vehicle, draw_truth(vehicle, 7001), 48.0, 7001, "scripted", segments=sticks, effects=effects)
    assert list(watched(vehicle, flight, 7001)) == []


def test_a_row_of_stopped_rotors_is_left_out() -> None:
    vehicle, rows = Vehicle.shipped("pelican"), 25
    speed = np.full((rows, 4), vehicle.hover_speed())
    speed[7] = 0.0
    columns = {"rotor_speed": speed, "gyro": np.zeros((rows, 3)), "accel": np.tile([0.0, 0.0, -GRAVITY], (rows, 1))}
    with np.errstate(divide="raise", invalid="raise"):
        chunk = ChangeDetector(vehicle).chunk(Rows(np.arange(rows) / RATE, columns, "held", ""))
    assert chunk is not None
    assert np.isfinite([chunk.thrust, chunk.shared, chunk.power]).all()
