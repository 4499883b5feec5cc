"""When there is no answer, the report still says why and shows the data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.cli.conftest import Flights, table, write_table
from tests.commands import Cli, one_line


@pytest.mark.parametrize("command", ["identify", "diagnose"])
def test_wrong_units_are_refused_and_shown(inside: Cli, flights: Flights, tmp_path: Path, command: str) -> None:
    names, rows = table(flights.unseen)
    for c in (names.index(n) for n in ("p", "q", "r")):
        rows[:, c] = np.rad2deg(rows[:, c])
    log = write_table(tmp_path / "degrees.csv", names, rows)
    report = tmp_path / "why.html"
    run = inside(command, log, "--vehicle", "pelican", "--out", tmp_path, "--report", report)
    line = one_line(run, 2)
    assert f"the data as they are: {report}" in run.err
    page = report.read_text(encoding="utf-8")
    assert "No answer: degrees.csv:" in page
    assert "Nothing was identified" in page
    for shown in ("rotor speed", "gyro", "sha256", "What degrees.csv allows"):
        assert shown in page
    assert line.split(": ")[1] in page


def test_logs_that_cannot_be_read_are_named(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    (tmp_path / "empty.bin").write_bytes(b"")
    report = tmp_path / "why.html"
    run = inside("identify", flights.train, tmp_path / "empty.bin", "--vehicle", "pelican", "--report", report,
                 "--out", tmp_path)  # fmt: skip
    one_line(run, 2)
    page = report.read_text(encoding="utf-8")
    assert "empty.bin" in page
    assert "train.mcap" in page


def test_a_good_report_says_what_to_fly_next(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    report = tmp_path / "good.html"
    run = inside("identify", flights.train, "--vehicle", "pelican", "--report", report, "--out", tmp_path)
    assert run.code == 0, run.err
    page = report.read_text(encoding="utf-8")
    assert "What to fly next" in page
    assert "Cramér–Rao" in page
    assert len(page) < 6_000_000
