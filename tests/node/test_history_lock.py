"""One writer of a history, whatever is done to its file; other versions; decisions that cannot be read."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from quadid_node.history import Store
from quadid_node.service import Service
from quadid_node.store_file import VERSION, StoreError, read_history
from quadid_node.worker import InlineWorker

from quadid.online import SessionSettings
from quadid.online.records import Event
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.test_gate import TRUE, online_set

PELICAN = Vehicle.shipped("pelican")
OTHER = """
import sys
from pathlib import Path
from quadid_node.history import Store
from quadid_node.store_file import StoreError
try:
    Store(Path(sys.argv[1]), "pelican")
except StoreError as error:
    sys.exit(str(error))
"""


def another_process(path: Path) -> str:
    """What a second service says that opens the history; empty where it is let in."""
    return subprocess.run(
        [sys.executable, "-c", OTHER, str(path)], capture_output=True, text=True, check=False
    ).stderr.strip()


def wait_for(what: Callable[[], object]) -> None:
    """Waits until something is so."""
    while not what():
        time.sleep(0.01)


def say(store: Store, text: str) -> bool:
    """Journals a line; whether it is reported on the disk."""
    store.event(Event(1.0, "info", "x", text))
    return store.flush(30.0)


def lines(path: Path) -> list[str]:
    """What the history holds of them."""
    return [e["text"] for e in read_history(path, "pelican", events=1000)["events"]]


@pytest.mark.parametrize("how", ["nothing", "cleaned", "moved away", "moved and back", "other folder"])
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
    assert "another service" in another_process(path)
    assert say(store, "third")
    assert "third" in lines(path)
    store.close()
    assert not another_process(path)
    happened(21, f"a second service on a history whose file is {how}: refused")


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
    ours.event(Event(1.0, "info", "x", "second"))
    wait_for(lambda: "another service" in ours.problem)
    theirs.close()
    assert ours.flush(30.0)
    assert lines(path) == ["theirs", "second"]
    ours.close()


def test_two_names_of_one_file_are_refused_at_the_start(tmp_path: Path, happened: Happened) -> None:
    path, hard = tmp_path / "h.sqlite", tmp_path / "snapshot.sqlite"
    store = Store(path, "pelican")
    assert say(store, "first")
    os.link(path, hard)
    assert "has 2 names" in another_process(hard)
    assert say(store, "second")
    store.close()
    assert lines(path) == ["first", "second"]
    for name in (path, hard):
        with pytest.raises(StoreError, match="remove the other names"):
            Store(name, "pelican")
    happened(21, "a history with two hard links: refused at the start; a service that runs goes on, no row is lost")


@pytest.mark.parametrize("change", ["", "ALTER TABLE sets ADD COLUMN signature TEXT", "CREATE TABLE more (x)"])
def test_a_history_of_a_newer_version_is_refused_and_not_touched(
    tmp_path: Path, change: str, happened: Happened
) -> None:
    path = tmp_path / "h.sqlite"
    Store(path, "pelican").close()
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
    happened(12, f"a history of version {VERSION + 1}: refused with the fix, not a byte changed")


@pytest.mark.parametrize("damage", ["garbage", "decision"])
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
            db.execute("UPDATE decisions SET approval = x'ff'")
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
    happened(12, f"what people decided cannot be read ({damage}): approval is manual until a person says auto")


def test_a_first_start_and_another_vehicles_sets_are_nothing_unread(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    path.touch()
    store = Store(path, "pelican")
    assert store.restore().approval == ""
    other = Store(path, "hexacopter")
    other.numbered(replace(online_set(TRUE), sequence=1, approved_by="auto"))
    other.close()
    assert "another service" in another_process(path), "the end of the other one's lock must not end this one's"
    store.close()
