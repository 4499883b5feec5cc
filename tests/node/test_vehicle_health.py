"""Health in the service: a baseline grows in the history, survives a restart, and a damaged rotor is named and told."""

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from quadid_evaluation.studies.health.flights import Wrong, hover_blocks
from quadid_node.history import Store
from quadid_node.messages import Output, health_message, health_to_dict
from quadid_node.service import Service
from quadid_node.worker import InlineWorker

from quadid.condition.trim import flight_from_dict, flight_to_dict
from quadid.condition.watch import ENOUGH, HealthReport
from quadid.online import Event, SessionSettings
from quadid.online.records import HealthyFlight
from quadid.vehicle import Vehicle
from tests.samples import Sample, flat

PELICAN_X = Vehicle.shipped("pelican_x")
SETTINGS = SessionSettings(rate=25.0, window=60.0, refit=60.0, diagnose=0.0)
RATE = 25


def flown(seed: int, begin: float, seconds: int = 40, wrong: Wrong | None = None, onset: int = 0) -> Iterator[Sample]:
    """A hover with 6 s on the ground before and after; from `begin` [s] on."""
    yield from flat(hover_blocks(PELICAN_X, begin, seconds, np.random.default_rng(seed), wrong, onset, RATE))


def served(service: Service, samples: Iterator[Sample]) -> list[Output]:
    out: list[Output] = []
    for k, sample in enumerate(samples):
        service.push(sample.block)
        if k % 100 == 0:
            out += service.step()
    return out + service.step()


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A history with healthy flights, each of a run of its own."""
    path = tmp_path_factory.mktemp("health") / "history.sqlite"
    for k in range(ENOUGH + 1):
        store = Store(path, PELICAN_X.name)
        service = Service(PELICAN_X, SETTINGS, InlineWorker(), store)
        assert len(service.restored.healthy) == k
        out = served(service, flown(k, 1.7e9 + 1000 * k))
        reports = [o for o in out if isinstance(o, HealthReport)]
        assert reports[0].has_baseline == (k >= ENOUGH)
        assert all(r.verdict != "changed" for r in reports)
        assert sum(isinstance(o, HealthyFlight) for o in out) == 1
        if k == 0:
            events = [o.text for o in out if isinstance(o, Event) and o.kind == "health"]
            assert events == [f"no baseline: 0 of {ENOUGH} healthy flights are known; this flight becomes one"]
        service.close()
    return path


def test_healthy_flights_are_on_the_disk(history: Path) -> None:
    with sqlite3.connect(history) as db:
        rows = db.execute("SELECT data FROM healthy_flights").fetchall()
    flights = [flight_from_dict(json.loads(data)) for (data,) in rows]
    assert len(flights) == ENOUGH + 1
    assert all(30.0 <= flight.seconds <= 40.0 for flight in flights)
    again = flight_from_dict(json.loads(json.dumps(flight_to_dict(flights[0]))))
    np.testing.assert_array_equal(again.parts, flights[0].parts)


def test_a_loss_of_a_tenth_is_named_within_five_seconds_of_its_onset(history: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.sqlite"
    copy.write_bytes(history.read_bytes())
    service = Service(PELICAN_X, SETTINGS, InlineWorker(), Store(copy, PELICAN_X.name))
    out = served(service, flown(77, 1.8e9, wrong=Wrong({2: 0.1}, {2: 0.1}), onset=30))
    alarm = next(o for o in out if isinstance(o, HealthReport) and o.verdict == "changed")
    onset = 1.8e9 + 6 + 30
    assert 0.0 < alarm.t - onset <= 5.0
    assert [c.effect for c in alarm.changes] == ["weak_rotor"]
    assert alarm.rotor_loss[1] == pytest.approx(0.1, abs=0.03)
    warnings = [o.text for o in out if isinstance(o, Event) and o.kind == "health" and o.level == "warning"]
    assert len(warnings) == 1
    assert warnings[0].startswith("For the same command rotor 2 produces 10 % less thrust")
    assert not any(isinstance(o, HealthyFlight) for o in out), "a damaged flight is no baseline"
    before = next(o for o in out if isinstance(o, HealthReport) and o.has_baseline)
    message = health_message(before, "quad1")
    assert message["mass_lower"] < message["mass"] < message["mass_upper"]
    assert message["mass"] == pytest.approx(PELICAN_X.mass, rel=0.05)
    message = health_message(alarm, "quad1")
    assert (message["verdict"], message["has_baseline"]) == (1, True)
    assert message["changes"][0]["parameter_values"][0] == 2.0
    assert message["rotor_loss_lower"][1] < message["rotor_loss"][1] < message["rotor_loss_upper"][1]
    assert json.loads(json.dumps(health_to_dict(alarm)))["changes"][0]["effect"] == "weak_rotor"
    service.close()


def test_a_spoilt_row_of_the_history_is_told_and_left_out(history: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.sqlite"
    copy.write_bytes(history.read_bytes())
    with sqlite3.connect(copy) as db:
        db.execute("UPDATE healthy_flights SET data = '{\"mean\": [1]}' WHERE id = 2")
    store = Store(copy, PELICAN_X.name)
    assert len(store.restore().healthy) == ENOUGH
    assert any("healthy flight" in note for note in store.notes)
    store.close(60.0)
