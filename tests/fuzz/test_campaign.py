"""A short campaign over each reader, and the guards themselves."""

from __future__ import annotations

from random import Random

import pytest

from tests.faults.evidence import Happened
from tests.fuzz import campaign
from tests.fuzz.formats import FORMATS
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
