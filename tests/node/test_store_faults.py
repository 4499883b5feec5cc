"""The history under real faults: a full disk, a read-only one, a lock held elsewhere, bytes overwritten in flight."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_node.codec import set_to_dict
from quadid_node.history import Store
from quadid_node.publication import Output
from quadid_node.service import Service
from quadid_node.store_file import StoreError, read_history
from quadid_node.worker import InlineWorker

from quadid.condition.trim import FlightTrim
from quadid.online import SessionSettings, SetState
from quadid.online.records import Event, OnlineSet
from quadid.vehicle import Vehicle
from quadid_node import history as store_module
from tests.faults.evidence import Happened
from tests.online.driving import flight, samples
from tests.online.test_gate import TRUE, online_set

PELICAN = Vehicle.shipped("pelican")


def until(done: Callable[[], object], seconds: float = 60.0) -> bool:
    deadline = time.monotonic() + seconds
    while not done() and time.monotonic() < deadline:
        time.sleep(0.02)
    return bool(done())


def mount(where: Path, options: str) -> None:
    where.mkdir(exist_ok=True)
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(where)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        pytest.skip(f"this machine does not let us mount: {done.stderr.strip()}")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 400 KiB."""
    where = tmp_path / "disk"
    mount(where, "size=400k")
    yield where
    subprocess.run(["umount", "-l", str(where)], check=False)


def in_force(sequence: int) -> OnlineSet:
    return replace(online_set(TRUE), sequence=sequence, approved_by="auto")


def test_a_disk_that_is_full_is_said_and_what_came_meanwhile_is_written_later(
    small_disk: Path, happened: Happened
) -> None:
    path = small_disk / "h.sqlite"
    store = Store(path, "pelican")
    store.numbered(in_force(1))
    assert until(lambda: len(read_history(path, "pelican")["sets"]) == 1)
    filler = small_disk / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(b"x" * 4096)
    service = Service(PELICAN, SessionSettings(window=5.0, diagnose=0.0), InlineWorker(), store)
    for sample in samples(flight(8.0, 6).recording):
        service.push(sample)
    said: list[Output] = []
    while service.session.running is not None or not service.session.status().fits:
        said += service.step()
    for k in range(20):
        store.event(Event(float(k), "info", "test", "x" * 2000))
    assert until(lambda: store.problem)
    assert "full" in store.problem or "I/O" in store.problem
    said += service.step()
    assert any(isinstance(o, Event) and o.kind == "history" and o.level == "error" for o in said)
    assert service.session.status().fits > 0, "the session went on"
    assert read_history(path, "pelican")["sets"][0]["sequence"] == 1, "what is there can be read"
    problem = store.problem.split("(", 1)[-1].split(")")[0]
    filler.unlink()
    assert until(lambda: not store.problem)
    store.close(60.0)
    assert len(read_history(path, "pelican", events=100)["events"]) >= 20
    happened(
        12,
        f"disk of 400 KiB really full: fits went on, said '{problem}', old sets readable; with room again everything "
        "kept in memory was written",
    )


def test_a_read_only_home_is_said_and_the_service_goes_on(tmp_path: Path, happened: Happened) -> None:
    home = tmp_path / "home"
    mount(home, "size=400k,ro")
    try:
        store = Store(home / "deep" / "h.sqlite", "pelican")
        assert "cannot be written (Read-only file system)" in store.problem
        service = Service(PELICAN, SessionSettings(), InlineWorker(), store)
        assert any(isinstance(o, Event) and "Read-only" in o.text for o in service.step())
        store.numbered(in_force(1))
        store.close()
    finally:
        subprocess.run(["umount", "-l", str(home)], check=False)
    happened(12, "read-only file system: the service starts and says that this run's history is lost")


