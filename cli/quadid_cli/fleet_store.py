"""Results of a fleet on disk: SQLite while it runs, so that a stopped run goes on where it was; Parquet at its end."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

Row = dict[str, Any]

LOGS: dict[str, str] = {
    "name": "TEXT PRIMARY KEY", "unit": "TEXT", "vehicle": "TEXT", "status": "TEXT", "reason": "TEXT",
    "started": "REAL", "dated_by": "TEXT", "format": "TEXT", "seconds": "REAL", "mse_initial": "REAL",
    "mse_fitted": "REAL", "verdict": "TEXT", "size": "INTEGER", "modified": "INTEGER", "sha256": "TEXT", "key": "TEXT",
    "took": "REAL", "warnings": "TEXT",
}  # fmt: skip
"""Columns of the table of logs: times in [s], started since 1970, size in bytes, modified in ns."""
PARAMETERS: dict[str, str] = {
    "log": "TEXT", "parameter": "TEXT", "unit": "TEXT", "value": "REAL", "low": "REAL", "high": "REAL",
    "status": "TEXT",
}  # fmt: skip
FINDINGS: dict[str, str] = {
    "log": "TEXT", "effect": "TEXT", "confident": "INTEGER", "parameter": "TEXT", "unit": "TEXT", "value": "REAL",
    "low": "REAL", "high": "REAL", "mse_before": "REAL", "mse_after": "REAL",
}  # fmt: skip
TRIMS: dict[str, str] = {"log": "TEXT", "trim": "TEXT"}
"""Trim of a flight as JSON, for the comparison with other flights of its vehicle."""
TABLES = {"logs": LOGS, "parameters": PARAMETERS, "findings": FINDINGS, "trims": TRIMS}
PARTS = ("parameters", "findings", "trims")
"""Tables with rows of a log."""
ENDED = ("done", "refused", "unreadable")
"""Outcomes that the same file would have again."""


class Store:
    """The results of one fleet; every log is written in one transaction as it arrives."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._connection.execute("PRAGMA journal_mode=WAL")
        for table, columns in TABLES.items():
            listed = ", ".join(f'"{name}" {kind}' for name, kind in columns.items())
            self._connection.execute(f"CREATE TABLE IF NOT EXISTS {table} ({listed})")
        for table in PARTS:
            self._connection.execute(f"CREATE INDEX IF NOT EXISTS {table}_log ON {table} (log)")

    def ended(self) -> dict[str, tuple[int, int, str]]:
        """Logs that need not be done again: size, time of change and key by name."""
        marks = ", ".join("?" * len(ENDED))
        found = self._connection.execute(f"SELECT name, size, modified, key FROM logs WHERE status IN ({marks})", ENDED)
        return {name: (size, modified, key) for name, size, modified, key in found}

    def put(self, row: Mapping[str, Any]) -> None:
        """Writes one log's outcome in place of an older one."""
        name = row["name"]
        with self._connection:
            for table in PARTS:
                self._connection.execute(f"DELETE FROM {table} WHERE log = ?", (name,))
                self._insert(table, [{"log": name, **part} for part in row[table]])
            warnings = json.dumps(row["warnings"], ensure_ascii=False)
            self._connection.execute("DELETE FROM logs WHERE name = ?", (name,))
            self._insert("logs", [{"vehicle": None, **row, "warnings": warnings}])

    def keep(self, names: set[str]) -> None:
        """Forgets logs that are no longer in the folder."""
        gone = [(n,) for (n,) in self._connection.execute("SELECT name FROM logs") if n not in names]
        with self._connection:
            self._connection.executemany("DELETE FROM logs WHERE name = ?", gone)
            for table in PARTS:
                self._connection.executemany(f"DELETE FROM {table} WHERE log = ?", gone)

    def rows(self, table: str) -> list[Row]:
        """All rows of a table, in the order of their log's name."""
        columns = list(TABLES[table])
        first = "name" if table == "logs" else "log"
        quoted = ", ".join(f'"{c}"' for c in columns)
        found = self._connection.execute(f"SELECT {quoted} FROM {table} ORDER BY {first}, rowid")
        return [dict(zip(columns, values, strict=True)) for values in found]

    def write_parquet(self, folder: Path) -> list[Path]:
        """Writes every table as a Parquet file that pandas, polars, DuckDB and Spark read; returns their paths."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        kinds = {"TEXT": pa.string(), "REAL": pa.float64(), "INTEGER": pa.int64()}
        files = []
        for table, columns in TABLES.items():
            schema = pa.schema([(name, kinds[kind.split()[0]]) for name, kind in columns.items()])
            path = folder / f"fleet.{table}.parquet"
            pq.write_table(pa.Table.from_pylist(self.rows(table), schema=schema), path, compression="zstd")
            files.append(path)
        return files

    def _insert(self, table: str, rows: list[Row]) -> None:
        columns = list(TABLES[table])
        listed, marks = ", ".join(f'"{c}"' for c in columns), ", ".join("?" * len(columns))
        values = [[row[c] for c in columns] for row in rows]
        self._connection.executemany(f"INSERT INTO {table} ({listed}) VALUES ({marks})", values)


@contextmanager
def open_store(path: Path) -> Iterator[Store]:
    """Opens or makes the SQLite file."""
    connection = sqlite3.connect(path)
    try:
        yield Store(connection)
    finally:
        connection.close()
