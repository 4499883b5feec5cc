"""History of a service: parameter sets, findings and decisions in SQLite."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sqlite3
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from quadid.condition.trim import FlightTrim, flight_from_dict, flight_to_dict
from quadid.online.flexible_fit import ROOM, with_room
from quadid.online.gate import GateSettings, implausible
from quadid.online.health_supervisor import MOST_FLIGHTS
from quadid.online.records import Event, OnlineDiagnosis, OnlineSet, SetState
from quadid.parameters import NOMINAL_NAMES, ParameterSet
from quadid.vehicle import Vehicle
from quadid_node.codec import diagnosis_to_dict, set_from_dict, set_to_dict
from quadid_node.store_file import (
    UNREADABLE,
    HistoryLock,
    StoreError,
    begin_anew,
    connect,
    is_damage,
    make_tables,
    opened,
    real,
    set_aside,
    text,
)

# --- The thread that brings rows of a history to the disk, in order, and knows which of them are there
#
# A slow, full or locked disk never holds up a sample: rows wait here, and are tried again until they can be written.


MOST_WAITING = 5000
"""Rows kept while the disk cannot take them; beyond, the oldest that pass are lost, and that is said."""
PRUNE_EVERY = 1000
AGAIN = 1.0
"""Time after which rows that could not be written are tried again [s]."""
_UNFIT = (OverflowError, UnicodeError, sqlite3.ProgrammingError, sqlite3.InterfaceError, sqlite3.IntegrityError)
"""What SQLite raises for a row that it will never take."""


class Row(NamedTuple):
    """A statement with its values.

    Attributes:
        number: of the set which may be published once the row is on the disk; 0 for none.
        passes: the row may be lost where there are too many; others tell what is in force and what people decided.
    """

    statement: str
    values: tuple[Any, ...]
    number: int = 0
    passes: bool = False


class HistoryWriter:
    """Writes rows behind the caller's back.

    Attributes:
        problem: why nothing is written at the moment, or empty.
    """

    def __init__(
        self, path: Path, kept: Mapping[str, int], standing: Callable[[], list[Row]], notes: list[str],
        lock: HistoryLock,
    ) -> None:  # fmt: skip
        """Begins to write.

        Args:
            path: database with its tables made.
            kept: rows that stay, by table.
            standing: the rows with which a new file begins.
            notes: gets what people should know of what is past: a damaged file set aside, a row that was no row.
            lock: the right to write; it follows the file that stands under the name.
        """
        self._lock = lock
        self._path, self._kept, self._standing, self._notes = path, kept, standing, notes
        self.problem = ""
        self._rows: list[Row] = []
        self._written: set[int] = set()
        self._lost: set[int] = set()
        self._changed = threading.Condition()
        self._closing = False
        self._since_pruned = 0
        self._thread = threading.Thread(target=self._run, name="history", daemon=True)
        self._thread.start()

    def put(self, row: Row) -> None:
        """Takes a row; never waits."""
        with self._changed:
            self._rows.append(row)
            if len(self._rows) > MOST_WAITING:
                at = next((k for k, waiting in enumerate(self._rows) if waiting.passes), 0)
                self._lost.add(self._rows.pop(at).number)
                self.problem = f"{self._path}: the disk takes nothing, entries are lost"
            self._changed.notify_all()

    def is_written(self, number: int) -> bool:
        """Whether the row of that set is on the disk."""
        return number in self._written

    def is_lost(self, number: int) -> bool:
        """Whether the row of that set will never be on the disk."""
        return number in self._lost

    def flush(self, seconds: float) -> bool:
        """Waits until everything is on the disk; False when it is not after so long [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._rows, seconds)

    def close(self, seconds: float) -> None:
        """Writes what waits, at most for `seconds`."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(seconds)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._rows or self._closing)
                batch, closing = list(self._rows), self._closing
            if batch:
                self._attempt(batch)
            if closing and not self._rows:
                return
            if self.problem:
                time.sleep(0.2 if closing else AGAIN)

    def _attempt(self, batch: list[Row]) -> None:
        """One transaction for all rows that wait; they leave the queue only when it is on the disk."""
        try:
            unfit = self._commit(batch)
        except (sqlite3.Error, OSError, StoreError) as error:
            self.problem = f"{self._path} cannot be written ({error}): kept in memory until it can"
            if isinstance(error, sqlite3.Error) and is_damage(error):
                self._replace(error)
            return
        except Exception as error:  # noqa: BLE001 - whatever it is, a history that nobody writes must be said
            self.problem = f"the history of {self._path} is not written ({type(error).__name__}: {error})"
            return
        with self._changed:
            done = {id(row) for row in batch}
            self._rows = [row for row in self._rows if id(row) not in done]
            refused = {id(row) for row, _ in unfit}
            self._written |= {row.number for row in batch if row.number and id(row) not in refused}
            self._lost |= {row.number for row, _ in unfit}
            self._notes += [f"an entry that no history can hold was left out ({why})" for _, why in unfit]
            self.problem = ""
            self._changed.notify_all()

    def _commit(self, batch: list[Row]) -> list[tuple[Row, str]]:
        """Writes and commits; returns the rows that can never be written, with the reason."""
        unfit = []
        self._lock.moved()
        with contextlib.closing(connect(self._path)) as db, db:
            for row in batch:
                try:
                    added = db.execute(row.statement, row.values).rowcount
                except _UNFIT as error:
                    unfit.append((row, f"{type(error).__name__}: {error}"))
                else:
                    if not added:
                        unfit.append((row, f"number {row.number} stands for another set already"))
            self._since_pruned += len(batch)
            if self._since_pruned >= PRUNE_EVERY:
                self._since_pruned = 0
                for table, kept in self._kept.items():
                    db.execute(f"DELETE FROM {table} WHERE id <= (SELECT max(id) FROM {table}) - ?", (kept,))
            if self._lock.moved():
                raise sqlite3.OperationalError("another file stands there now")
        return unfit

    def _replace(self, error: sqlite3.Error) -> None:
        """After damage while running: a new file that begins with what stands."""
        try:
            note = begin_anew(self._path, error)
        except (sqlite3.Error, OSError, StoreError) as failure:
            self.problem = f"{self._path} cannot be written ({failure}): kept in memory until it can"
            return
        self._notes += [note] if note else []
        standing = self._standing()
        with self._changed:
            self._rows[:0] = [row for row in standing if row not in self._rows]


# --- The set that a history says is in force: one rule for the service that takes it up and for all who read it
#
# Nothing that a file says is believed: a set of an earlier run must be one that this run could have estimated.


_FORCE = "state IN ('accepted', 'rolled_back')"
_SAME_MASS = 1e-6
"""Relative difference of masses that were written and read back."""


class StoredSet(NamedTuple):
    """A set of a history.

    Attributes:
        item: the set; None where there is none, or none that can be read.
        why_none: why it cannot be taken up; empty where it can, or where there is none.
        confirmed: whether a flight of the last run confirmed it; after a restart a set is stale until one does.
        boot_id: of the run that numbered it; empty where the history does not say.
    """

    item: OnlineSet | None
    why_none: str = ""
    confirmed: bool = True
    boot_id: str = ""

    @property
    def doubt(self) -> str:
        """Reason against using the set, as "out of date: ..."; empty where there is none."""
        if self.why_none:
            return f"no set that a fit makes: {self.why_none}"
        if self.item is not None and self.item.outdated:
            return f"out of date: {self.item.outdated}"
        return "" if self.confirmed else "stale: no flight has confirmed it since the service started again"


def in_force(db: sqlite3.Connection, name: str, gate: GateSettings, vehicle: Vehicle | None) -> StoredSet:
    """The set last in force, with why it is out of date: withdrawn since, or of another mass than the vehicle file's.

    Args:
        db: the history.
        name: of the vehicle in it.
        gate: of this run.
        vehicle: of this run; None: its mass is not compared.
    """
    last = stored(db, name, f"{_FORCE} ORDER BY rowid DESC", gate, vehicle)
    if last.item is None or last.why_none:
        return last
    told = stored(db, name, f"({_FORCE} OR state = 'stale') ORDER BY rowid DESC", gate, vehicle).item or last.item
    item = replace(last.item, outdated=told.outdated, outdated_code=told.outdated_code)
    if vehicle is not None and not item.outdated and abs(item.mass / vehicle.mass - 1.0) > _SAME_MASS:
        why = f"it rests on a mass of {item.mass:g} kg, the vehicle file has {vehicle.mass:g} kg"
        item = replace(item, outdated=why, outdated_code="mass_change")
    return last._replace(item=item, confirmed=told.state is not SetState.STALE)


def read_in_force(path: Path, name: str, vehicle: Vehicle | None) -> StoredSet:
    """`in_force` of a history file, which is not touched; raises StoreError."""
    with opened(path) as db:
        return in_force(db, name, GateSettings(), vehicle)


def stored(db: sqlite3.Connection, name: str, which: str, gate: GateSettings, vehicle: Vehicle | None) -> StoredSet:
    """The first set of a vehicle for which the SQL condition `which` holds."""
    row = db.execute(f"SELECT data, sequence FROM sets WHERE vehicle = ? AND {which} LIMIT 1", (name,)).fetchone()
    if row is None:
        return StoredSet(None)
    found = None
    try:
        data = json.loads(row[0])
        found = set_from_dict(data)
        return StoredSet(found, why_none(found, row[1], gate, vehicle), boot_id=str(data.get("boot_id", "")))
    except UNREADABLE as error:
        return StoredSet(found, f"{type(error).__name__}: {str(error)[:120]}")


def why_none(found: OnlineSet, number: int, gate: GateSettings, vehicle: Vehicle | None) -> str:
    """Why a stored set is none that a fresh estimate could be; empty where it may be one.

    Args:
        found: the set.
        number: of the row that holds it.
        gate: of this run.
        vehicle: of this run, whose bounds hold for it; None: those of the set itself.
    """
    if found.sequence != number:
        return f"it says that it is set {str(found.sequence)[:40]} in the row of set {str(number)[:40]}"
    if found.parameters.names != NOMINAL_NAMES:
        missing = [n for n in NOMINAL_NAMES if n not in found.parameters.names]
        return (
            f"it lacks {', '.join(missing)}" if missing else f"it has other parameters than {', '.join(NOMINAL_NAMES)}"
        )
    if not np.isfinite(found.parameters.covariance).all():
        return "its covariance is not a number"
    if vehicle is None:
        return implausible(found.parameters, gate) or ""
    if not math.isnan(found.mass) and not vehicle.mass / ROOM <= found.mass <= vehicle.mass * ROOM:
        return f"it rests on a mass of {found.mass:g} kg, the vehicle has {vehicle.mass:g} kg"
    widest = with_room(vehicle).parameters
    bounded = tuple(replace(p, bounds=widest[p.name].limits) for p in found.parameters)
    vague = next((p for p in bounded if p.sigma > ROOM * p.bounds[1]), None)
    if vague is not None:
        return f"{vague.name} has a standard deviation of {vague.sigma:g} {vague.unit}"
    return implausible(ParameterSet(bounded, found.parameters.covariance), gate) or ""


# --- The history of a vehicle in SQLite (WAL): every candidate, decision, reason and event; one writer per vehicle
#
# Nothing here stops a service that runs: a history that cannot be written is said so in `problem`, and `written` tells
# which numbered sets are on the disk, so that no other is published.  At the start a history that another program holds
# is waited for, then refused: without it nobody knows which numbers are taken.


KEPT: Mapping[str, int] = MappingProxyType({"candidates": 20_000, "events": 20_000})
"""Rows kept; older ones are forgotten, numbered sets and decisions never."""
LARGEST_NUMBER = 1 << 53
"""Numbers of sets stay below: JSON and floating point hold them exactly."""


def default_path() -> Path:
    """QUADID_HISTORY, else ``quadid/history.sqlite`` in the user's data folder."""
    given = os.environ.get("QUADID_HISTORY")
    if given:
        return Path(given)
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "quadid" / "history.sqlite"


