"""The history file: how it is opened, and how it is read without touching it."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from quadid.errors import QuadidError

BUSY_SECONDS = 5.0
"""How long another program's lock is waited for [s]."""


_NAMES = " UNION ".join(f"SELECT vehicle FROM {table}" for table in ("sets", "candidates", "events"))


class StoreError(QuadidError):
    """A history that another service writes, or that is not there."""


def read_history(path: Path, vehicle: str, candidates: int = 0, events: int = 0) -> dict[str, list[dict[str, Any]]]:
    """Reads a history without touching it: sets, newest candidates and events, and the names of all vehicles.

    Args:
        path: database file.
        vehicle: name of the vehicle.
        candidates: newest candidates to return; events: newest events.

    Raises:
        StoreError: no such file, or not a history.
    """
    if not path.is_file():
        raise StoreError(f"no history {path}", "a history that a service has written", "give --history")
    try:
        with contextlib.closing(connect(path, read_only=True)) as db:
            return {
                "sets": _rows(db, "SELECT wall, data FROM sets WHERE vehicle = ? ORDER BY rowid", (vehicle,)),
                "candidates": _newest(db, "SELECT wall, data", "candidates", vehicle, candidates),
                "events": _newest(db, "SELECT wall, t, level, kind, text", "events", vehicle, events),
                "vehicles": [{"name": n} for (n,) in db.execute(_NAMES)],
            }
    except (sqlite3.Error, ValueError) as error:
        raise StoreError(
            f"{path} cannot be read ({error})", "a history that a service has written", "give --history"
        ) from error


def _newest(db: sqlite3.Connection, what: str, table: str, vehicle: str, most: int) -> list[dict[str, Any]]:
    found = _rows(db, f"{what} FROM {table} WHERE vehicle = ? ORDER BY id DESC LIMIT ?", (vehicle, most))
    return found[::-1]


def _rows(db: sqlite3.Connection, statement: str, values: tuple[Any, ...]) -> list[dict[str, Any]]:
    cursor = db.execute(statement, values)
    names = [c[0] for c in cursor.description]

    def entries() -> Iterator[dict[str, Any]]:
        for row in cursor:
            entry = dict(zip(names, row, strict=True))
            if "data" in entry:
                entry |= json.loads(entry.pop("data"))
            yield entry

    return list(entries())


def connect(path: Path, read_only: bool = False) -> sqlite3.Connection:
    """Opens the file; for writing in WAL mode, every transaction on the disk before it counts."""
    if read_only:
        return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=BUSY_SECONDS)
    db = sqlite3.connect(path, timeout=BUSY_SECONDS)
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("PRAGMA synchronous = FULL")
    return db
