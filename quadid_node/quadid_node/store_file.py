"""SQLite file of the history: schema, damage, and one writer at a time."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import sqlite3
import stat
import struct
import threading
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from quadid.errors import QuadidError
from quadid.sanitise import plain

# --- The history file: how it is made, opened, set aside when damaged, and read without touching it


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
"""
VERSION = 2
"""2: stamps are UNIX seconds; before, seconds of a day."""
BUSY_SECONDS = 5.0
"""How long another program's lock is waited for [s]."""


_SHOWN = ("sets", "candidates", "events")
_NAMES = " UNION ".join(f"SELECT vehicle FROM {table}" for table in _SHOWN)


UNREADABLE = (ValueError, TypeError, LookupError, OverflowError, RecursionError, QuadidError)
"""What rows raise that hold something else than this program has written."""


class StoreError(QuadidError):
    """A history that another service writes, or that is not there."""


def read_history(
    path: Path, vehicle: str, candidates: int = 0, events: int = 0, sets: int = -1
) -> dict[str, list[dict[str, Any]]]:  # fmt: skip
    """Reads a history without touching it: sets, newest candidates and events, and the names of all vehicles.

    Args:
        path: database file.
        vehicle: name of the vehicle.
        candidates: newest candidates to return; events: newest events; sets: newest sets, -1: all.

    Raises:
        StoreError: no such file, or not a history.
    """
    with opened(path) as db:
        return {
            "sets": _newest(db, "SELECT wall, data", "sets", vehicle, sets),
            "candidates": _newest(db, "SELECT wall, data", "candidates", vehicle, candidates),
            "events": _newest(db, "SELECT wall, t, level, kind, text", "events", vehicle, events),
            "vehicles": [{"name": n} for (n,) in db.execute(_NAMES)],
        }


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


def _newest(db: sqlite3.Connection, what: str, table: str, vehicle: str, most: int) -> list[dict[str, Any]]:
    found = _rows(db, f"{what} FROM {table} WHERE vehicle = ? ORDER BY rowid DESC LIMIT ?", (vehicle, most))
    return found[::-1]


def _rows(db: sqlite3.Connection, statement: str, values: tuple[Any, ...]) -> list[dict[str, Any]]:
    cursor = db.execute(statement, values)
    names = [c[0] for c in cursor.description]

    def entries() -> Iterator[dict[str, Any]]:
        for row in cursor:
            entry = dict(zip(names, row, strict=True))
            if "data" in entry:
                entry |= dict(json.loads(entry.pop("data")))
            yield entry

    return list(entries())


def connect(path: Path, read_only: bool = False) -> sqlite3.Connection:
    """Opens the file; for writing in WAL mode, every transaction on the disk before it counts.

    Raises:
        StoreError: a history of a newer version: it is not damaged, and nothing in it is changed.
        sqlite3.Error: it cannot be opened.
    """
    name = f"{path.absolute().as_uri()}?mode=ro" if read_only else path
    db = sqlite3.connect(name, uri=read_only, timeout=BUSY_SECONDS)
    try:
        db.execute("PRAGMA trusted_schema = OFF")
        (version,) = db.execute("PRAGMA user_version").fetchone()
        if not 0 <= version <= VERSION:
            raise StoreError(
                f"the history {path} has version {version}", f"up to {VERSION}",
                "use the version of quadid that wrote it, or another history",
            )  # fmt: skip
        if not read_only:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
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
    """How each table and index is made, by its name and kind."""
    with contextlib.closing(sqlite3.connect(":memory:")) as db:
        db.executescript(SCHEMA)
        return {(name, kind): sql for name, kind, sql in db.execute("SELECT name, type, sql FROM sqlite_master")}


def begin_anew(path: Path, error: sqlite3.Error) -> str:
    """Makes the tables of a file found damaged; sets it aside under another name where it really is.

    Returns:
        What was done, or empty when the file had only been removed.
    """
    try:
        make_tables(path)  # the file was removed, or another service has dealt with it
    except sqlite3.DatabaseError as found:
        if not is_damage(found):
            raise
        return set_aside(path, error)
    return ""


def set_aside(path: Path, error: sqlite3.Error) -> str:
    """Gives a damaged file another name and makes a new one; returns what was done."""
    name = f"{path.name}.damaged-{time.strftime('%Y%m%dT%H%M%S')}"
    taken = sum(p.name.startswith(name) for p in path.parent.iterdir())
    aside = path.with_name(f"{name}-{taken}" if taken else name)
    for suffix in ("", "-wal", "-shm"):
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{suffix}").rename(f"{aside}{suffix}")
    make_tables(path)
    return f"the history was damaged ({error}); it was set aside as {aside.name}, a new one begins"


