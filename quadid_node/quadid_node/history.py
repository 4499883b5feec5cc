"""History of a service in SQLite: parameter sets, findings and decisions, with one writer for each vehicle.

A history that cannot be written never stops a service: `Store.problem` reports it, and `Store.written` which numbered
sets are on the disk, so that no other is published.
"""

import contextlib
import fcntl
import json
import math
import os
import sqlite3
import stat
import struct
import threading
import time
import uuid
import zlib
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, TypedDict

import msgspec
import numpy as np

from quadid.condition.trim import FlightTrim, flight_from_dict, flight_to_dict
from quadid.condition.watch import MOST_FLIGHTS
from quadid.errors import QuadidError
from quadid.files import check_beside
from quadid.online.gate import LIMITED, ROOM, GateSettings, implausible, with_room
from quadid.online.records import Event, HealthyFlight, OnlineDiagnosis, OnlineSet, Publish, SetState
from quadid.parameters import NOMINAL_NAMES, TANGENT, ParameterSet
from quadid.sanitise import plain
from quadid.vehicle import Vehicle
from quadid_node.messages import Output, diagnosis_to_dict, set_from_dict, set_to_dict

# --- The file: its tables, its versions, and what becomes of a damaged one

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
CREATE TABLE IF NOT EXISTS healthy_flights (
    id INTEGER PRIMARY KEY, vehicle TEXT NOT NULL, wall REAL NOT NULL, data TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS decisions (
    id INTEGER PRIMARY KEY, vehicle TEXT NOT NULL, configured TEXT NOT NULL, approval TEXT NOT NULL,
    wall REAL NOT NULL);
CREATE TABLE IF NOT EXISTS masses (
    id INTEGER PRIMARY KEY, vehicle TEXT NOT NULL, mass REAL NOT NULL, wall REAL NOT NULL);
"""
"""A file whose tables were made by another text is refused as foreign: old ones were made by exactly this one."""
VERSION = 2
BUSY_SECONDS = 5.0
"""Longest wait for another program's lock [s]."""
LARGEST_NUMBER = 1 << 53
"""Numbers of sets stay below: JSON and floating point hold them exactly."""
_SHOWN = ("sets", "candidates", "events")
UNREADABLE = (ValueError, TypeError, LookupError, OverflowError, RecursionError, QuadidError)
"""Errors of rows that this program has not written."""


class StoreError(QuadidError):
    """A history that another service writes, or that is not there."""


def connect(path: Path, read_only: bool = False) -> sqlite3.Connection:
    """Opens the file; for writing in WAL mode, every transaction on the disk before it counts.

    Raises:
        StoreError: a history of a newer version, which is not damaged, or links beside it; nothing is changed.
        sqlite3.Error: it cannot be opened.
    """
    try:
        check_beside(path)
    except OSError as error:
        raise StoreError(
            f"{error.filename}: {error.strerror}: another file would be changed",
            "a history with files of its own",
            "remove it, or use another history",
        ) from error
    name = f"{path.absolute().as_uri()}?mode=ro" if read_only else path
    db = sqlite3.connect(name, uri=read_only, timeout=BUSY_SECONDS)
    try:
        db.execute("PRAGMA trusted_schema = OFF")
        (version,) = db.execute("PRAGMA user_version").fetchone()
        if not 0 <= version <= VERSION:
            raise StoreError(
                f"the history {path} has version {version}",
                f"up to {VERSION}",
                "use the version of quadid that wrote it, or another history",
            )
        deadline = time.monotonic() + BUSY_SECONDS
        while not read_only:
            try:
                db.execute("PRAGMA journal_mode = WAL")
                db.execute("PRAGMA synchronous = FULL")
                break
            except sqlite3.OperationalError as error:
                # Of two that enter WAL mode at once on a new file SQLite refuses one without waiting.
                if "locked" not in str(error) or time.monotonic() > deadline:
                    raise
                time.sleep(0.02)
    except BaseException:
        db.close()
        raise
    return db


def make_tables(path: Path) -> None:
    """Makes what tables are missing.

    Raises:
        sqlite3.Error: the file is damaged, or cannot be written now.
        StoreError: it is of another version of this program.
    """
    with contextlib.closing(connect(path)) as db:
        check_tables(db)
        if db.execute("PRAGMA quick_check(1)").fetchone()[0] != "ok":
            raise sqlite3.DatabaseError("malformed: its pages do not add up")
        db.executescript(SCHEMA)
        db.execute(f"PRAGMA user_version = {VERSION}")
        db.commit()
        # Behind the largest row that SQLite can number, later ones would not count as newer.
        tables = {name for name, kind in _made() if kind == "table"}
        for what in ("sequence) FROM sets", *(f"rowid) FROM {table}" for table in tables)):
            (highest,) = db.execute(f"SELECT max({what}").fetchone()
            if not isinstance(highest, int | None) or (highest or 0) >= LARGEST_NUMBER:
                raise sqlite3.DatabaseError(f"malformed: number {highest!r} in {what.rpartition(' ')[2]}")


def check_tables(db: sqlite3.Connection) -> None:
    """Raises DatabaseError where a file holds what computes: triggers, views, and tables of ours made in another way.

    What a view, an index or the condition of a column computes may never end, and may take all memory.
    """
    made = _made()
    for kind, name, table, page, sql in db.execute(
        "SELECT type, name, lower(tbl_name), rootpage, sql FROM sqlite_master"
    ):
        if kind not in ("table", "index") or not page:
            raise sqlite3.DatabaseError(f"malformed: {plain(str(name), 40)} is no table that a history has")
        if (table, "table") in made and sql != made.get((name, kind)):
            raise sqlite3.DatabaseError(f"malformed: {plain(str(name), 40)} is not as a history has it")


@lru_cache(maxsize=1)
def _made() -> dict[tuple[str, str], str]:
    """SQL that makes each table and index, by its name and kind."""
    with contextlib.closing(sqlite3.connect(":memory:")) as db:
        db.executescript(SCHEMA)
        return {(name, kind): sql for name, kind, sql in db.execute("SELECT name, type, sql FROM sqlite_master")}


def make_usable(path: Path) -> str:
    """Makes what tables are missing; a damaged file gets another name and a new one begins.

    Returns:
        What was done to a damaged file, for people; empty for a sound one, or one that had only been removed.

    Raises:
        As `make_tables`, but not for damage.
    """
    try:
        make_tables(path)
        return ""
    except sqlite3.DatabaseError as error:
        if not is_damage(error):
            raise
        damage = error
    name = f"{path.name}.damaged-{time.strftime('%Y%m%dT%H%M%S')}"
    taken = sum(p.name.startswith(name) for p in path.parent.iterdir())
    aside = path.with_name(f"{name}-{taken}" if taken else name)
    for suffix in ("", "-wal", "-shm"):
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{suffix}").rename(f"{aside}{suffix}")
    make_tables(path)
    return f"the history was damaged ({damage}); it was set aside as {aside.name}, a new one begins"


def is_damage(error: sqlite3.Error) -> bool:
    """Checks whether an error means that the file is no sound database, not that it cannot be reached now."""
    told = str(error)
    return "malformed" in told or "not a database" in told or "no such table" in told


# --- Reading, without touching the file


@contextlib.contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """A history to read, checked; raises StoreError where it is none, or what is done with it fails."""
    if not path.is_file():
        raise StoreError(f"no history {path}", "a history that a service has written", "use --history")
    try:
        with contextlib.closing(connect(path, read_only=True)) as db:
            check_tables(db)
            for table in _SHOWN:  # rows that share pages would make a small file large
                if db.execute(f"PRAGMA quick_check({table})").fetchone()[0] != "ok":
                    raise sqlite3.DatabaseError("malformed: its pages do not add up")
            yield db
    except (sqlite3.Error, *UNREADABLE) as error:
        raise StoreError(
            f"{path} cannot be read ({error})", "a history that a service has written", "use --history"
        ) from error


def read_history(
    path: Path, vehicle: str, candidates: int = 0, events: int = 0, sets: int = -1
) -> dict[str, list[dict[str, Any]]]:
    """Reads a history without touching it: sets, newest candidates and events, and the names of all vehicles.

    Args:
        candidates: newest candidates to return; events: newest events; sets: newest sets, -1: all.

    Raises:
        StoreError: no such file, or not a history.
    """

    def latest(table: str, most: int) -> list[dict[str, Any]]:
        return newest(db, table, vehicle, f"ORDER BY rowid DESC LIMIT {most}")[::-1]

    with opened(path) as db:
        names = " UNION ".join(f"SELECT vehicle FROM {table}" for table in _SHOWN)
        return {
            "sets": [_set(row) for row in latest("sets", sets)],
            "candidates": [_set(row) for row in latest("candidates", candidates)],
            "events": [dict(msgspec.convert(row, _Event)) for row in latest("events", events)],
            "vehicles": [{"name": name} for (name,) in db.execute(names)],
        }


def newest(
    db: sqlite3.Connection, table: str, vehicle: str, which: str = "ORDER BY id DESC LIMIT 1"
) -> list[dict[str, Any]]:
    """Rows of a vehicle, each by its columns; `which` of them in SQL."""
    found = db.execute(f"SELECT * FROM {table} WHERE vehicle = ? {which}", (vehicle,))
    columns = [column for column, *_ in found.description]
    return [dict(zip(columns, row, strict=True)) for row in found]


_WALL = Annotated[float, msgspec.Meta(ge=0.0, lt=1e11)]
"""UNIX seconds that every calendar has."""


class _Event(TypedDict):
    wall: _WALL
    t: float | None
    level: str
    kind: str
    text: str


def _set(row: Mapping[str, Any]) -> dict[str, Any]:
    """A set as the service would read it back; raises one of `UNREADABLE` for what is none."""
    wall, found = msgspec.convert(row["wall"], _WALL), json.loads(row["data"])
    boot = {"boot_id": str(found["boot_id"])} if "boot_id" in found else {}
    return {"wall": wall, **set_to_dict(set_from_dict(found), "covariance" in found), **boot}


# --- The right to write: one service a vehicle, by whatever name the file is called
#
# The lock lies on the database itself (a byte of the file beyond any content, one a vehicle), so that links, bind
# mounts and cleaners change nothing.  It belongs to an open file description: other locks of this process, as
# SQLite's, and their end leave it alone.  SQLite keeps the log of what is not in the file yet beside its name: services
# of several vehicles share a file, but only by one name in one folder, for which another byte stands.

_FIRST, _NAMES = 1 << 60, (1 << 60) + (1 << 32)
"""First bytes of the locks of vehicles and names: SQLite's lie at 2^30."""
_LOCK, _TEST = (getattr(fcntl, f"F_OFD_{do}", getattr(fcntl, f"F_{do}")) for do in ("SETLK", "GETLK"))
_FREE = struct.pack("h", fcntl.F_UNLCK)


class HistoryLock:
    """The right to write a vehicle's rows into the file that stands under a name.

    A process has one history: the end of a second one on the same file would take SQLite's own locks of it away.
    """

    def __init__(self, path: Path, vehicle: str) -> None:
        """Takes the lock; makes the file where there is none.

        Raises:
            StoreError: another service has it, or the file has a second name.
            OSError: the file cannot be written.
        """
        self._path, self._vehicle = path, vehicle
        self._descriptor = self._taken()

    def moved(self) -> bool:
        """True if another file stands under the name now than before; then that one is locked.

        Raises:
            StoreError: another service has that one.
            OSError: it cannot be written.
        """
        with contextlib.suppress(FileNotFoundError):
            if self._descriptor >= 0 and os.path.samestat(self._path.stat(), os.fstat(self._descriptor)):
                return False
        self.close()
        self._descriptor = self._taken()
        return True

    def close(self) -> None:
        """Lets others write."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1

    def _taken(self) -> int:
        """Descriptor of the file, locked."""
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o644)
        try:
            found, folder = os.fstat(descriptor), self._path.parent.stat()
            if not stat.S_ISREG(found.st_mode):
                raise OSError(0, "not a regular file")
            if found.st_nlink > 1:
                raise StoreError(
                    f"the history {self._path} has {found.st_nlink} names (hard links): by each it would be "
                    "another database",
                    "one name",
                    "remove the other names, or copy the file instead of linking it",
                )
            # Nobody else may have a lock on the byte of another name, before or behind ours.
            name = zlib.crc32(f"{folder.st_dev} {folder.st_ino} {self._path.name}".encode())
            fcntl.fcntl(descriptor, _LOCK, _flock(fcntl.F_RDLCK, _NAMES + name))
            beside = [(_NAMES, name), (_NAMES + name + 1, (1 << 32) - name - 1)]
            tests = [fcntl.fcntl(descriptor, _TEST, _flock(fcntl.F_WRLCK, *part)) for part in beside if part[1]]
            if any(lock[:2] != _FREE for lock in tests):
                raise StoreError(
                    f"another service has the history {self._path} open by another name (as by a bind mount of the "
                    "file): by each it would be another database",
                    "one name in one folder",
                    "mount the folder, not the file",
                )
            fcntl.fcntl(descriptor, _LOCK, _flock(fcntl.F_WRLCK, _FIRST + zlib.crc32(self._vehicle.encode())))
        except BaseException as error:
            os.close(descriptor)
            if isinstance(error, BlockingIOError):
                raise StoreError(
                    f"another service writes the history of '{self._vehicle[:80]}' in {self._path}",
                    "one service a vehicle",
                    "stop the other one, give another history, or start as observer",
                ) from error
            raise
        return descriptor


def _flock(kind: int, first: int, count: int = 1) -> bytes:
    """A `struct flock` of some bytes."""
    return struct.pack("hhqqi", kind, os.SEEK_SET, first, count, 0)


# --- The set in force by a history: one rule for the service that takes it up and for all who read it
#
# Nothing in a file is believed: a set of an earlier run must be one that this run could have estimated.

IN_FORCE = "state IN ('accepted', 'rolled_back') ORDER BY rowid DESC"
SAID = "state IN ('accepted', 'rolled_back', 'stale') ORDER BY rowid DESC"
"""The row of the set last in force, and the row that was last said of it, in SQL;"""
APPROVED = "approved_by NOT IN ('auto', '') AND state != 'stale' ORDER BY rowid DESC"
FIRST = "state = 'accepted' ORDER BY rowid"
"""... the last set that a person approved, and the first one."""
_SAME_MASS = 1e-6
"""Relative difference of masses that were written and read back."""


class StoredSet(NamedTuple):
    """A set of a history.

    Attributes:
        item: the set; None where there is none, or none that can be read.
        why_none: why it cannot be taken up; empty where it can, or where there is none.
        confirmed: whether a flight of the last run confirmed it; after a restart a set is stale until one does.
        row: its columns.
    """

    item: OnlineSet | None
    why_none: str = ""
    confirmed: bool = True
    row: Mapping[str, Any] = MappingProxyType({})

    @property
    def doubt(self) -> str:
        """Reason against using the set, as "out of date: ..."; empty where there is none."""
        if self.why_none:
            return f"no set that a fit makes: {self.why_none}"
        if self.item is not None and self.item.outdated:
            return f"out of date: {self.item.outdated}"
        return "" if self.confirmed else "stale: no flight has confirmed it since the service started again"


def rests_on(vehicle: Vehicle) -> dict[str, Any]:
    """Parts of the vehicle file, beside the mass, that b and the inertias rest on, as each set notes them."""
    file = vehicle.model_dump(mode="json", include={"command", "effects", "mounting"})
    if vehicle.command.kind == "rotor_speed":
        del file["command"]["max_speed"]  # nothing is scaled by it
    return {**file, "rotors": [[*r.position, r.spin] for r in vehicle.rotors]}


def in_force(db: sqlite3.Connection, name: str, gate: GateSettings, vehicle: Vehicle | None) -> StoredSet:
    """The set last in force, with why it is out of date: withdrawn, or it rests on what is not in the vehicle file now.

    Args:
        vehicle: of this run; None: nothing of it is compared.
    """
    last = stored(db, name, IN_FORCE, gate, vehicle)
    if last.item is None or last.why_none:
        return last
    told = stored(db, name, SAID, gate, vehicle).item or last.item
    item = replace(last.item, outdated=told.outdated, outdated_code=told.outdated_code)
    then, now = json.loads(last.row["data"]), rests_on(vehicle) if vehicle is not None else {}
    other = [name for name in now if then.get(name) not in (None, now[name])]
    if other and not item.outdated:
        item = replace(item, outdated=f"it rests on other {' and '.join(other)} than the vehicle file has now")
    if vehicle is not None and not item.outdated and not abs(item.mass / vehicle.mass - 1.0) <= _SAME_MASS:
        rests = "a mass that it does not state" if math.isnan(item.mass) else f"a mass of {item.mass:g} kg"
        why = f"it rests on {rests}, the vehicle file has {vehicle.mass:g} kg"
        item = replace(item, outdated=why, outdated_code="mass_change")
    return last._replace(item=item, confirmed=told.state is not SetState.STALE)


def read_in_force(path: Path, name: str, vehicle: Vehicle | None) -> StoredSet:
    """`in_force` of a history file, which is not touched; raises StoreError."""
    with opened(path) as db:
        return in_force(db, name, GateSettings(), vehicle)


def stored(db: sqlite3.Connection, name: str, which: str, gate: GateSettings, vehicle: Vehicle | None) -> StoredSet:
    """The first set of a vehicle for which the SQL condition `which` holds."""
    rows = newest(db, "sets", name, f"AND {which} LIMIT 1")
    if not rows:
        return StoredSet(None)
    (row,), found = rows, None
    try:
        found = set_from_dict(json.loads(row["data"]))
        return StoredSet(found, why_none(found, row["sequence"], gate, vehicle), row=row)
    except UNREADABLE as error:
        return StoredSet(found, f"{type(error).__name__}: {str(error)[:120]}")


def why_none(found: OnlineSet, number: int, gate: GateSettings, vehicle: Vehicle | None) -> str:
    """Reason why a stored set is none that a fresh estimate could be; empty where it may be one.

    Args:
        vehicle: of this run, whose bounds hold for it; None: those of the set itself.
    """
    if found.sequence != number:
        return f"it says that it is set {str(found.sequence)[:40]} in the row of set {str(number)[:40]}"
    if found.parameters.names not in (NOMINAL_NAMES, LIMITED):
        missing = [n for n in NOMINAL_NAMES if n not in found.parameters.names]
        return (
            f"it lacks {', '.join(missing)}" if missing else f"it has other parameters than {', '.join(NOMINAL_NAMES)}"
        )
    covariance, sigma = found.parameters.covariance, np.array([p.sigma for p in found.parameters])
    if not np.isfinite(covariance).all():
        return "its covariance is not a number"
    # The gate believes its differences and ratios.
    most = np.outer(sigma, sigma)
    if (np.abs(covariance) > 1.01 * most).any() or (np.abs(covariance - covariance.T) > 0.01 * most).any():
        return "its covariance is not that of its standard deviations"
    if vehicle is None:
        return implausible(found.parameters, gate) or ""
    if not math.isnan(found.mass) and not vehicle.mass / ROOM <= found.mass <= vehicle.mass * ROOM:
        return f"it rests on a mass of {found.mass:g} kg, the vehicle has {vehicle.mass:g} kg"
    widest = with_room(vehicle).parameters
    bounded = tuple(replace(p, bounds=widest["b" if p.name == TANGENT else p.name].limits) for p in found.parameters)
    vague = next((p for p in bounded if p.sigma > ROOM * p.bounds[1]), None)
    if vague is not None:
        return f"{vague.name} has a standard deviation of {vague.sigma:g} {vague.unit}"
    return implausible(ParameterSet(bounded, found.parameters.covariance), gate) or ""


# --- What an earlier run left


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


MASS = Annotated[float, msgspec.Meta(ge=0.0, lt=1e6)]
"""A mass [kg]; 0: none."""
NUMBER = Annotated[int, msgspec.Meta(ge=0, lt=LARGEST_NUMBER)]
"""A number of a set."""


@dataclass(frozen=True)
class Restored:
    """State left by an earlier run.

    Attributes:
        item: the set last in force; None: none.
        baseline: what creeping counts from.
        healthy: trims of healthy flights, the oldest first.
        approval: auto or manual where a person decided so while the earlier run was configured as this one, manual
            where that cannot be read; else empty.
        mass: as changes in flight left it since a person last approved a set [kg]; 0: none did.
    """

    item: OnlineSet | None
    next_sequence: int
    baseline: OnlineSet | None = None
    approval: str = ""
    healthy: tuple[FlightTrim, ...] = ()
    decided: str = "a person decided so in an earlier run"
    mass: float = 0.0


# --- The history of one vehicle, open for writing
#
# One thread brings rows to the disk, in order: a slow, full or locked disk never holds up a sample.  It opens the file
# for each transaction, so that between two of them the file is whole without its log, whoever copies, moves or cleans.

KEPT: Mapping[str, int] = MappingProxyType({"candidates": 20_000, "events": 20_000})
"""Rows kept; older ones are forgotten, numbered sets and decisions never."""
MOST_WAITING = 5000
"""Rows kept while the disk cannot take them; beyond, the oldest that pass are lost, and that is reported."""
PRUNE_EVERY = 1000
AGAIN = 1.0
"""Time after which rows that could not be written are tried again [s]."""
_UNFIT = (OverflowError, UnicodeError, sqlite3.ProgrammingError, sqlite3.InterfaceError, sqlite3.IntegrityError)
"""Errors of SQLite for a row that it will never take."""


class Row(NamedTuple):
    """A row that is to be written.

    Attributes:
        number: of the set which may be published once the row is on the disk; 0 for none.
        passes: the row may be lost where there are too many; others hold what is in force and what people decided.
    """

    table: str
    values: dict[str, Any]
    number: int = 0
    passes: bool = False

    def insert(self, db: sqlite3.Connection) -> str:
        """Writes the row; returns why no history can hold it, or nothing."""
        another = "SELECT 1 FROM sets WHERE vehicle = :vehicle AND sequence = :sequence AND data != :data"
        try:
            if self.number and db.execute(another, self.values).fetchone():
                return f"number {self.number} stands for another set already"
            names = tuple(self.values)
            db.execute(f"INSERT INTO {self.table} ({', '.join(names)}) VALUES (:{', :'.join(names)})", self.values)
        except _UNFIT as error:
            return f"{type(error).__name__}: {error}"
        return ""


class Store:
    """History of one vehicle, open for writing.

    Attributes:
        notes: what people should know of what is past: a damaged history set aside, a row refused.
        problem: why nothing is written at the moment, or empty.
        written: numbers of the sets that are on the disk; lost: of those that never will be.
    """

    def __init__(self, path: Path, vehicle: str, kept: Mapping[str, int] = KEPT) -> None:
        """Opens the history, or makes it.

        Args:
            kept: rows that stay, by table; older ones are forgotten.

        Raises:
            StoreError: name or path is none, another program writes this vehicle's history or holds the file, the file
                has a second name, or it is of a newer version.
        """
        try:
            vehicle.encode()
            self.path = Path(os.path.realpath(path))
        except UnicodeEncodeError as error:
            raise StoreError(f"the name {vehicle!r} is no text", "a name in UTF-8", "give another --id") from error
        except ValueError as error:
            raise StoreError(f"{str(path)!r} names no file ({error})", "a path", "give another --history") from error
        self.vehicle, self.boot_id, self._kept = vehicle, uuid.uuid4().hex, kept
        self.notes, self.problem = list[str](), ""
        self.written, self.lost = set[int](), set[int]()
        self._rests: dict[str, Any] = {}
        self._unread = False
        # What waits, and what a new file would begin with: rows by what they stand for, and the healthy flights.
        self._rows: list[Row] = []
        self._standing: dict[str, Row] = {}
        self._flights: deque[Row] = deque(maxlen=MOST_FLIGHTS)
        self._changed = threading.Condition()
        self._closing, self._since_pruned = False, 0
        self._lock: HistoryLock | None = None
        self._writer = threading.Thread(target=self._run, name="history", daemon=True)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = HistoryLock(self.path, vehicle)
        except OSError as error:
            self.problem = f"{self.path} cannot be written ({error.strerror}): nothing of this run is kept or published"
            return
        try:
            if note := make_usable(self.path):
                self.notes.append(note)
                self._unread = True
                self._lock.moved()
        except StoreError:
            self._lock.close()
            raise
        except sqlite3.Error as error:
            self.problem = f"{self.path} cannot be written ({error})"
            if "locked" in str(error):
                self._lock.close()
                found = f"another program holds the history {self.path} ({error})"
                fix = "end that program, or use another history"
                raise StoreError(found, "a history that can be written", fix) from error
        self._writer.start()

    # --- what an earlier run left

    def restore(self, gate: GateSettings | None = None, vehicle: Vehicle | None = None) -> Restored:
        """State left by the last run; a set is taken up again when this `gate` and `vehicle` could have let it pass.

        From now on each set is noted with what it rests on.
        """
        gate, left = gate or GateSettings(), Restored(None, first_number())
        self._rests = rests_on(vehicle) if vehicle is not None else {}
        if self._lock is None or not self.path.is_file() or not self.path.stat().st_size:
            return left
        try:
            with contextlib.closing(connect(self.path)) as db:
                left = self._restored(db, gate, vehicle)
        except sqlite3.Error as error:
            self.notes.append(f"the last set cannot be read back ({error})")
            self._unread = True
        if self._unread:  # nobody knows what people decided
            self.decision(gate.approval, "manual")
            left = replace(left, approval="manual", decided="what people decided in earlier runs cannot be read")
        return left

    def _restored(self, db: sqlite3.Connection, gate: GateSettings, vehicle: Vehicle | None) -> Restored:
        # Sets: the first, the last that a person approved, the one in force, and what was last said of that.
        sets = [stored(db, self.vehicle, which, gate, vehicle) for which in (FIRST, APPROVED)]
        sets += [in_force(db, self.vehicle, gate, vehicle), stored(db, self.vehicle, SAID, gate, vehicle)]
        for found in sets:
            if found.item is not None and not found.why_none:
                self._stands(self._again("sets", found.row, found.item.sequence))
        first, approved, last = (found.item if not found.why_none else None for found in sets[:3])
        whys = dict.fromkeys(found.why_none for found in sets if found.why_none)
        self.notes += [f"a set of the history is no set and is not taken up again ({why})" for why in whys]
        # Healthy flights, the oldest first.
        healthy = []
        for row in newest(db, "healthy_flights", self.vehicle, f"ORDER BY id DESC LIMIT {MOST_FLIGHTS}")[::-1]:
            try:
                healthy.append(flight_from_dict(json.loads(row["data"])))
                self._flights.append(self._again("healthy_flights", row))
            except UNREADABLE as error:
                self.notes.append(f"a healthy flight of the history cannot be read back ({error})")
        # What people decided, as long as the service is configured as it was then, and the mass that changes left.
        approval, mass = "", 0.0
        for row in newest(db, "decisions", self.vehicle):
            self._unread |= row["approval"] not in ("auto", "manual")
            if row["configured"] == gate.approval:
                approval, self._standing["decision"] = row["approval"], self._again("decisions", row)
        for row in newest(db, "masses", self.vehicle):
            try:
                mass = msgspec.convert(row["mass"], MASS)
                self._standing["mass"] = self._again("masses", row)
            except UNREADABLE:
                self._unread = True
        (highest,) = db.execute("SELECT max(sequence) FROM sets WHERE vehicle = ?", (self.vehicle,)).fetchone()
        return Restored(last, first_number(highest or 0), approved or first, approval, tuple(healthy), mass=mass)

    # --- what is journalled

    def journal(self, output: Output) -> None:
        """Journals what a service hands out."""
        match output:
            case Event(t, level, kind, text):
                self._put(self._row("events", passes=True, level=level, kind=kind, text=text, t=t))
            case OnlineDiagnosis():
                quiet = output.verdict == "nothing_found"
                empty = "the simulation agrees with the flight" if quiet else "a change without a known cause"
                text = "; ".join(f"{f.effect}: {f.evidence}" for f in output.findings) or empty
                level, full = "info" if quiet else "warning", json.dumps(diagnosis_to_dict(output))
                row = self._row("events", passes=True, level=level, kind="diagnosis", text=text, t=output.t, data=full)
                self._put(row)
            case HealthyFlight(_, trim):
                self._flights.append(self._row("healthy_flights", data=json.dumps(flight_to_dict(trim))))
                self._put(self._flights[-1])
            case Publish(topic, item):
                if topic == "candidate":
                    data = set_to_dict(item, covariance=False)
                    self._put(self._set_row("candidates", item, data, passes=True, gate=item.check))
                if topic == "parameters" or item.state is SetState.PENDING:
                    self.numbered(item)

    def numbered(self, item: OnlineSet) -> None:
        """Journals a set that was put in force, rolled back to, restored, or waits for approval."""
        number, data = item.sequence, {**set_to_dict(item), "boot_id": self.boot_id, **self._rests}
        row = self._set_row("sets", item, data, number, sequence=number, approved_by=item.approved_by)
        self._stands(row)
        self._put(row)

    def decision(self, configured: str, approval: str) -> None:
        """Journals that approval is now auto or manual by a person's decision, where it was `configured` otherwise."""
        self._standing["decision"] = self._row("decisions", configured=configured, approval=approval)
        self._put(self._standing["decision"])

    def mass(self, mass: float) -> None:
        """Journals the mass that changes in flight left [kg]; 0: a person has approved a set since."""
        self._standing["mass"] = self._row("masses", mass=mass)
        self._put(self._standing["mass"])

    def flush(self, seconds: float) -> bool:
        """Waits until everything is on the disk; False when it is not after so long [s]."""
        with self._changed:
            return self._lock is not None and self._changed.wait_for(lambda: not self._rows, seconds)

    def close(self, seconds: float = 1.5) -> None:
        """Writes what waits, at most for `seconds`, and lets others write."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._lock is not None:
            self._writer.join(seconds)
            self._lock.close()
            self._lock = None

    def _row(self, table: str, number: int = 0, passes: bool = False, **values: Any) -> Row:
        return Row(table, {"vehicle": self.vehicle, "wall": time.time(), **values}, number, passes)

    def _set_row(self, table: str, item: OnlineSet, data: dict[str, Any], number: int = 0, **more: Any) -> Row:
        about: dict[str, Any] = {"state": item.state.value, "reason": item.reason, "stop": item.stop}
        return self._row(table, number, **about, data=json.dumps(data), **more)

    def _again(self, table: str, row: Mapping[str, Any], number: int = 0) -> Row:
        """A row of an earlier run as one that a new file would begin with."""
        return self._row(table, number, **{name: v for name, v in row.items() if name not in ("id", "vehicle", "wall")})

    def _stands(self, row: Row) -> None:
        """Keeps the row of a set where a new file would have to begin with it; what `_restored` looks for."""
        state, by = row.values["state"], row.values["approved_by"]
        if state == "accepted":
            self._standing.setdefault("first", row)
        if state != "stale" and by not in ("auto", ""):
            self._standing["approved"] = row
        if state in ("accepted", "rolled_back"):
            self._standing["last"] = row
        if state in ("accepted", "rolled_back", "stale"):
            self._standing["said"] = row

    # --- the thread that writes

    def _put(self, row: Row) -> None:
        """Takes a row; never waits."""
        with self._changed:
            if self._lock is None:
                return
            self._rows.append(row)
            if len(self._rows) > MOST_WAITING:
                at = next((k for k, waiting in enumerate(self._rows) if waiting.passes), 0)
                self.lost.add(self._rows.pop(at).number)
                self.problem = f"{self.path}: the disk takes nothing, entries are lost"
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._rows or self._closing)
                batch, closing = list(self._rows), self._closing
            if batch:
                self._attempt(batch)
            if closing and not (self._rows and self._lock):
                return
            if self.problem:
                time.sleep(0.2 if closing else AGAIN)

    def _attempt(self, batch: list[Row]) -> None:
        """One transaction for all rows that wait; they leave the queue only when it is on the disk."""
        try:
            refused = self._commit(batch)
        except Exception as error:  # noqa: BLE001 - whatever it is, a history that nobody writes must be reported
            self.problem = f"{self.path} cannot be written ({error}): kept in memory until it can"
            if isinstance(error, sqlite3.Error) and is_damage(error):
                self._begin_anew()
            return
        with self._changed:
            done = {id(row) for row in batch}
            self._rows = [row for row in self._rows if id(row) not in done]
            self.written |= {row.number for row in batch if row.number and id(row) not in refused}
            self.lost |= {row.number for row in batch if id(row) in refused}
            self.notes += [f"an entry that no history can hold was left out ({why})" for why in refused.values()]
            self.problem = ""
            self._changed.notify_all()

    def _commit(self, batch: list[Row]) -> dict[int, str]:
        """Writes and commits; returns why rows can never be written, by the id of the row."""
        if (lock := self._lock) is None:
            raise StoreError(f"the history {self.path} is closed")
        lock.moved()
        with contextlib.closing(connect(self.path)) as db, db:
            refused = {id(row): why for row in batch if (why := row.insert(db))}
            self._since_pruned += len(batch)
            if self._since_pruned >= PRUNE_EVERY:
                self._since_pruned = 0
                for table, kept in self._kept.items():
                    db.execute(f"DELETE FROM {table} WHERE id <= (SELECT max(id) FROM {table}) - ?", (kept,))
            if self._lock is not lock or lock.moved():
                raise sqlite3.OperationalError("it was replaced by another file")
        return refused

    def _begin_anew(self) -> None:
        """After damage while running: a new file begins with what is in force and decided, and what that rests on."""
        try:
            note = make_usable(self.path)
        except (sqlite3.Error, OSError, StoreError) as failure:
            self.problem = f"{self.path} cannot be written ({failure}): kept in memory until it can"
            return
        self.notes += [note] if note else []
        standing = {row.number or -id(row): row for row in (*self._standing.values(), *self._flights)}.values()
        with self._changed:
            self._rows[:0] = [row for row in sorted(standing, key=lambda row: row.number) if row not in self._rows]
