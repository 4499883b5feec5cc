"""A change of flight state is no change of the vehicle: regressors, velocity, and flights of a real autopilot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from quadid_node.recording import stream
from quadid_replay import open_log

from quadid.online.change_job import ChangePoint
from quadid.online.changes import CHUNK, ChangeDetector, ChangeWatch, FlightState, Velocity, step_beside
from quadid.online.fusion import Estimator
from quadid.online.grid_buffer import GridBuffer, Rows
from quadid.online.stream import Resampler
from quadid.rotation import conjugate, rotated
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

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
    resampler = Resampler(vehicle, RATE)
    for count, block in enumerate(stream(open_log(str(log), "auto", vehicle.columns))):
        resampler.push(block)
        while count % 200 == 0 and resampler.busy:
            if (rows := resampler.work()) is not None:
                yield rows


def steps(
    log: Path, file: Path, scale: float = 1.0, at: float = np.inf, velocity: bool = True
) -> list[tuple[float, str, float]]:
    """Changes seen: when [s], channel, size; from `at` [s] on rotors give only `scale` as much for their speed."""
    vehicle = Vehicle.from_yaml(file.read_text())
    store, estimator = GridBuffer(RATE, 60.0), Estimator(vehicle, 60.0, 0)
    supervisor, seen, first, tick = ChangeWatch(vehicle, store), list[tuple[float, str, float]](), 0.0, 0.0
    for rows in rows_of(log, file):
        if rows.fresh:
            first, tick = float(rows.t[0]), np.floor(rows.t[0] + 1.0)
        rows.columns["rotor_speed"][rows.t - first > at] /= np.sqrt(scale)
        if not velocity:
            rows.columns.pop("velocity", None)
        store.add(rows)
        while rows.t[-1] >= tick:
            found = _last(supervisor.look(tick, 1.0, estimator))
            if found is not None:
                seen.append((tick - first, found.channel, found.size))
                supervisor.restart()
            tick += 1.0
    return seen


def _last(work: Iterator[None]) -> ChangePoint | None:
    try:
        while True:
            next(work)
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]


FLIGHTS = [
    pytest.param("x.tlog", "sitl_x.yaml", marks=pytest.mark.slow),
    pytest.param("quad_sq.bin", "quad_sq.yaml", marks=pytest.mark.slow),
    ("quad_sq.tlog", "quad_sq.yaml"),
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
    assert 120.0 < when < 123.5
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


def test_a_step_that_a_regressor_explains_is_none_and_its_doubt_counts() -> None:
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.normal(0.0, 0.004, 60), rng.normal(0.4, 0.02, 8)])[:, None]
    y = 0.25 * x[:, 0] + rng.normal(0.0, 0.002, 68)
    sized = np.array([0.3])
    assert step_beside(y, x, sized, 60, 0.03)[0] < 3.0
    assert step_beside(y, np.zeros_like(x), sized, 60, 0.03)[0] > 7.0, "without the regressor it is a step"
    errors, size = step_beside(y - 0.2 * (np.arange(68) >= 60), x, sized, 60, 0.03)
    assert errors < 7.0, "the coefficient may be that much off"
    assert size == pytest.approx(-0.2, abs=0.1)


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
        assert step_beside(y, x, state.typical, 33, 0.03)[0] < 2.0
        errors, size = step_beside(y - 0.1 * (np.arange(37) >= 33), x, state.typical, 33, 0.03)
        assert errors > 7.0
        assert size == pytest.approx(-0.1, abs=0.02)


def test_what_lasts_in_the_past_is_no_step_now() -> None:
    rng = np.random.default_rng(2)
    walk = np.convolve(rng.normal(0.0, 0.03, 91), np.ones(8) / 2.0, "valid")
    white = rng.permutation(walk)
    nothing = np.zeros((84, 0))
    for y in (walk, white):
        y[80:] = np.median(y[:80]) + 2.2 * 1.4826 * np.median(np.abs(y[:80] - np.median(y[:80])))
    lasting, _ = step_beside(walk, nothing, np.zeros(0), 80, 0.03)
    fresh, _ = step_beside(white, nothing, np.zeros(0), 80, 0.03)
    assert lasting < 0.8 * fresh
