"""The history of a vehicle in SQLite (WAL): every candidate, decision, reason and event; one writer per vehicle.

Nothing here stops a service that runs: a history that cannot be written is said so in `problem`, and `written` tells
which numbered sets are on the disk, so that no other is published.  At the start a history that another program holds
is waited for, then refused: without it nobody knows which numbers are taken.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from quadid.health.stored import flight_from_dict, flight_to_dict
from quadid.health.trim_estimation import FlightTrim
from quadid.online.gate import GateSettings
from quadid.online.health_supervisor import MOST_FLIGHTS
from quadid.online.records import Event, OnlineDiagnosis, OnlineSet
from quadid.vehicle import Vehicle
from quadid_node.codec import diagnosis_to_dict, set_to_dict
from quadid_node.history_writer import HistoryWriter, Row
from quadid_node.restored_set import StoredSet, in_force, stored
from quadid_node.store_file import UNREADABLE, StoreError, connect, is_damage, make_tables, set_aside
from quadid_node.store_lock import HistoryLock, real, text

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
        self.path, self.vehicle = real(path), text(vehicle)
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
        data = json.dumps(set_to_dict(item))
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
