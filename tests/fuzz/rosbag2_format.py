"""Structure of a rosbag2 database for the fuzzer: its rows; `finish` makes the database of what rows are left."""

import sqlite3
from collections.abc import Sequence
from functools import lru_cache
from random import Random
from typing import Any

import msgpack

from tests.fuzz.text_mutated import mutate_text

TABLES = {
    "topics": "id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT",
    "message_definitions": "id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT, encoded_message_definition TEXT",
    "messages": "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB",
}
_WRONG: Sequence[Any] = (None, 0, -1, 2**63 - 1, 1.5, "", "text", b"", b"\xff" * 40)


def row(table: str, *values: Any) -> bytes:
    """One row as a record: length, then table and values."""
    packed = bytes(msgpack.packb([table, *values]))
    return len(packed).to_bytes(4, "little") + packed


def split(data: bytes) -> list[bytes]:
    """The rows of a seed."""
    records, at = [], 0
    while at + 4 <= len(data):
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        records.append(data[at:end])
        at = end
    return records


def _parts(record: bytes) -> list[Any]:
    """Table and values of a row; nothing where mutations left no list."""
    try:
        parts = msgpack.unpackb(record[4:])
    except (ValueError, TypeError, msgpack.UnpackException):
        return []
    return parts if isinstance(parts, list) else []


def define(rng: Random, record: bytes) -> bytes:
    """A value of a row replaced by one of another kind, or its text changed."""
    table, *values = _parts(record) or [None]
    if not values:
        return record
    at = rng.randrange(len(values))
    texts = [k for k, v in enumerate(values) if isinstance(v, str)]
    if texts and rng.random() < 0.7:
        at = rng.choice(texts)
        values[at] = mutate_text(rng, values[at])
    else:
        values[at] = rng.choice(_WRONG)
    return row(table, *values)


def repair(rng: Random, record: bytes) -> bytes:
    """The length of a row, which mutations have made wrong."""
    return len(record[4:]).to_bytes(4, "little") + record[4:]


def finish(data: bytes) -> bytes:
    """The database with the rows that can be stored."""
    with sqlite3.connect(":memory:") as connection:
        connection.deserialize(_empty())
        for record in split(data):
            table, *values = _parts(record) or [None]
            if not isinstance(table, str) or table not in TABLES:
                continue
            try:
                marks = ",".join("?" * len(values))
                connection.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", values)
            except (ValueError, TypeError, OverflowError, sqlite3.Error):
                continue
        connection.commit()
        out = connection.serialize()
    connection.close()
    return out


@lru_cache(maxsize=1)
def _empty() -> bytes:
    connection = sqlite3.connect(":memory:")
    connection.execute("PRAGMA page_size=512")
    for name, columns in TABLES.items():
        connection.execute(f"CREATE TABLE {name} ({columns})")
    connection.commit()
    data = connection.serialize()
    connection.close()
    return data