def test_a_lock_held_by_another_program_delays_and_loses_nothing(tmp_path: Path, happened: Happened) -> None:
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    code = (
        "import sqlite3, sys; db = sqlite3.connect(sys.argv[1]); db.execute('BEGIN EXCLUSIVE')\n"
        "print('locked', flush=True); sys.stdin.read(); db.rollback()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdin is not None
        assert other.stdout.readline() == "locked\n"
        for k in range(300):
            store.event(Event(float(k), "info", "test", "while locked"))
        store.numbered(in_force(1))
        assert until(lambda: "locked" in store.problem)
        other.stdin.close()
    assert until(lambda: not store.problem)
    store.close(60.0)
    found = read_history(path, "pelican", events=500)
    assert (len(found["events"]), len(found["sets"])) == (300, 1)
    happened(12, "locked by another process for over 5 s: said; all 300 events and the set were written afterwards")


@pytest.mark.parametrize("damage", ["pages", "head", "removed"])
def test_damage_while_running_sets_the_file_aside_and_the_new_one_has_the_set_in_force(
    tmp_path: Path, damage: str, happened: Happened
) -> None:
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    for k in range(40):
        store.numbered(in_force(k + 1))
    assert until(lambda: len(read_history(path, "pelican")["sets"]) == 40)
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    before = path.read_bytes()
    if damage == "removed":
        path.unlink()
    else:
        keep = 0 if damage == "head" else 4096
        path.write_bytes(before[:keep] + os.urandom(len(before) - keep))
    service = Service(PELICAN, SessionSettings(), InlineWorker(), store)
    for k in range(10):
        store.event(Event(float(k), "info", "test", "after"))
    assert until(lambda: len(_events(path)) >= 10), store.problem
    assert until(lambda: not store.problem)
    aside = [p for p in tmp_path.iterdir() if ".damaged-" in p.name and not p.name.endswith(("-wal", "-shm"))]
    if damage != "removed":
        assert [p.stat().st_size for p in aside] == [len(before)], "set aside as it was"
        assert any(isinstance(o, Event) and "set aside" in o.text for o in service.step())
    store.close(60.0)
    again = Store(path, "pelican")
    restored = again.restore()
    again.close()
    assert restored.item is not None
    assert (restored.item.sequence, restored.item.state) == (40, SetState.ACCEPTED)
    what = "new file" if damage == "removed" else "set aside whole, said"
    happened(12, f"history damaged in service ({damage}): {what}; the new one begins with the set in force")


TRIM = FlightTrim("log1", np.full(4, 0.1), np.full((2, 4), 0.1), np.full(4, 0.25), np.full(4, 0.01), 30.0, "made up")


def test_what_people_decided_outlives_a_history_damaged_in_service(tmp_path: Path, happened: Happened) -> None:
    """A new file began with the set in force alone: approval was automatic again, creeping counted from that set."""
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    service = Service(PELICAN, SessionSettings(), InlineWorker(), store)
    store.numbered(replace(online_set(TRUE), sequence=1000, approved_by="ann"))
    store.healthy_flight(TRIM)
    assert service.decide_approval("manual").done
    service.close()

    store = Store(path, "pelican")
    service = Service(PELICAN, SessionSettings(), InlineWorker(), store)
    stale = service.session.active_set.in_force
    assert stale is not None
    confirmed = replace(stale, state=SetState.ACCEPTED, approved_by="auto", sequence=stale.sequence + 1)
    withdrawn = replace(confirmed, sequence=stale.sequence + 2, outdated="thrust stepped", outdated_code="thrust_drop")
    store.numbered(confirmed)
    store.numbered(withdrawn)
    assert store.flush(10.0)
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    path.write_bytes(b"no history" * 1000)
    store.event(Event(1.0, "info", "test", "after"))
    assert store.flush(60.0)
    service.close()
    assert any("set aside" in note for note in store.notes)

    store = Store(path, "pelican")
    restored = store.restore()
    store.close()
    assert restored.approval == "manual"
    assert restored.baseline is not None
    assert (restored.baseline.sequence, restored.baseline.approved_by) == (1000, "ann")
    assert restored.item is not None
    assert (restored.item.sequence, restored.item.outdated) == (withdrawn.sequence, "thrust stepped")
    assert restored.item.outdated_code == "thrust_drop"
    assert [flight.name for flight in restored.healthy] == [TRIM.name]
    happened(24, "history damaged in service: mode, approved set, withdrawal and healthy flights are in the new one")


def test_a_history_that_could_not_be_made_at_first_is_told_to_be_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(store_module, "make_tables", full)
        store = Store(tmp_path / "h.sqlite", "pelican")
    service = Service(PELICAN, SessionSettings(), InlineWorker(), store)
    assert any(isinstance(o, Event) and "full" in o.text for o in service.step())
    store.numbered(in_force(7))
    assert store.flush(10.0)
    assert any(isinstance(o, Event) and "written again" in o.text for o in service.step())
    service.close()


def _events(path: Path) -> list[object]:
    try:
        with sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True) as db:
            return db.execute("SELECT id FROM events").fetchall()
    except sqlite3.Error:
        return []


def kept(path: Path) -> None:
    """A history with one set."""
    store = Store(path, "v")
    store.numbered(online_set(TRUE))
    assert store.flush(10.0)
    store.close()


def with_all(**fields: object) -> str:
    """A set as JSON, with other fields of its own."""
    return json.dumps({**set_to_dict(online_set(TRUE)), **fields})


def with_first(**fields: object) -> str:
    """A set as JSON, with other fields in its first parameter."""
    data = set_to_dict(online_set(TRUE))
    data["parameters"][0].update(fields)
    return json.dumps(data)


