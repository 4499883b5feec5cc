"""A short campaign over each reader, the guards themselves, and the account of what was tried."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from random import Random

import msgpack
import pytest

from quadid.data.window import Recording
from tests.faults.evidence import Happened
from tests.fuzz import book, campaign, rosbag2_format
from tests.fuzz.formats import FLOODED, FORMATS
from tests.fuzz.seeds import seeds

COUNT = 400
FROM = 10**9
"""Numbers that `make fuzz` does not reach: these inputs are others than those of the page."""
ROW = {"mcap": 1, "rosbag2": 1, "tlog": 3, "dataflash": 3, "ulog": 4, "usdlog": 4, "blackbox": 4}


@pytest.mark.parametrize("kind", FORMATS)
def test_mutated_logs_are_read_or_refused_in_one_line(kind: str, happened: Happened) -> None:
    outcome = campaign.run(kind, FROM, COUNT)
    assert outcome.findings == ()
    assert outcome.read > 0.1 * COUNT
    assert outcome.refused > 0.05 * COUNT
    happened(
        ROW[kind],
        f"{COUNT} {kind} logs mutated in records, lengths and checksums: {outcome.read} read, {outcome.refused} "
        f"refused with a reason, {outcome.stopped} stopped by the guard of time or memory, nothing else",
    )


@pytest.mark.parametrize("kind", FORMATS)
def test_seeds_are_whole_logs_whose_records_are_known(kind: str) -> None:
    form = FORMATS[kind]
    for seed in seeds(kind):
        records = form.split(seed)
        assert b"".join(records) == seed
        assert any(form.define(Random(n), record) != record for n in range(20) for record in records)
    assert campaign.input_of(kind, 7) == campaign.input_of(kind, 7)
    assert len({campaign.input_of(kind, n) for n in range(50)}) > 40


@pytest.mark.parametrize(
    ("kind", "filler"), [("tlog", b"\xfe"), ("ulog", b"\x00"), ("mcap", b"\x00"), ("dataflash", b"\xa3\x95\x80")]
)
def test_inputs_grow_by_filler_and_stay_within_the_largest_size(kind: str, filler: bytes) -> None:
    longest = 0
    for number in range(20_000):
        data = campaign.input_of(kind, number)
        longest = max(longest, len(data))
        if filler * (FLOODED[0] // len(filler) // 2) in data:
            break
    else:
        raise AssertionError("no input with this filler")
    assert longest < 2 * FLOODED[-1]


def _greedy(path: Path, preset: str) -> Recording:
    bytearray(campaign.LIMIT + (64 << 20))
    raise AssertionError("the limit did not hold")


def _slow(path: Path, preset: str) -> Recording:
    while time.process_time() < 1e9:
        pass
    raise AssertionError("the guard did not strike")


@pytest.mark.parametrize("value", [7, "text", {"a": 1}, [[]], [{}, 1], []])
def test_a_row_that_mutations_made_something_else_is_passed_over(value: object) -> None:
    packed = msgpack.packb(value)
    record = len(packed).to_bytes(4, "little") + packed
    assert rosbag2_format.define(Random(1), record)[:4]
    good = rosbag2_format.row("topics", 1, "name", "type", "cdr", "")
    assert rosbag2_format.finish(record + good) == rosbag2_format.finish(good)


@pytest.mark.parametrize("reader", [_greedy, _slow])
def test_guards_strike(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, reader: object) -> None:
    monkeypatch.setattr(campaign, "read_here", reader)
    monkeypatch.setattr(campaign, "SECONDS", 0.2)
    old = signal.signal(signal.SIGPROF, campaign._expired)
    with campaign.memory_limit():
        assert campaign.judge(tmp_path / "log") == ("stopped", "", "")
    signal.signal(signal.SIGPROF, old)
    assert signal.getitimer(signal.ITIMER_PROF)[0] == 0.0


def test_the_account_goes_on_where_it_stopped(tmp_path: Path) -> None:
    path = tmp_path / "fuzz.json"
    entry = {
        "read": 1,
        "refused": 1,
        "findings": 0,
        "seconds": 1.0,
        "date": "2026-01-01",
        "revision": "abc",
    }
    account = book.load(path)
    for start in (0, 10, 20):
        runs = account.setdefault("mcap", [])
        assert book.next_input(runs) == start
        book.note(runs, {**entry, "start": start, "stop": start + 10, "date": f"2026-01-0{1 + start // 20}"})
    path.with_suffix(".md").write_text("old\n\n## Judged by hand\n\n* run again\n", encoding="utf-8")
    book.save(path, account)
    assert [run["stop"] for run in book.load(path)["mcap"]] == [20, 30]
    page = path.with_suffix(".md").read_text(encoding="utf-8")
    assert "| mcap | 30 |" in page
    assert page.endswith("\n## Judged by hand\n\n* run again\n")
