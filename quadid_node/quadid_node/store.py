"""The history of a vehicle in SQLite (WAL): every candidate, decision, reason and event; one writer per vehicle.

A thread of its own writes, so that a slow disk never holds up a sample.  Nothing here stops the service: a history
that cannot be opened or written is said so in `problem`, a damaged one is set aside under another name.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import queue
import sqlite3
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

from quadid.online.records import Diagnosed, Event, OnlineSet
from quadid_node.codec import diagnosis_to_dict, set_from_dict, set_to_dict
from quadid_node.store_file import StoreError, connect

SCHEMA = """
CREATE TABLE IF NOT EXISTS sets (
    vehicle TEXT NOT NULL, sequence INTEGER NOT NULL, state TEXT NOT NULL, reason TEXT NOT NULL,
    approved_by TEXT NOT NULL, stop REAL, wall REAL NOT NULL, data TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS sets_by_number ON sets (vehicle, sequence);
CREATE TABLE IF NOT EXISTS candidates (
    id INTEGER PRIMARY KEY, vehicle TEXT NOT NULL, state TEXT NOT NULL, gate TEXT NOT NULL, reason TEXT NOT NULL,
    stop REAL, wall REAL NOT NULL, data TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY, vehicle TEXT NOT NULL, level TEXT NOT NULL, kind TEXT NOT NULL, text TEXT NOT NULL,
    t REAL, wall REAL NOT NULL, data TEXT);
"""
VERSION = 1
KEPT: Mapping[str, int] = MappingProxyType({"candidates": 20_000, "events": 20_000})
"""Rows kept; older ones are forgotten, numbered sets never."""
PRUNE_EVERY = 1000
MOST_WAITING = 5000
AGAIN = 1.0
"""Time after which entries that could not be written are tried again [s]."""


def default_path() -> Path:
    """QUADID_HISTORY, else ``quadid/history.sqlite`` in the user's data folder."""
    given = os.environ.get("QUADID_HISTORY")
    if given:
        return Path(given)
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "quadid" / "history.sqlite"


@dataclass(frozen=True)
class Restored:
    """What an earlier run left: the set last in force (None: none), the next number, and what creeping counts from."""

    item: OnlineSet | None
    next_sequence: int
    baseline: OnlineSet | None = None


class Store:
    """History of one vehicle, open for writing.

    Attributes:
        problem: why nothing is written at the moment, or empty.
        notes: what happened on opening (a damaged history set aside).
    """

    def __init__(self, path: Path, vehicle: str, kept: Mapping[str, int] = KEPT) -> None:
        """Opens the history, or makes it.

        Args:
            path: database file.
            vehicle: name of the vehicle.
            kept: rows that stay, by table; older ones are forgotten.

        Raises:
            StoreError: another service writes the history of this vehicle.
        """
        self.path, self.vehicle, self._kept = path, vehicle, kept
        self.problem = ""
        self.notes: list[str] = []
        self._lock: IO[str] | None = None
        self._queue: queue.Queue[tuple[str, tuple[Any, ...]] | None] = queue.Queue(MOST_WAITING)
        self._written = 0
        self._last: tuple[str, tuple[Any, ...]] | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = _take_lock(path, vehicle)
        except OSError as error:
            self.problem = f"{path} cannot be written ({error.strerror}): the history of this run is lost"
        if not self.problem:
            self._prepare()
        self._thread = threading.Thread(target=self._write_all, name="history", daemon=True)
        self._thread.start()

    def restore(self) -> Restored:
        """The set last in force and the next free number."""
        if not self.path.is_file():
            return Restored(None, 1)
        try:
            with contextlib.closing(connect(self.path)) as db:
                (highest,) = db.execute("SELECT max(sequence) FROM sets WHERE vehicle = ?", (self.vehicle,)).fetchone()
                last = self._set(db, "state IN ('accepted', 'rolled_back') ORDER BY rowid DESC")
                approved = self._set(db, "approved_by NOT IN ('auto', '') ORDER BY rowid DESC")
                first = self._set(db, "state = 'accepted' ORDER BY rowid")
            self._last = self._row(last) if last is not None else None
            return Restored(last, int(highest or 0) + 1, approved or first)
        except (sqlite3.Error, ValueError, KeyError, TypeError) as error:
            self.problem = f"the last set cannot be read back ({error})"
            return Restored(None, 1)

    def _set(self, db: sqlite3.Connection, which: str) -> OnlineSet | None:
        row = db.execute(f"SELECT data FROM sets WHERE vehicle = ? AND {which} LIMIT 1", (self.vehicle,)).fetchone()
        return set_from_dict(json.loads(row[0])) if row is not None else None

    def numbered(self, item: OnlineSet) -> None:
        """Journals a set that was put in force, rolled back to, or waits for approval."""
        self._last = self._row(item)
        self._put(*self._last)

    def _row(self, item: OnlineSet) -> tuple[str, tuple[Any, ...]]:
        row = (self.vehicle, item.sequence, item.state.value, item.reason, item.approved_by, item.stop, time.time())
        return "INSERT INTO sets VALUES (?, ?, ?, ?, ?, ?, ?, ?)", (*row, json.dumps(set_to_dict(item)))

    def candidate(self, item: OnlineSet) -> None:
        """Journals an estimate and what the gate said of it."""
        row = (self.vehicle, item.state.value, item.check, item.reason, item.stop, time.time())
        data = json.dumps(set_to_dict(item, covariance=False))
        names = "vehicle, state, gate, reason, stop, wall, data"
        self._put(f"INSERT INTO candidates ({names}) VALUES (?, ?, ?, ?, ?, ?, ?)", (*row, data))

    def event(self, item: Event) -> None:
        """Journals an event."""
        self._event(item.level, item.kind, item.text, item.t, None)

    def diagnosis(self, item: Diagnosed) -> None:
        """Journals findings."""
        quiet = item.verdict == "nothing_found"
        empty = "the simulation agrees with the flight" if quiet else "a change without a known cause"
        text = "; ".join(f"{f.effect}: {f.evidence}" for f in item.findings) or empty
        self._event("info" if quiet else "warning", "diagnosis", text, item.t, json.dumps(diagnosis_to_dict(item)))

    def close(self, seconds: float = 1.5) -> None:
        """Writes what waits, at most for `seconds`, and lets others write."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=seconds)
        self._thread.join(seconds)
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    # --- writing

    def _event(self, level: str, kind: str, text: str, t: float, data: str | None) -> None:
        names = "vehicle, level, kind, text, t, wall, data"
        row = (self.vehicle, level, kind, text, t, time.time(), data)
        self._put(f"INSERT INTO events ({names}) VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def _put(self, statement: str, values: tuple[Any, ...]) -> None:
        try:
            self._queue.put_nowait((statement, values))
        except queue.Full:
            self.problem = f"{self.path}: the disk is too slow, entries are lost"

    def _prepare(self) -> None:
        """Makes the tables; sets a damaged file aside and begins a new one."""
        try:
            self._make_tables()
        except sqlite3.DatabaseError as error:
            if isinstance(error, sqlite3.OperationalError) and not _is_damage(error):
                self.problem = f"{self.path} cannot be written ({error})"
                return
            self._set_aside(error)
            with contextlib.suppress(sqlite3.Error):
                self._make_tables()

    def _set_aside(self, error: sqlite3.Error) -> None:
        """Gives a damaged file another name."""
        name = f"{self.path.name}.damaged-{time.strftime('%Y%m%dT%H%M%S')}"
        taken = sum(p.name.startswith(name) for p in self.path.parent.iterdir())
        aside = self.path.with_name(f"{name}-{taken}" if taken else name)
        for suffix in ("", "-wal", "-shm"):
            with contextlib.suppress(FileNotFoundError):
                Path(f"{self.path}{suffix}").rename(f"{aside}{suffix}")
        self.notes.append(f"the history was damaged ({error}); it was set aside as {aside.name}, a new one begins")

    def _make_tables(self) -> None:
        with contextlib.closing(connect(self.path)) as db:
            if db.execute("PRAGMA quick_check(1)").fetchone()[0] != "ok":
                raise sqlite3.DatabaseError("malformed: its pages do not add up")
            db.executescript(SCHEMA)
            db.execute(f"PRAGMA user_version = {VERSION}")
            db.commit()

    def _write_all(self) -> None:
        """The thread: one transaction for all that waits; tries again after a failure, keeping the order."""
        batch: list[tuple[str, tuple[Any, ...]]] = []
        while True:
            last = self._collect(batch)
            done = self._write(batch)
            batch = [] if done else batch[-MOST_WAITING:]
            if last:
                return
            if not done:
                time.sleep(0.2)

    def _collect(self, batch: list[tuple[str, tuple[Any, ...]]]) -> bool:
        """Adds what waits to be written; what failed before is tried again soon, whether more comes or not."""
        with contextlib.suppress(queue.Empty):
            entry = self._queue.get(timeout=AGAIN if batch else None)
            while entry is not None:
                batch.append(entry)
                entry = self._queue.get_nowait()
            return True
        return False

    def _write(self, batch: list[tuple[str, tuple[Any, ...]]]) -> bool:
        if self._lock is None:
            return True
        try:
            with contextlib.closing(connect(self.path)) as db, db:
                for statement, values in batch:
                    db.execute(statement, values)
                self._written += len(batch)
                if self._written >= PRUNE_EVERY:
                    self._written = 0
                    for table, kept in self._kept.items():
                        db.execute(f"DELETE FROM {table} WHERE id <= (SELECT max(id) FROM {table}) - ?", (kept,))
        except sqlite3.Error as error:
            self.problem = f"{self.path} cannot be written ({error}): kept in memory until it can"
            if _is_damage(error):
                self._begin_anew(error, batch)
            return False
        self.problem = ""
        return True

    def _begin_anew(self, error: sqlite3.Error, batch: list[tuple[str, tuple[Any, ...]]]) -> None:
        """After damage while running: a new file that begins with the set in force."""
        try:
            try:
                self._make_tables()  # the file was removed, or another service has dealt with it
            except sqlite3.DatabaseError as found:
                if not _is_damage(found):
                    raise
                self._set_aside(error)
                self._make_tables()
        except (sqlite3.Error, OSError) as failure:
            self.problem = f"{self.path} cannot be written ({failure}): kept in memory until it can"
            return
        if self._last is not None and self._last not in batch:
            batch.insert(0, self._last)


def _is_damage(error: sqlite3.Error) -> bool:
    """Whether an error says that the file is no sound database, not that it cannot be reached now."""
    told = str(error)
    return "malformed" in told or "not a database" in told or "no such table" in told


def _take_lock(path: Path, vehicle: str) -> IO[str]:
    """One writer per vehicle and history, for as long as it lives."""
    plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in vehicle)[:80]
    lock = path.with_name(f"{path.name}.{plain}.lock").open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        lock.close()
        raise StoreError(
            f"another service writes the history of '{vehicle}' in {path}", "one service a vehicle",
            "stop the other one, give another history, or start as observer",
        ) from error  # fmt: skip
    return lock