HOSTILE_SETS = {
    "100,000 brackets": "[" * 100_000, "a list": "[]", "nothing": "null", "a number": "7",
    "a value of 400 digits": with_first(value=10**400),
    "an infinite number": with_first().replace('"samples": ', '"samples": 1e999, "old": '),
    "one bound": with_first(bounds=[1.0]), "no interval": with_first(ci95=[]), "no b": with_first(name="c"),
    "a mass of 400 digits": with_all(mass=10**400),
    "a number beyond 64 bits": with_all(sequence=2**64), "another set's number": with_all(sequence=8),
    "a negative deviation": with_first(sigma=-2e-4),
    "a covariance of no numbers": with_all(covariance=[[math.nan] * 6] * 6),
    "a parameter twice": with_all(parameters=2 * set_to_dict(online_set(TRUE))["parameters"], covariance=None),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE_SETS)
def test_a_set_that_none_wrote_is_left_out_and_said(tmp_path: Path, what: str, happened: Happened) -> None:
    path = tmp_path / "h.sqlite"
    kept(path)
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute("UPDATE sets SET data = ?", (HOSTILE_SETS[what],))
    with contextlib.suppress(StoreError):
        read_history(path, "v")
    store = Store(path, "v")
    restored = store.restore()
    assert restored.item is None
    assert restored.baseline is None
    assert "is no set and is not taken up again" in store.notes[0]
    store.close()
    happened(12, f"a row of the history that holds {what}: '{store.notes[0][:90]}'")


HOSTILE_TO_A_VEHICLE = {
    "a negative mass": with_all(mass=-3.0), "a mass that no float of 32 bits holds": with_all(mass=1e300),
    "b far outside the vehicle's bounds": with_first(value=1.0, bounds=[0.5, 2.0]),
    "a deviation that no float of 32 bits holds": with_first(sigma=1e300),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE_TO_A_VEHICLE)
def test_a_set_that_this_vehicle_cannot_have_is_left_out_and_said(
    tmp_path: Path, what: str, happened: Happened
) -> None:
    """It was judged by the bounds that it gave itself; a mass of 1e300 ended the link that told it."""
    path = tmp_path / "h.sqlite"
    kept(path)
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute("UPDATE sets SET data = ?", (HOSTILE_TO_A_VEHICLE[what],))
    store = Store(path, "v")
    assert store.restore(vehicle=PELICAN).item is None
    assert "is no set and is not taken up again" in store.notes[0]
    store.close()
    happened(25, f"a stored set with {what}: '{store.notes[0][50:140]}'")


ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
HOSTILE_FILES = {
    "a trigger that deletes": "CREATE TRIGGER t AFTER INSERT ON sets BEGIN DELETE FROM sets; END",
    "a trigger that never ends": "CREATE TRIGGER t AFTER INSERT ON sets BEGIN INSERT INTO events "
    f"(vehicle, level, kind, text, wall) {ENDLESS} SELECT 'v', '', '', x, 1 FROM c; END",
    "a view without end": "DROP TABLE sets; CREATE VIEW sets AS " + ENDLESS + " SELECT 'v' AS vehicle, x AS sequence, "
    "'accepted' AS state, '' AS reason, '' AS approved_by, 1 AS stop, 1 AS wall, '{}' AS data FROM c",
    "an index that computes": "CREATE INDEX i ON sets (hex(zeroblob(100000000)))",
    "an index that refuses": "CREATE UNIQUE INDEX i ON sets (length(vehicle) > 0)",
    "a condition that computes": "DROP TABLE sets; CREATE TABLE Sets (vehicle TEXT NOT NULL, "
    "sequence INTEGER NOT NULL, state TEXT NOT NULL, reason TEXT NOT NULL, approved_by TEXT NOT NULL, stop REAL, "
    "wall REAL NOT NULL, data TEXT NOT NULL CHECK (length(hex(zeroblob(400000000))) > 0))",
    "a computed column": "ALTER TABLE sets DROP COLUMN data; ALTER TABLE sets ADD COLUMN data TEXT GENERATED ALWAYS AS "
    "(hex(zeroblob(400000000)))",
}


@pytest.mark.parametrize("what", HOSTILE_FILES)
def test_a_file_that_computes_is_set_aside(tmp_path: Path, what: str, happened: Happened) -> None:
    """A trigger could take away what was said to be on the disk; a view need not end."""
    path = tmp_path / "h.sqlite"
    kept(path)
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.executescript(HOSTILE_FILES[what])
    with pytest.raises(StoreError, match="malformed"):
        read_history(path, "v")
    store = Store(path, "v")
    assert "set aside" in store.notes[0]
    store.numbered(online_set(TRUE))
    assert store.flush(10.0)
    assert [entry["sequence"] for entry in read_history(path, "v")["sets"]] == [online_set(TRUE).sequence]
    store.close()
    happened(12, f"a history with {what}: '{store.notes[0][:90]}'")


def test_an_approval_that_is_none_is_taken_for_manual(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    kept(path)
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute("INSERT INTO decisions (vehicle, configured, approval, wall) VALUES ('v', 'auto', 'yes', 1)")
    store = Store(path, "v")
    assert store.restore().approval == "manual"
    store.close()
