"""Health in flight: a loss is named within five seconds, healthy hours stay quiet, a missing baseline is told."""

from __future__ import annotations

import numpy as np
import pytest
from quadid_evaluation.studies.health.flights import Wrong, hover_seconds
from quadid_evaluation.studies.health.hours import alarms, named, practised

from quadid.condition.watch import ENOUGH, HealthWatch
from quadid.vehicle import Command, Vehicle

PELICAN_X = Vehicle.shipped("pelican_x")


@pytest.mark.parametrize("rotor", range(4))
def test_a_loss_of_a_tenth_is_named_within_five_seconds(rotor: int) -> None:
    rng = np.random.default_rng(rotor)
    found = named(practised(rng), rng, rotor, 0.1)
    assert found is not None
    assert found[0] <= 5.0
    assert found[1] == rotor + 1


def test_hours_of_healthy_hover_raise_no_alarm() -> None:
    rng = np.random.default_rng(3)
    watch = practised(rng)
    assert sum(alarms(watch, rng, 600) for _ in range(12)) == 0


def test_without_a_baseline_it_says_so_with_the_first_second_and_flights_become_one() -> None:
    rng = np.random.default_rng(1)
    watch = HealthWatch(PELICAN_X)
    for flight in range(ENOUGH + 1):
        reports = [watch.second(float(t), *one) for t, one in enumerate(hover_seconds(PELICAN_X, 60, rng))]
        first = next(r for r in reports if r is not None)
        assert first.has_baseline == (flight >= ENOUGH)
        if flight < ENOUGH:
            assert reports[0] is first
            assert first.verdict == "unknown"
            assert f"{flight} of {ENOUGH}" in first.text
        assert watch.landed() is not None
    assert len(watch.history) == ENOUGH + 1


def test_a_damaged_or_short_flight_never_becomes_healthy_history() -> None:
    rng = np.random.default_rng(2)
    watch = practised(rng)
    before = len(watch.history)
    assert named(watch, rng, 0, 0.2) is not None
    for t, one in enumerate(hover_seconds(PELICAN_X, 20, rng)):
        watch.second(float(t), *one)
    assert watch.landed() is None
    assert len(watch.history) == before


def test_a_vehicle_that_comes_back_damaged_is_found_from_its_history() -> None:
    rng = np.random.default_rng(4)
    watch = practised(rng)
    damaged = hover_seconds(PELICAN_X, 20, rng, wrong=Wrong({3: 0.25}, {3: 0.25}))
    reports = [watch.second(float(t), *one) for t, one in enumerate(damaged)]
    alarm = next(r for r in reports if r is not None and r.verdict == "changed")
    assert alarm.t <= 5.0
    assert alarm.changes[0].parameters[0][2] == 3.0
    assert alarm.rotor_loss[2] == pytest.approx(0.25, abs=0.05)
    assert alarm.rotor_interval[2][0] < alarm.rotor_loss[2] < alarm.rotor_interval[2][1]
    assert np.isnan(alarm.mass).all(), "a rotor that lost thrust says nothing of mass"


def test_mass_is_told_by_the_thrust_of_the_baseline() -> None:
    rng = np.random.default_rng(6)
    watch = practised(rng)
    loaded = hover_seconds(PELICAN_X, 20, rng, wrong=Wrong(mass=0.15 * PELICAN_X.mass))
    reports = [r for t, one in enumerate(loaded) if (r := watch.second(float(t), *one)) is not None]
    value, low, high = reports[-1].mass
    assert low < 1.15 * PELICAN_X.mass < high
    assert value == pytest.approx(1.15 * PELICAN_X.mass, rel=0.03)
    commanded = PELICAN_X.model_copy(update={"command": Command(kind="normalized", max_speed=900.0)})
    other = HealthWatch(commanded, watch.history)
    told = [other.second(float(t), *one) for t, one in enumerate(hover_seconds(PELICAN_X, 5, rng))]
    assert all(np.isnan(r.mass).all() for r in told if r is not None), "commands sag with the battery"


def test_what_differs_within_healthy_flights_is_no_change() -> None:
    rng = np.random.default_rng(7)
    watch = practised(rng)
    told = [watch.second(float(t), *one) for t, one in enumerate(hover_seconds(PELICAN_X, 40, rng))]
    assert {(r.verdict, r.changes) for r in told if r is not None} == {("unchanged", ())}


def test_seconds_that_are_no_steady_flight_are_passed_over() -> None:
    watch = HealthWatch(PELICAN_X)
    load = np.full(4, 1.5e5)
    assert watch.second(1.0, load, 14.0) is None
    assert watch.second(2.0, np.array([0.0, 1.0, 1.0, 1.0]), 9.8) is None
    assert watch.airborne(load)
    assert not watch.airborne(0.2 * load)
