"""The history: what was journalled comes back, whatever happens to file, disk, rows, or a second service."""

import contextlib
import json
import math
import os
import sqlite3
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from quadid_node.history import VERSION, Restored, Store, StoreError, make_usable, read_history
from quadid_node.messages import Output, set_from_dict, set_to_dict
from quadid_node.service import Service
from quadid_node.worker import InlineWorker

from quadid.app.fleet import open_store
from quadid.condition.trim import FlightTrim
from quadid.online import SessionSettings, SetState
from quadid.online.gate import ActiveSet
from quadid.online.records import Event, HealthyFlight, OnlineDiagnosis, OnlineFinding, OnlineSet, Publish
from quadid.vehicle import Vehicle
from quadid_node import history as storing
from tests.faults.evidence import Happened
from tests.node.peers import until
from tests.online.driving import flight, samples
from tests.online.made_up import QUICK, between, light_flight, tells, works
from tests.online.test_gate import TRUE, online_set

PELICAN = Vehicle.shipped("pelican")


OTHERS = r"""
import sys
from pathlib import Path
from quadid_node.history import Store, StoreError
for line in sys.stdin:
    try:
        path, vehicle = line[:-1].split("\t")
        Store(Path(path), vehicle).close()
        print()
    except StoreError as error:
        print(error)
    sys.stdout.flush()
"""
"""A process that opens one history after the other as a second service, and says what it is told."""


@cache
def others() -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", OTHERS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def another_process(path: Path, vehicle: str = "pelican") -> str:
    """Words of a second service that opens the history; empty where it is let in."""
    told, heard = others().stdin, others().stdout
    assert told is not None
    assert heard is not None
    told.write(f"{path}\t{vehicle}\n")
    told.flush()
    return heard.readline().strip()


def in_force(sequence: int) -> OnlineSet:
    return replace(online_set(TRUE), sequence=sequence, approved_by="auto")


def say(store: Store, text: str) -> bool:
    """Journals a line; whether it is reported on the disk."""
    store.journal(Event(1.0, "info", "x", text))
    return store.flush(30.0)


def lines(path: Path) -> list[str]:
    """Texts of the events in the history."""
    return [e["text"] for e in read_history(path, "pelican", events=1000)["events"]]


def filled(path: Path, sets: int = 2) -> Store:
    store = Store(path, "pelican")
    for k in range(sets):
        item = replace(
            online_set({**TRUE, "b": 2.3e-5 + 1e-7 * k}), sequence=k + 1, approved_by="auto", check="approval"
        )
        store.journal(Publish("candidate", item))
        store.numbered(item)
    store.journal(Event(30.0, "warning", "change", "thrust stepped"))
    finding = OnlineFinding(
        "mass_change", {"fraction": 0.15}, {"fraction": 0.01}, {"fraction": ""}, 3.0, 1.0, 1e-9, (), "seen"
    )
    store.journal(OnlineDiagnosis(44.0, 40.0, 44.0, (finding,), "explained"))
    return store


def left(path: Path, vehicle: Vehicle | None = None) -> Restored:
    """State that a history hands to the next run."""
    with closing(Store(path, "pelican")) as store:
        return store.restore(vehicle=vehicle)


# --- What comes back


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
    filled(path).close(60.0)
    restored = left(path)
    assert restored.item is not None
    assert restored.item.parameters["b"].value == 2.3e-5 + 1e-7
    assert restored.next_sequence > 3, "above the known ones, and above those of a history that may be lost"
    assert restored.baseline is not None
    assert restored.baseline.sequence == 1
    found = read_history(path, "pelican", candidates=10, events=10)
    assert [s["sequence"] for s in found["sets"]] == [1, 2]
    assert [c["check"] for c in found["candidates"]] == ["approval", "approval"]
    assert [e["kind"] for e in found["events"]] == ["change", "diagnosis"]


