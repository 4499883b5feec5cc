"""The history: what was journalled comes back, whatever happens to the file, the disk, or a second service."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_node.codec import set_from_dict, set_to_dict
from quadid_node.history import Store
from quadid_node.store_file import StoreError, connect, read_history

from quadid.online.active_set import ActiveSet
from quadid.online.records import Event, OnlineDiagnosis, OnlineFinding, Publish, SetState
from tests.faults.evidence import Happened
from tests.online.test_gate import TRUE, online_set


def filled(path: Path, sets: int = 2) -> Store:
    store = Store(path, "pelican")
    for k in range(sets):
        item = replace(
            online_set({**TRUE, "b": 2.3e-5 + 1e-7 * k}), sequence=k + 1, approved_by="auto", check="approval"
        )
        store.candidate(item)
        store.numbered(item)
    store.event(Event(30.0, "warning", "change", "thrust stepped"))
    finding = OnlineFinding(
        "mass_change", {"fraction": 0.15}, {"fraction": 0.01}, {"fraction": ""}, 3.0, 1.0, 1e-9, (), "seen"
    )
    store.diagnosis(OnlineDiagnosis(44.0, 40.0, 44.0, (finding,), "explained"))
    return store


def test_a_set_survives_the_round_trip_bit_for_bit() -> None:
    item = replace(online_set(TRUE), mse=float("nan"), approved_by="ann", input_hash="ab" * 32)
    back = set_from_dict(set_to_dict(item))
    assert back.parameters.values.tobytes() == item.parameters.values.tobytes()
    assert back.parameters.covariance.tobytes() == item.parameters.covariance.tobytes()
    assert np.isnan(back.mse)
    assert replace(back, parameters=item.parameters, mse=0.0, mse_held_out=0.0, mass=1.3) == replace(
        item, mse=0.0, mse_held_out=0.0, mass=1.3
    )


def test_everything_is_there_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "history.sqlite"
    filled(path).close()
    store = Store(path, "pelican")
    restored = store.restore()
    store.close()
    assert restored.item is not None
    assert restored.item.parameters["b"].value == 2.3e-5 + 1e-7
    assert restored.next_sequence > 3, "above the known ones, and above those of a history that may be lost"
    assert restored.baseline is not None
    assert restored.baseline.sequence == 1
    found = read_history(path, "pelican", candidates=10, events=10)
    assert [s["sequence"] for s in found["sets"]] == [1, 2]
    assert [c["check"] for c in found["candidates"]] == ["approval", "approval"]
    assert [e["kind"] for e in found["events"]] == ["change", "diagnosis"]


def test_a_set_known_to_be_out_of_date_is_still_so_after_two_restarts(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    filled(path).close()
    for run in range(3):
        store = Store(path, "pelican")
        found = store.restore()
        sets = ActiveSet("auto", found.item, found.next_sequence)
        assert sets.in_force is not None
        assert bool(sets.in_force.outdated) == (run > 0)
        store.numbered(sets.in_force)
        for action in sets.withdraw("mass +15 %", "mass_change"):
            assert isinstance(action, Publish)
            store.numbered(action.item)
        store.close()
    store = Store(path, "pelican")
    store.numbered(replace(online_set(TRUE), sequence=found.next_sequence + 10, approved_by="auto"))
    store.flush(5.0)
    item = store.restore().item
    store.close()
    assert item is not None
    assert not item.outdated


def test_the_baseline_is_the_last_set_a_person_approved(tmp_path: Path) -> None:
    store = filled(tmp_path / "h.sqlite")
    store.numbered(replace(online_set(TRUE), sequence=3, approved_by="ann"))
    store.numbered(replace(online_set(TRUE), sequence=4, approved_by="auto"))
    store.close()
    again = Store(tmp_path / "h.sqlite", "pelican")
    baseline = again.restore().baseline
    again.close()
    assert baseline is not None
    assert baseline.sequence == 3


def test_every_set_stands_with_the_run_that_numbered_it(tmp_path: Path) -> None:
    """Also where a file that was lost is begun anew with the sets of earlier runs."""
    path = tmp_path / "h.sqlite"
    first = filled(path, sets=1)
    first.close()
    second = Store(path, "pelican")
    assert second.restore().item is not None
    second.numbered(replace(online_set(TRUE), sequence=9, approved_by="auto"))
    second.close()
    assert second.boot_id != first.boot_id
    told = [(s["sequence"], s["boot_id"]) for s in read_history(path, "pelican")["sets"]]
    assert told == [(1, first.boot_id), (9, second.boot_id)]
    third = Store(path, "pelican")
    third.restore()
    for name in tmp_path.iterdir():
        name.write_bytes(b"")
    third.numbered(replace(online_set(TRUE), sequence=10, approved_by="auto"))
    assert third.flush(20.0)
    third.close()
    told = [(s["sequence"], s["boot_id"]) for s in read_history(path, "pelican")["sets"]]
    assert told == [(1, first.boot_id), (10, third.boot_id)]


def test_a_second_service_on_one_vehicle_is_refused(tmp_path: Path) -> None:
    first = filled(tmp_path / "h.sqlite")
    with pytest.raises(StoreError, match="another service"):
        Store(tmp_path / "h.sqlite", "pelican")
    other = Store(tmp_path / "h.sqlite", "hexacopter")
    other.numbered(replace(online_set(TRUE), sequence=1, approved_by="auto"))
    other.close()
    first.close()
    Store(tmp_path / "h.sqlite", "pelican").close()
    assert {v["name"] for v in read_history(tmp_path / "h.sqlite", "pelican")["vehicles"]} == {"pelican", "hexacopter"}


@pytest.mark.parametrize("damage", ["garbage", "zeros", "truncated", "empty page"])
def test_a_damaged_history_is_set_aside_not_deleted(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "h.sqlite"
    filled(path, sets=40).close()
    data = path.read_bytes()
    broken = {
        "garbage": os.urandom(len(data)),
        "zeros": bytes(len(data)),
        "truncated": data[: len(data) // 3],
        "empty page": data[:4096] + bytes(4096) + data[8192:],
    }[damage]
    path.write_bytes(broken)
    store = Store(path, "pelican")
    assert not store.problem
    if damage != "zeros":  # a file of zeros is an empty database to SQLite
        assert "set aside" in store.notes[0]
        (aside,) = [p for p in tmp_path.iterdir() if ".damaged-" in p.name and not p.name.endswith(("-wal", "-shm"))]
        assert aside.read_bytes() == broken
    store.numbered(replace(online_set(TRUE), sequence=1, approved_by="auto"))
    store.close()
    assert [s["sequence"] for s in read_history(path, "pelican")["sets"]] == [1]


def test_a_locked_database_is_waited_for_without_blocking(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    store = filled(path)
    time.sleep(0.3)
    holder = sqlite3.connect(path)
    holder.execute("BEGIN EXCLUSIVE")
    begin = time.monotonic()
    for k in range(200):
        store.event(Event(float(k), "info", "test", "while locked"))
    assert time.monotonic() - begin < 0.2
    holder.rollback()
    holder.close()
    store.close(seconds=8.0)
    assert len(read_history(path, "pelican", events=500)["events"]) == 202


def test_a_full_disk_is_told_and_later_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import quadid_node.history as storing

    store = filled(tmp_path / "h.sqlite")
    time.sleep(0.3)
    real = connect

    def full(path: Path, read_only: bool = False) -> sqlite3.Connection:
        db = real(path, read_only)
        db.execute("PRAGMA max_page_count = 1")  # SQLite's own "database or disk is full"
        return db

    monkeypatch.setattr(storing, "connect", full)
    for k in range(50):
        store.event(Event(float(k), "info", "test", "x" * 4000))
    deadline = time.monotonic() + 5.0
    while not store.problem and time.monotonic() < deadline:
        time.sleep(0.02)
    assert "full" in store.problem
    monkeypatch.setattr(storing, "connect", real)
    store.event(Event(99.0, "info", "test", "room again"))
    store.close(seconds=5.0)
    assert store.problem == ""
    assert len(read_history(tmp_path / "h.sqlite", "pelican", events=500)["events"]) == 53


def test_a_place_that_cannot_be_written_is_told_and_the_service_goes_on(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    store = Store(blocked / "h.sqlite", "pelican")
    assert "cannot be written" in store.problem
    store.event(Event(1.0, "info", "test", "nowhere"))
    assert store.restore().item is None
    store.close()


def test_hostile_names_and_texts_are_only_text(tmp_path: Path, happened: Happened) -> None:
    name = "x'); DROP TABLE sets; --\x00\x1b[31m<script>"
    store = Store(tmp_path / "h.sqlite", name)
    store.numbered(replace(online_set(TRUE), sequence=1, reason="'; DELETE FROM sets; --", approved_by="auto"))
    store.close()
    assert [s["reason"] for s in read_history(tmp_path / "h.sqlite", name)["sets"]] == ["'; DELETE FROM sets; --"]
    happened(20, "vehicle name with SQL, NUL, ANSI and HTML: stored and found again as text, no statement run")


def test_a_power_cut_leaves_the_last_committed_set(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    code = (
        "import sys, time, os\n"
        "from pathlib import Path\n"
        "from dataclasses import replace\n"
        "from quadid_node.history import Store\n"
        "from tests.online.test_gate import TRUE, online_set\n"
        "store = Store(Path(sys.argv[1]), 'pelican')\n"
        "for k in range(100000):\n"
        "    store.numbered(replace(online_set(TRUE), sequence=k + 1, approved_by='auto'))\n"
        "    time.sleep(0.001)\n"
        "    if k == 5: print('going', flush=True)\n"
    )
    root = Path(__file__).resolve().parents[2]
    for _ in range(3):
        with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, cwd=root) as child:
            assert child.stdout is not None
            child.stdout.readline()
            time.sleep(0.4)
            child.kill()
        store = Store(path, "pelican")
        restored = store.restore()
        store.close()
        assert not store.notes
        assert restored.item is not None
        assert restored.item.state is SetState.ACCEPTED
        assert restored.next_sequence == restored.item.sequence + 1 or restored.next_sequence > 2


def test_old_candidates_are_forgotten_sets_never(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import quadid_node.history as storing

    monkeypatch.setattr(storing, "PRUNE_EVERY", 5)
    store = filled(tmp_path / "h.sqlite", sets=40)
    store.close()
    again = Store(tmp_path / "h.sqlite", "pelican", {"candidates": 10, "events": 10})
    for k in range(30):
        again.event(Event(float(k), "info", "test", "x"))
        time.sleep(0.005)
    again.close()
    found = read_history(tmp_path / "h.sqlite", "pelican", candidates=1000, events=1000)
    assert len(found["sets"]) == 40
    assert len(found["candidates"]) <= 10
    assert len(found["events"]) <= 20
