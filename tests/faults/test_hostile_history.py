"""A history that a stranger filled: shown without a character that a terminal acts on, or refused in one line."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest
from quadid_node.history import Store
from quadid_node.messages import set_to_dict

from tests.commands import Cli, inside
from tests.faults.evidence import Happened
from tests.online.test_gate import TRUE, online_set

__all__ = ["inside"]
EVIL = "\x1b[31mred\u202eevil\u2028x\x85y\x9bz\x00 [bold red]m[/] <script>"
FIELDS = ("reason", "approved_by", "outdated", "check", "input_hash")
ROWS: dict[str, tuple[str, object]] = {
    "texts": ("data", json.dumps({**set_to_dict(online_set(TRUE)), **dict.fromkeys(FIELDS, EVIL)})),
    "a time of 1e300": ("wall", 1e300), "a time of words": ("wall", "abc"), "a time of bytes": ("wall", b"\xff"),
    "an endless time": ("wall", float("inf")), "a list": ("data", "[]"), "a number": ("data", "3"),
    "bytes": ("data", b"\xff\xfe"),
    "words for a stamp": ("data", json.dumps({**set_to_dict(online_set(TRUE)), "stop": "x"})),
    "no state": ("data", json.dumps({**set_to_dict(online_set(TRUE)), "state": None})),
    "parameters that are none": ("data", json.dumps({**set_to_dict(online_set(TRUE)), "parameters": [1]})),
}  # fmt: skip


@pytest.mark.parametrize("what", ROWS)
def test_a_history_of_a_stranger_is_shown_as_text_or_refused_in_one_line(
    what: str, tmp_path: Path, inside: Cli, happened: Happened
) -> None:
    path, (column, value) = tmp_path / "h.sqlite", ROWS[what]
    store = Store(path, "pelican")
    store.numbered(replace(online_set(TRUE), sequence=7, approved_by="auto"))
    assert store.flush(10.0)
    store.close()
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute(f"UPDATE sets SET {column} = ?", (value,))
        db.execute(
            "INSERT INTO events (vehicle, level, kind, text, t, wall) VALUES ('pelican', ?, ?, ?, 1.0, 1e9)",
            (EVIL, EVIL, EVIL),
        )
    run = inside("history", "--vehicle", "pelican", "--history", path, "--events", "9", "--json", "-")
    shown = inside("history", "--vehicle", "pelican", "--history", path, "--events", "9")
    for told in (run, shown):
        assert told.code == (0 if what == "texts" else 2), told.err
        assert all(c.isprintable() or c == "\n" for c in told.out + told.err)
        assert "Traceback" not in told.err
    if what == "texts":
        assert run.data["events"][0]["text"] == EVIL, "JSON holds it, escaped"
        assert shown.out.count("evil") >= 4
    else:
        assert shown.err.count("\n") == 1
    happened(44, f"stored sets with {what}: `quadid history` ends with {shown.code}, no control character")