def test_every_set_stands_with_the_run_that_numbered_it(tmp_path: Path) -> None:
    """Also where a file that was lost is begun anew with the sets of earlier runs."""
    path = tmp_path / "h.sqlite"
    first = filled(path, sets=1)
    first.close(60.0)
    second = Store(path, "pelican")
    assert second.restore().item is not None
    second.numbered(replace(online_set(TRUE), sequence=9, approved_by="auto"))
    second.close(60.0)
    assert second.boot_id != first.boot_id
    told = [(s["sequence"], s["boot_id"]) for s in read_history(path, "pelican")["sets"]]
    assert told == [(1, first.boot_id), (9, second.boot_id)]
    third = Store(path, "pelican")
    third.restore()
    for name in tmp_path.iterdir():
        name.write_bytes(b"")
    third.numbered(replace(online_set(TRUE), sequence=10, approved_by="auto"))
    assert third.flush(20.0)
    third.close(60.0)
    told = [(s["sequence"], s["boot_id"]) for s in read_history(path, "pelican")["sets"]]
    assert told == [(1, first.boot_id), (10, third.boot_id)]


def test_a_set_known_to_be_out_of_date_is_still_so_after_two_restarts(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    filled(path).close(60.0)
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
        store.close(60.0)
    store = Store(path, "pelican")
    store.numbered(replace(online_set(TRUE), sequence=found.next_sequence + 10, approved_by="auto"))
    store.close(60.0)
    item = left(path).item
    assert item is not None
    assert not item.outdated


def test_the_baseline_is_the_last_set_a_person_approved(tmp_path: Path) -> None:
    store = filled(tmp_path / "h.sqlite")
    store.numbered(replace(online_set(TRUE), sequence=3, approved_by="ann"))
    store.numbered(replace(online_set(TRUE), sequence=4, approved_by="auto"))
    store.close(60.0)
    baseline = left(tmp_path / "h.sqlite").baseline
    assert baseline is not None
    assert baseline.sequence == 3


def test_old_candidates_are_forgotten_sets_never(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storing, "PRUNE_EVERY", 5)
    store = filled(tmp_path / "h.sqlite", sets=40)
    store.close(60.0)
    again = Store(tmp_path / "h.sqlite", "pelican", {"candidates": 10, "events": 10})
    for k in range(30):
        again.journal(Event(float(k), "info", "test", "x"))
        time.sleep(0.005)
    again.close(60.0)
    found = read_history(tmp_path / "h.sqlite", "pelican", candidates=1000, events=1000)
    assert len(found["sets"]) == 40
    assert len(found["candidates"]) <= 10
    assert len(found["events"]) <= 20


# --- One writer, one version


@pytest.mark.parametrize("how", ["nothing", "cleaned", "moved away", "moved and back", "other folder", "linked"])
def test_a_second_service_is_refused_whatever_is_done_to_the_file(tmp_path: Path, how: str, happened: Happened) -> None:
    path, aside = tmp_path / "h.sqlite", tmp_path / "aside.sqlite"
    store = Store(path, "pelican")
    assert say(store, "first")
    if how == "cleaned":
        for other in tmp_path.iterdir():
            if other.name not in ("h.sqlite", "h.sqlite-wal", "h.sqlite-shm"):
                other.unlink()
    elif how == "moved away":
        path.rename(aside)
        assert "another service" in another_process(aside)
        assert say(store, "second")
        assert "second" in lines(path)
    elif how == "moved and back":
        path.rename(aside)
        aside.rename(path)
    elif how == "other folder":
        (tmp_path / "link").symlink_to(tmp_path)
        assert "another service" in another_process(tmp_path / "link" / "h.sqlite")
    elif how == "linked":
        (tmp_path / "soft.sqlite").symlink_to(path)
        assert "another service" in another_process(tmp_path / "soft.sqlite")
    assert "another service" in another_process(path)
    assert say(store, "third")
    assert "third" in lines(path)
    store.close(60.0)
    assert not another_process(path)
    happened(44, f"a second service on a history whose file is {how}: refused")


def test_a_file_that_another_service_put_there_is_not_written(tmp_path: Path) -> None:
    path, other = tmp_path / "h.sqlite", tmp_path / "other.sqlite"
    ours, theirs = Store(path, "pelican"), Store(other, "pelican")
    assert say(ours, "first")
    assert say(theirs, "theirs")
    for end in ("-wal", "-shm"):
        Path(f"{path}{end}").unlink(missing_ok=True)
    with closing(sqlite3.connect(other)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    other.replace(path)
    ours.journal(Event(1.0, "info", "x", "second"))
    assert until(lambda: "another service" in ours.problem)
    theirs.close(60.0)
    assert ours.flush(30.0)
    assert lines(path) == ["theirs", "second"]
    ours.close(60.0)


def test_services_of_several_vehicles_share_a_file_by_one_name_only(tmp_path: Path, happened: Happened) -> None:
    """As by a bind mount of the file, which a rename stands for: by two names SQLite has two logs of one file, and rows
    that were on the disk are gone.
    """
    path, aside = tmp_path / "h.sqlite", tmp_path / "aside.sqlite"
    (tmp_path / "link").symlink_to(tmp_path)
    store = Store(path, "pelican")
    assert say(store, "first")
    assert not another_process(path, "hexacopter")
    assert not another_process(tmp_path / "link" / "h.sqlite", "hexacopter"), "the same folder"
    path.rename(aside)
    told = another_process(aside, "hexacopter")
    assert "open by another name" in told
    with pytest.raises(StoreError, match="open by another name"):
        Store(aside, "hexacopter")
    aside.rename(path)
    assert not another_process(path, "hexacopter")
    store.close(60.0)
    path.rename(aside)
    assert not another_process(aside, "hexacopter")
    happened(44, f"a second vehicle's service by another name of the same file: '{told[-160:]}'")


def test_two_names_of_one_file_are_refused_at_the_start(tmp_path: Path, happened: Happened) -> None:
    path, hard = tmp_path / "h.sqlite", tmp_path / "snapshot.sqlite"
    store = Store(path, "pelican")
    assert say(store, "first")
    os.link(path, hard)
    assert "has 2 names" in another_process(hard)
    assert say(store, "second")
    store.close(60.0)
    assert lines(path) == ["first", "second"]
    for name in (path, hard):
        with pytest.raises(StoreError, match="remove the other names"):
            Store(name, "pelican")
    happened(44, "a history with two hard links: refused at the start; a service that runs goes on, no row is lost")


def test_a_first_start_and_another_vehicles_sets_are_nothing_unread(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    path.touch()
    store = Store(path, "pelican")
    assert store.restore().approval == ""
    other = Store(path, "hexacopter")
    other.numbered(replace(online_set(TRUE), sequence=1, approved_by="auto"))
    other.close(60.0)
    assert "another service" in another_process(path), "the end of the other one's lock must not end this one's"
    store.close(60.0)


@pytest.mark.parametrize("change", ["", "ALTER TABLE sets ADD COLUMN signature TEXT", "CREATE TABLE more (x)"])
def test_a_history_of_a_newer_version_is_refused_and_not_touched(
    tmp_path: Path, change: str, happened: Happened
) -> None:
    path = tmp_path / "h.sqlite"
    Store(path, "pelican").close(60.0)
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(change)
        db.execute(f"PRAGMA user_version = {VERSION + 1}")
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA journal_mode = DELETE")
    before = path.read_bytes()
    for opens in (lambda: Store(path, "pelican"), lambda: read_history(path, "pelican")):
        with pytest.raises(StoreError, match=f"version {VERSION + 1}; allowed: up to {VERSION}"):
            opens()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir() if "damaged" in p.name] == []
    happened(44, f"a history of version {VERSION + 1}: refused with the fix, not a byte changed")


def test_a_set_that_says_no_more_than_it_must_is_read(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    filled(path).close(60.0)
    more = ("mass", "outdated", "outdated_code", "reference", "boot_id", "covariance")
    with closing(sqlite3.connect(path)) as db, db:
        for (data,) in db.execute("SELECT data FROM sets").fetchall():
            less = {name: value for name, value in json.loads(data).items() if name not in more}
            db.execute("UPDATE sets SET data = ? WHERE data = ?", (json.dumps(less), data))
    store = Store(path, "pelican")
    restored = store.restore(vehicle=PELICAN)
    store.close(60.0)
    assert not store.notes
    assert restored.item is not None
    b = restored.item.parameters["b"]
    assert restored.item.parameters.covariance[0, 0] == pytest.approx(b.sigma**2)
    assert restored.item.reference == "none"
    assert restored.item.outdated.startswith("it rests on a mass that it does not state")


@pytest.mark.parametrize("damage", ["garbage", "x'ff'", "'yes'"])
def test_after_a_history_that_cannot_be_read_approval_is_manual_for_good(
    tmp_path: Path, damage: str, happened: Happened
) -> None:
    path = tmp_path / "h.sqlite"

    def service() -> Service:
        return Service(PELICAN, SessionSettings(), InlineWorker(), Store(path, "pelican"))

    first = service()
    assert first.session.active_set.approval == "auto"
    assert first.decide_approval("manual").done
    first.close()
    if damage == "garbage":
        path.write_bytes(b"no database" * 1000)
    else:
        with closing(sqlite3.connect(path)) as db, db:
            db.execute(f"UPDATE decisions SET approval = {damage}")
    for _ in range(2):  # the second time the file is sound
        again = service()
        assert again.session.active_set.approval == "manual"
        assert any(o.topic == "event" and "approval is manual, not auto" in o.text for o in again.step())
        again.close()
    last = service()
    assert last.decide_approval("auto").done
    last.close()
    last = service()
    assert last.session.active_set.approval == "auto"
    last.close()
    happened(44, f"what people decided cannot be read ({damage}): approval is manual until a person says auto")


@pytest.mark.parametrize("damage", ["", "'x'", "-1.0", "1e999"])
def test_a_mass_that_changed_in_flight_is_known_after_a_restart(
    tmp_path: Path, damage: str, happened: Happened
) -> None:
    """With no set in force there was nothing that a restart could find it by: the old mass was published."""
    path = tmp_path / "h.sqlite"

    def service(vehicle: Vehicle = PELICAN) -> Service:
        return Service(vehicle, QUICK, InlineWorker(), Store(path, "pelican"))

    flown = service()
    flown.session.active_set.load = 1.2  # as a change does
    flown.step()
    flown.close()
    if damage:
        with closing(sqlite3.connect(path)) as db, db:
            db.execute(f"UPDATE masses SET mass = {damage}")
        again = service()
        assert (again.approval, again.session.active_set.load) == ("manual", 1.0)
        again.close()
        return
    heavier = service(PELICAN.model_copy(update={"mass": 1.2 * PELICAN.mass}))
    assert heavier.session.active_set.load == pytest.approx(1.0), "the vehicle file has that mass now"
    heavier.close()
    again = service()
    works(again.session, between(light_flight(60.0), 0.0, 12.0), tells())
    waits = again.session.active_set.pending
    assert waits is not None
    assert (waits.check, again.session.active_set.in_force) == ("mass", None)
    assert again.approve("ann").done
    again.close()
    approved = service()
    assert approved.session.active_set.load == 1.0, "who approved it has judged the mass"
    approved.close()
    happened(38, f"+20 % before any set, then a restart: '{waits.reason[:90]}'")


@pytest.mark.parametrize("end", ["-wal", "-shm", "-journal"])
@pytest.mark.parametrize("link", [os.link, os.symlink])
def test_links_beside_a_history_are_refused(
    tmp_path: Path, end: str, link: Callable[[Path, Path], None], happened: Happened
) -> None:
    """SQLite made 32 KiB of its own of whatever stood there as -shm by a second name."""
    path, precious = tmp_path / "h.sqlite", tmp_path / "precious"
    filled(path).close(60.0)
    precious.write_bytes(b"precious " * 1000)
    link(precious, tmp_path / f"h.sqlite{end}")
    for use in (lambda: Store(path, "pelican"), lambda: read_history(path, "pelican")):
        with pytest.raises(StoreError, match="a link, or has a second name"):
            use()
    assert precious.read_bytes() == b"precious " * 1000
    (tmp_path / f"h.sqlite{end}").unlink()
    assert len(read_history(path, "pelican")["sets"]) == 2
    happened(44, f"{link.__name__} as history{end} to another file: refused by service and reader, the file whole")


def test_a_journal_beside_a_history_has_no_other_file_removed(tmp_path: Path, happened: Happened) -> None:
    """A journal that a stranger packs may name a file as common to several databases: SQLite removed it."""
    path, precious = tmp_path / "h.sqlite", tmp_path / "precious"
    filled(path).close(60.0)
    precious.write_text("precious")
    kept, named, magic = path.read_bytes(), str(precious).encode(), bytes.fromhex("d9d505f920a163d7")
    page = int.from_bytes(kept[16:18], "big")
    head = struct.pack(">8s5I", magic, 0, 1, len(kept) // page, 512, page).ljust(512, b"\0")
    place = struct.pack(">I", (1 << 30) // page + 1)
    journal = tmp_path / "h.sqlite-journal"
    journal.write_bytes(head + place + named + struct.pack(">2I", len(named), sum(named)) + magic)
    for use in (lambda: Store(path, "pelican"), lambda: read_history(path, "pelican"), open_store(path).__enter__):
        with pytest.raises((StoreError, OSError), match="names another file"):
            use()
    assert precious.read_text() == "precious"
    journal.unlink()
    assert len(read_history(path, "pelican")["sets"]) == 2
    happened(44, "a journal beside the history that names a file of the user: refused, the file is there")


@pytest.mark.parametrize("table", ["sets", "decisions", "masses"])
def test_rows_behind_the_last_that_can_be_numbered_do_not_stay_the_newest(
    tmp_path: Path, table: str, happened: Happened
) -> None:
    """SQLite numbers rows at random once one has the largest number: a person's decision was older than that one."""
    path = tmp_path / "h.sqlite"
    filled(path).close(60.0)
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        values = {"sets": "1, 'rejected', '', '', 0, 0, '{}'", "decisions": "'auto', 'auto', 0"}.get(table, "0, 0")
        columns = ", ".join(row[1] for row in db.execute(f"PRAGMA table_info({table})") if row[1] != "id")
        db.execute(f"INSERT INTO {table} (rowid, {columns}) VALUES ({(1 << 63) - 1}, 'pelican', {values})")
    store = Store(path, "pelican")
    assert "malformed" in store.notes[0]
    store.restore()
    store.decision("auto", "manual")
    store.close(60.0)
    assert left(path).approval == "manual"
    happened(44, f"a row of {table} with the largest number there is: '{store.notes[0][:90]}'")


# --- Disks and damage


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
    said: list[Output] = []
    for sample in samples(flight(10.0, 6).recording):
        service.push(sample.block)
        said += service.step()
    for k in range(20):
        store.journal(Event(float(k), "info", "test", "x" * 2000))
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
        store.close(60.0)
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
            store.journal(Event(float(k), "info", "test", "while locked"))
        store.numbered(in_force(1))
        assert until(lambda: "locked" in store.problem)
        other.stdin.close()
    assert until(lambda: not store.problem)
    store.close(60.0)
    found = read_history(path, "pelican", events=500)
    assert (len(found["events"]), len(found["sets"])) == (300, 1)
    happened(12, "locked by another process for over 5 s: said; all 300 events and the set were written afterwards")


@pytest.mark.parametrize("damage", ["garbage", "zeros", "truncated", "empty page"])
def test_a_damaged_history_is_set_aside_not_deleted(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "h.sqlite"
    filled(path, sets=40).close(60.0)
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
    store.close(60.0)
    assert [s["sequence"] for s in read_history(path, "pelican")["sets"]] == [1]


@pytest.mark.parametrize("damage", ["pages", "head", "removed"])
def test_damage_while_running_sets_the_file_aside_and_the_new_one_has_the_set_in_force(
    tmp_path: Path, damage: str, happened: Happened
) -> None:
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    for k in range(40):
        store.numbered(in_force(k + 1))
    assert until(lambda: len(read_history(path, "pelican")["sets"]) == 40)
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    before = path.read_bytes()
    if damage == "removed":
        path.unlink()
    else:
        keep = 0 if damage == "head" else 4096
        path.write_bytes(before[:keep] + os.urandom(len(before) - keep))
    service = Service(PELICAN, SessionSettings(), InlineWorker(), store)
    for k in range(10):
        store.journal(Event(float(k), "info", "test", "after"))
    assert store.flush(60.0), store.problem
    assert lines(path).count("after") == 10
    assert until(lambda: not store.problem)
    aside = [p for p in tmp_path.iterdir() if ".damaged-" in p.name and not p.name.endswith(("-wal", "-shm"))]
    if damage != "removed":
        assert [p.stat().st_size for p in aside] == [len(before)], "set aside as it was"
        assert any(isinstance(o, Event) and "set aside" in o.text for o in service.step())
    store.close(60.0)
    restored = left(path)
    assert restored.item is not None
    assert (restored.item.sequence, restored.item.state) == (40, SetState.ACCEPTED)
    what = "new file" if damage == "removed" else "set aside whole, said"
    happened(12, f"history damaged in service ({damage}): {what}; the new one begins with the set in force")


def test_a_file_begun_anew_has_each_set_once(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    filled(path, sets=1).close(60.0)
    store = Store(path, "pelican")
    store.restore()
    path.write_bytes(b"no history" * 1000)
    assert say(store, "after")
    store.close(60.0)
    assert [s["sequence"] for s in read_history(path, "pelican")["sets"]] == [1]


TRIM = FlightTrim("log1", np.full(4, 0.1), np.full((2, 4), 0.1), np.full(4, 0.25), np.full(4, 0.01), 30.0, "made up")


def test_what_people_decided_outlives_a_history_damaged_in_service(tmp_path: Path, happened: Happened) -> None:
    """A new file began with the set in force alone: approval was automatic again, creeping counted from that set."""
    path = tmp_path / "h.sqlite"
    store = Store(path, "pelican")
    service = Service(PELICAN, SessionSettings(), InlineWorker(), store)
    store.numbered(replace(online_set(TRUE), sequence=1000, approved_by="ann"))
    store.journal(HealthyFlight(1.0, TRIM))
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
    assert store.flush(60.0)
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    path.write_bytes(b"no history" * 1000)
    store.journal(Event(1.0, "info", "test", "after"))
    assert store.flush(60.0)
    service.close()
    assert any("set aside" in note for note in store.notes)

    restored = left(path)
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
        patched.setattr(storing, "make_tables", full)
        store = Store(tmp_path / "h.sqlite", "pelican")
    service = Service(PELICAN, SessionSettings(), InlineWorker(), store)
    assert any(isinstance(o, Event) and "full" in o.text for o in service.step())
    store.numbered(in_force(7))
    assert store.flush(60.0)
    assert any(isinstance(o, Event) and "written again" in o.text for o in service.step())
    service.close()


# --- Rows and files that this program has not written


def kept(path: Path) -> None:
    """A history with one set."""
    store = Store(path, "v")
    store.numbered(online_set(TRUE))
    assert store.flush(60.0)
    store.close(60.0)


def with_all(**fields: object) -> str:
    """A set as JSON, with other fields of its own."""
    return json.dumps({**set_to_dict(online_set(TRUE)), **fields})


def with_first(**fields: object) -> str:
    """A set as JSON, with other fields in its first parameter."""
    data = set_to_dict(online_set(TRUE))
    data["parameters"][0].update(fields)
    return json.dumps(data)


HOSTILE_SETS = {
    "100,000 brackets": "[" * 100_000,
    "a list": "[]",
    "nothing": "null",
    "a number": "7",
    "a value of 400 digits": with_first(value=10**400),
    "an infinite number": with_first().replace('"samples": ', '"samples": 1e999, "old": '),
    "one bound": with_first(bounds=[1.0]),
    "no interval": with_first(ci95=[]),
    "no b": with_first(name="c"),
    "a mass of 400 digits": with_all(mass=10**400),
    "a number beyond 64 bits": with_all(sequence=2**64),
    "another set's number": with_all(sequence=8),
    "a negative b": with_first(value=-1.0),
    "no b at all": with_first(value=0.0),
    "a b of no number": with_first(value=None),
    "a negative deviation": with_first(sigma=-2e-4),
    "a covariance of no numbers": with_all(covariance=[[math.nan] * 6] * 6),
    "a time that no message holds": with_all(stop=1e300),
    "more samples than a message holds": with_all(samples=2**40),
    "fewer samples than none": with_all(samples=-4),
    "half a character": with_all(reason="\ud800"),
    "half a character in a unit": with_first(unit="\udcff"),
    "a reference known to 1e308": with_all(reference_sd=1e308),
    "one known to less than nothing": with_all(reference_sd=-1.0),
    "one known to no number": with_all(reference_sd=None),
    "a covariance beyond the deviations": with_all(covariance=np.full((6, 6), 1e9).tolist()),
    "a covariance of two minds": with_all(covariance=[[0.0] * 6] * 3 + [[2e-12, *[0.0] * 5]] + [[0.0] * 6] * 2),
    "one of an unknown reference": with_all().replace("reference_sd", "no"),
    "an interval beside its value": with_first(ci95=[0.0, 0.0]),
    "a parameter twice": with_all(parameters=2 * set_to_dict(online_set(TRUE))["parameters"], covariance=None),
}


HOSTILE_TO_A_VEHICLE = {
    "a negative mass": with_all(mass=-3.0),
    "a mass that no float of 32 bits holds": with_all(mass=1e300),
    "b far outside the vehicle's bounds": with_first(value=1.0, bounds=[0.5, 2.0]),
    "a deviation that no float of 32 bits holds": with_first(sigma=1e300),
}


@pytest.mark.parametrize("what", [*HOSTILE_SETS, *HOSTILE_TO_A_VEHICLE])
def test_a_set_that_no_fit_of_this_vehicle_made_is_left_out_and_said(
    tmp_path: Path, what: str, happened: Happened
) -> None:
    """Bounds that a set gives itself say nothing; a mass of 1e300 ended the link that told it."""
    path = tmp_path / "h.sqlite"
    kept(path)
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("UPDATE sets SET data = ?", (HOSTILE_SETS.get(what) or HOSTILE_TO_A_VEHICLE[what],))
    with contextlib.suppress(StoreError):
        read_history(path, "v")
    store = Store(path, "v")
    restored = store.restore(vehicle=PELICAN if what in HOSTILE_TO_A_VEHICLE else None)
    assert restored.item is None
    assert restored.baseline is None
    assert "is no set and is not taken up again" in store.notes[0]
    store.close(60.0)
    happened(25 if what in HOSTILE_TO_A_VEHICLE else 12, f"a stored set with {what}: '{store.notes[0][50:140]}'")


@pytest.mark.parametrize("what", ["a list", "no interval", "a number"])
def test_get_history_of_rows_that_none_wrote_is_an_answer(tmp_path: Path, what: str) -> None:
    """The error went through the callback, which ends a node."""
    service = Service(PELICAN, SessionSettings(), InlineWorker(), Store(tmp_path / "h.sqlite", "v"))
    with closing(sqlite3.connect(tmp_path / "h.sqlite")) as db, db:
        row = ("v", 7, "accepted", "", "auto", 1.0, 1.0, HOSTILE_SETS[what])
        db.execute("INSERT INTO sets VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
    with pytest.raises(StoreError, match="cannot be read"):
        service.stored_sets(100)
    service.close()


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
    with closing(sqlite3.connect(path)) as db:
        db.executescript(HOSTILE_FILES[what])
    with pytest.raises(StoreError, match="malformed"):
        read_history(path, "v")
    store = Store(path, "v")
    assert "set aside" in store.notes[0]
    store.numbered(online_set(TRUE))
    assert store.flush(60.0)
    assert [entry["sequence"] for entry in read_history(path, "v")["sets"]] == [online_set(TRUE).sequence]
    store.close(60.0)
    happened(12, f"a history with {what}: '{store.notes[0][:90]}'")


def test_services_that_begin_one_history_at_once_all_can(tmp_path: Path) -> None:
    """Of two that entered WAL mode together SQLite refused one at once: "another program holds the history"."""
    for turn in range(40):
        with ThreadPoolExecutor(3) as pool:
            assert list(pool.map(make_usable, [tmp_path / f"{turn}.sqlite"] * 3)) == [""] * 3