def is_damage(error: sqlite3.Error) -> bool:
    """Whether an error says that the file is no sound database, not that it cannot be reached now."""
    told = str(error)
    return "malformed" in told or "not a database" in told or "no such table" in told


# --- Who may write a history: one service a vehicle, by whatever name the file is called
#
# The lock lies on the database itself (a byte of the file beyond any content, one a vehicle), so that links, bind
# mounts and cleaners change nothing.  It belongs to an open file description: other locks of this process, as
# SQLite's, and their end leave it alone.


_FIRST = 1 << 60
"""First byte of the locks: SQLite's lie at 2^30."""
_LOCK = getattr(fcntl, "F_OFD_SETLK", fcntl.F_SETLK)
_File = tuple[int, int]
"""Device and inode."""
_guard = threading.Lock()
_descriptors: dict[_File, int] = {}
"""Files with a lock of this process: closing one would take SQLite's own locks of it away, so each is opened once."""
_users: Counter[_File] = Counter()
_held: set[tuple[_File, str]] = set()


def text(vehicle: str) -> str:
    """The name as it was given; raises StoreError for one that is no text (bytes of another encoding)."""
    try:
        vehicle.encode()
    except UnicodeEncodeError as error:
        raise StoreError(f"the name {vehicle!r} is no text", "a name in UTF-8", "give another --id") from error
    return vehicle


def real(path: Path) -> Path:
    """The file that a path leads to; raises StoreError where no file can have that name."""
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:
        raise StoreError(f"{str(path)!r} names no file ({error})", "a path", "give another --history") from error


class HistoryLock:
    """The right to write a vehicle's rows into the file that stands under a name."""

    def __init__(self, path: Path, vehicle: str) -> None:
        """Takes the lock; makes the file where there is none.

        Raises:
            StoreError: another service has it, or the file has a second name.
            OSError: the file cannot be written.
        """
        self._path, self._vehicle = path, vehicle
        self._file: _File | None = None
        self._take()

    def moved(self) -> bool:
        """True if another file stands under the name now than before; then that one is locked.

        Raises:
            StoreError: another service has that one.
            OSError: it cannot be written.
        """
        try:
            found = self._path.stat()
        except FileNotFoundError:
            found = None
        if found is not None and (found.st_dev, found.st_ino) == self._file:
            return False
        self.close()
        self._take()
        return True

    def close(self) -> None:
        """Lets others write."""
        with _guard:
            file, self._file = self._file, None
            if file is None:
                return
            _held.discard((file, self._vehicle))
            fcntl.fcntl(_descriptors[file], _LOCK, self._byte(fcntl.F_UNLCK))
            _done_with(file)

    def _take(self) -> None:
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o644)
        found = os.fstat(descriptor)
        file = (found.st_dev, found.st_ino)
        with _guard:
            if file in _descriptors and _descriptors[file] != descriptor:
                os.close(descriptor)
            else:
                _descriptors[file] = descriptor
            _users[file] += 1
            try:
                if not stat.S_ISREG(found.st_mode):
                    raise OSError(0, "not a regular file")
                self._check(found.st_nlink, file)
                fcntl.fcntl(_descriptors[file], _LOCK, self._byte(fcntl.F_WRLCK))
            except BlockingIOError as error:
                _done_with(file)
                raise self._taken() from error
            except (StoreError, OSError):
                _done_with(file)
                raise
            _held.add((file, self._vehicle))
            self._file = file

    def _check(self, names: int, file: _File) -> None:
        if names > 1:
            raise StoreError(
                f"the history {self._path} has {names} names (hard links): by each it would be another database",
                "one name", "remove the other names, or copy the file instead of linking it",
            )  # fmt: skip
        if (file, self._vehicle) in _held:
            raise self._taken()

    def _taken(self) -> StoreError:
        return StoreError(
            f"another service writes the history of '{self._vehicle[:80]}' in {self._path}", "one service a vehicle",
            "stop the other one, give another history, or start as observer",
        )  # fmt: skip

    def _byte(self, kind: int) -> bytes:
        """A `struct flock` of the byte that stands for the vehicle."""
        return struct.pack("hhqqi", kind, os.SEEK_SET, _FIRST + zlib.crc32(self._vehicle.encode()), 1, 0)


def _done_with(file: _File) -> None:
    _users[file] -= 1
    if not _users[file]:
        del _users[file]
        os.close(_descriptors.pop(file))