def first_number(highest: int = 0) -> int:
    """The first number of a run: above every one known, and above those of a history that was lost.

    Sets are numbered from the UNIX time in milliseconds at which the run begins; they are made far more slowly than one
    a millisecond.  Where the clock was set back and the history is lost too, `boot_id` of the message still differs.
    """
    return max(highest + 1, time.time_ns() // 10**6)


@dataclass(frozen=True)
class Restored:
    """What an earlier run left.

    Attributes:
        item: the set last in force; None: none.
        next_sequence: the first number of this run.
        baseline: what creeping counts from.
        healthy: trims of healthy flights, the oldest first.
        approval: auto or manual where a person decided so while the earlier run was configured as this one, manual
            where that cannot be read; else empty.
        decided: why.
    """

    item: OnlineSet | None
    next_sequence: int
    baseline: OnlineSet | None = None
    approval: str = ""
    healthy: tuple[FlightTrim, ...] = ()
    decided: str = "a person decided so in an earlier run"


class Store:
    """History of one vehicle, open for writing.

    Attributes:
        notes: what people should know: a damaged history set aside, a row refused.
        boot_id: of this run; stands with every set that it numbers.
    """

    def __init__(self, path: Path, vehicle: str, kept: Mapping[str, int] = KEPT) -> None:
        """Opens the history, or makes it.

        Args:
            path: database file.
            vehicle: name of the vehicle.
            kept: rows that stay, by table; older ones are forgotten.

        Raises:
            StoreError: name or path is none, another program writes this vehicle's history or holds the file, the file
                has a second name, or it is of a newer version.
        """
        self.path, self.vehicle, self.boot_id = real(path), text(vehicle), uuid.uuid4().hex
        self._boots: dict[int, str] = {}
        self.notes: list[str] = []
        self._problem = ""
        self._lock: HistoryLock | None = None
        self._writer: HistoryWriter | None = None
        self._unread = False
        self._standing: dict[str, Row] = {}
        self._flights: deque[Row] = deque(maxlen=MOST_FLIGHTS)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = HistoryLock(self.path, self.vehicle)
        except OSError as error:
            why = f"{self.path} cannot be written ({error.strerror})"
            self._problem = f"{why}: nothing of this run is kept or published"
        if self._lock is not None:
            self._prepare(self._lock)
            self._writer = HistoryWriter(self.path, kept, self._begins_with, self.notes, self._lock)
            self._writer.problem, self._problem = self._problem, ""

    @property
    def problem(self) -> str:
        """Why nothing is written at the moment, or empty."""
        return self._writer.problem or self._problem if self._writer is not None else self._problem

    def restore(self, gate: GateSettings | None = None, vehicle: Vehicle | None = None) -> Restored:
        """What the last run left; a set is taken up again when this `gate` and `vehicle` could have let it pass."""
        if self._lock is None or not self.path.is_file() or not self.path.stat().st_size:
            return Restored(None, first_number())
        try:
            with contextlib.closing(connect(self.path)) as db:
                return self._restored(db, gate or GateSettings(), vehicle)
        except sqlite3.Error as error:
            self.notes.append(f"the last set cannot be read back ({error})")
            self._unread = True
            approval, decided = self._decided(None, gate or GateSettings())
            return Restored(None, first_number(), approval=approval, decided=decided)

    def _restored(self, db: sqlite3.Connection, gate: GateSettings, vehicle: Vehicle | None) -> Restored:
        (highest,) = db.execute("SELECT max(sequence) FROM sets WHERE vehicle = ?", (self.vehicle,)).fetchone()

        def newest(which: str) -> OnlineSet | None:
            return self._taken_up(stored(db, self.vehicle, which, gate, vehicle))

        last = self._taken_up(in_force(db, self.vehicle, gate, vehicle))
        approved = newest("approved_by NOT IN ('auto', '') AND state != 'stale' ORDER BY rowid DESC")
        first = newest("state = 'accepted' ORDER BY rowid")
        for item in (first, approved, last):
            if item is not None:
                self._stands(item)
        row = db.execute(
            "SELECT configured, approval FROM decisions WHERE vehicle = ? ORDER BY id DESC LIMIT 1", (self.vehicle,)
        ).fetchone()
        approval, decided = self._decided(row, gate)
        number = first_number(int(highest or 0))
        return Restored(last, number, approved or first, approval, self._healthy(db), decided)

    def _decided(self, row: tuple[Any, Any] | None, gate: GateSettings) -> tuple[str, str]:
        """Approval by the newest row of what people decided, and why: manual where that cannot be read."""
        if self._unread or (row is not None and row[1] not in ("auto", "manual")):
            self.decision(gate.approval, "manual")
            return "manual", "what people decided in earlier runs cannot be read"
        if row is None or row[0] != gate.approval:
            return "", ""
        self._standing["decision"] = self._decision_row(gate.approval, row[1])
        return str(row[1]), Restored.decided

    def _healthy(self, db: sqlite3.Connection) -> tuple[FlightTrim, ...]:
        """Trims of the newest healthy flights; a row that is none is left out, and said."""
        rows = db.execute(
            "SELECT data FROM healthy_flights WHERE vehicle = ? ORDER BY id DESC LIMIT ?", (self.vehicle, MOST_FLIGHTS)
        ).fetchall()
        out = []
        for (data,) in reversed(rows):
            try:
                out.append(flight_from_dict(json.loads(data)))
                self._flights.append(self._flight_row(out[-1]))
            except UNREADABLE as error:
                self.notes.append(f"a healthy flight of the history cannot be read back ({error})")
        return tuple(out)

    def _taken_up(self, found: StoredSet) -> OnlineSet | None:
        """The set; one that no fresh estimate could be is left out, and said."""
        if not found.why_none:
            if found.item is not None:
                self._boots[found.item.sequence] = found.boot_id
            return found.item
        self.notes.append(f"a set of the history is no set and is not taken up again ({found.why_none})")
        return None

    def numbered(self, item: OnlineSet) -> None:
        """Journals a set that was put in force, rolled back to, restored, or waits for approval."""
        self._put(self._stands(item))

    def _stands(self, item: OnlineSet) -> Row:
        """The row of a set, kept where a new file would have to begin with it; what `_restored` looks for."""
        row, state = self._row(item), item.state.value
        if state == "accepted":
            self._standing.setdefault("first", row)
        if state != "stale" and item.approved_by not in ("auto", ""):
            self._standing["approved"] = row
        if state in ("accepted", "rolled_back"):
            self._standing["last"] = row
        if state in ("accepted", "rolled_back", "stale"):
            self._standing["told"] = row
        return row

    def _begins_with(self) -> list[Row]:
        """Sets in force and what they are measured from, in the order of their numbers; decisions; healthy flights."""
        rows = {id(row): row for row in (*self._standing.values(), *self._flights)}
        return sorted(rows.values(), key=lambda row: row.number)

    def written(self, number: int) -> bool:
        """Whether the set of that number is on the disk."""
        return self._writer is not None and self._writer.is_written(number)

    def lost(self, number: int) -> bool:
        """Whether it will never be there: no history can hold it."""
        return self._writer is not None and self._writer.is_lost(number)

    def _row(self, item: OnlineSet) -> Row:
        values = (self.vehicle, item.sequence, item.state.value, item.reason, item.approved_by, item.stop, time.time())
        data = json.dumps({**set_to_dict(item), "boot_id": self._boots.get(item.sequence, self.boot_id)})
        another = "SELECT 1 FROM sets WHERE vehicle = ? AND sequence = ? AND data != ?"
        statement = f"INSERT INTO sets SELECT ?, ?, ?, ?, ?, ?, ?, ? WHERE NOT EXISTS ({another})"
        return Row(statement, (*values, data, self.vehicle, item.sequence, data), item.sequence)

    def candidate(self, item: OnlineSet) -> None:
        """Journals an estimate and what the gate said of it."""
        row = (self.vehicle, item.state.value, item.check, item.reason, item.stop, time.time())
        data = json.dumps(set_to_dict(item, covariance=False))
        names = "vehicle, state, gate, reason, stop, wall, data"
        self._put(Row(f"INSERT INTO candidates ({names}) VALUES (?, ?, ?, ?, ?, ?, ?)", (*row, data), passes=True))

    def event(self, item: Event) -> None:
        """Journals an event."""
        self._event(item.level, item.kind, item.text, item.t, None)

    def diagnosis(self, item: OnlineDiagnosis) -> None:
        """Journals findings."""
        quiet = item.verdict == "nothing_found"
        empty = "the simulation agrees with the flight" if quiet else "a change without a known cause"
        text = "; ".join(f"{f.effect}: {f.evidence}" for f in item.findings) or empty
        self._event("info" if quiet else "warning", "diagnosis", text, item.t, json.dumps(diagnosis_to_dict(item)))

    def healthy_flight(self, flight: FlightTrim) -> None:
        """Journals a flight that later ones are compared with."""
        self._flights.append(self._flight_row(flight))
        self._put(self._flights[-1])

    def _flight_row(self, flight: FlightTrim) -> Row:
        values = (self.vehicle, time.time(), json.dumps(flight_to_dict(flight)))
        return Row("INSERT INTO healthy_flights (vehicle, wall, data) VALUES (?, ?, ?)", values)

    def decision(self, configured: str, approval: str) -> None:
        """Journals that approval is now auto or manual by a person's decision, where it was `configured` otherwise."""
        self._standing["decision"] = self._decision_row(configured, approval)
        self._put(self._standing["decision"])

    def _decision_row(self, configured: str, approval: str) -> Row:
        values = (self.vehicle, configured, approval, time.time())
        return Row("INSERT INTO decisions (vehicle, configured, approval, wall) VALUES (?, ?, ?, ?)", values)

    def flush(self, seconds: float) -> bool:
        """Waits until everything is on the disk; False when it is not after so long [s]."""
        return self._writer is not None and self._writer.flush(seconds)

    def close(self, seconds: float = 1.5) -> None:
        """Writes what waits, at most for `seconds`, and lets others write."""
        if self._writer is not None:
            self._writer.close(seconds)
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    # --- writing

    def _event(self, level: str, kind: str, text: str, t: float, data: str | None) -> None:
        names = "vehicle, level, kind, text, t, wall, data"
        row = (self.vehicle, level, kind, text, t, time.time(), data)
        self._put(Row(f"INSERT INTO events ({names}) VALUES (?, ?, ?, ?, ?, ?, ?)", row, passes=True))

    def _put(self, row: Row) -> None:
        if self._writer is not None:
            self._writer.put(row)

    def _prepare(self, lock: HistoryLock) -> None:
        """Makes the tables; sets a damaged file aside, and one whose numbers are used up."""
        try:
            make_tables(self.path)
            self._check_numbers()
        except sqlite3.DatabaseError as error:
            if is_damage(error):
                self.notes.append(set_aside(self.path, error))
                self._unread = True
                lock.moved()
            elif "locked" in str(error):
                self.close()
                raise StoreError(
                    f"another program holds the history {self.path} ({error})",
                    "a history that can be written", "end that program, or use another history",
                ) from error  # fmt: skip
            else:
                self._problem = f"{self.path} cannot be written ({error})"
        except StoreError:
            self.close()
            raise

    def _check_numbers(self) -> None:
        """Raises DatabaseError where a number stands that this program never gives."""
        with contextlib.closing(connect(self.path)) as db:
            (highest,) = db.execute("SELECT max(sequence) FROM sets").fetchone()
        if not isinstance(highest, int | None) or (highest or 0) >= LARGEST_NUMBER:
            raise sqlite3.DatabaseError(f"malformed: set number {highest!r}")
