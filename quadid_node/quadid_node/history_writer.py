"""The thread that brings rows of a history to the disk, in order, and knows which of them are there.

A slow, full or locked disk never holds up a sample: rows wait here, and are tried again until they can be written.
"""

from __future__ import annotations

import contextlib
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from quadid_node.store_file import StoreError, begin_anew, connect, is_damage
from quadid_node.store_lock import HistoryLock

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
