"""The page of faults: only passed tests speak, and rows without evidence say so."""

import json
import subprocess
import sys
from pathlib import Path

from tests.faults.evidence import Evidence, page
from tests.faults.fault_list import FAULTS

TESTS = """
from tests.faults.evidence import Collector, happened
from pathlib import Path
import sys
import pytest

def test_green(happened, tmp_path):
    happened(1, "cut at | 300 places\\n of <b>")
    happened(1, f"'{sys.executable}: {tmp_path / 'out' / 'f.csv'}' in /tmp")
def test_red(happened):
    happened(2, "never true"); assert False
def test_absent(happened):
    happened(3, "never seen"); pytest.skip("not here")
def test_silent(): raise AssertionError("does not run")
"""
CONFTEST = """
from pathlib import Path
from tests.faults.evidence import Collector, happened
def pytest_configure(config):
    config.pluginmanager.register(Collector(Path("page.md"), "make faults", not hasattr(config, "workerinput")))
"""


def test_only_what_a_passed_test_said_gets_into_the_page(tmp_path: Path, repository: Path) -> None:
    (tmp_path / "test_x.py").write_text(TESTS)
    (tmp_path / "conftest.py").write_text(CONFTEST)
    known = [[4, "renamed since", "test_x.py::test_before[1]"], [5, "not run now", "test_x.py::test_silent[1]"]]
    known += [[6, "in a group", "test_x.py::test_silent@test_x.py"], [6, "an @", "test_x.py::test_silent[a@b]"]]
    known += [[1, "of an earlier run", "test_x.py::test_green@test_x.py", "2026-01-01"]]
    (tmp_path / "page.json").write_text(json.dumps(known))
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", "-c", str(tmp_path / "none.ini"), str(tmp_path)]
    (tmp_path / "none.ini").write_text("[pytest]\n" + f"pythonpath = {repository}\n")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=900)
    assert "1 failed, 1 passed, 1 skipped" in done.stdout, done.stdout
    text = (tmp_path / "page.md").read_text()
    account = json.loads((tmp_path / "page.json").read_text())
    said = {text for _, text, _, _ in account}
    assert {"cut at | 300 places of <b>", f"'{Path(sys.executable).name}: f.csv' in /tmp", "not run now"} <= said
    assert not said & {"never true", "never seen", "renamed since"}
    assert "of an earlier run" not in (tmp_path / "page.json").read_text()
    assert {t for _, _, t, _ in account} == {
        f"test_x.py::test_{name}" for name in ("green", "silent", "silent[1]", "silent[a@b]")
    }
    assert f"3 of {len(FAULTS)} rows have evidence, from 4 tests" in text
    assert "Failed: `test_x.py::test_red`" in text
    assert "Skipped: `test_x.py::test_absent`" in text


def test_every_row_is_listed_once_with_its_number() -> None:
    said = [Evidence(7, "second", "b::x"), Evidence(7, "once more", "a::z"), Evidence(7, "first", "a::y")]
    text = page(said, [], [], "make faults")
    assert [line.endswith("| 3 |") for line in text.splitlines() if line.startswith("| 7. ")] == [True]
    assert text.count("no test of this row passed") == len(FAULTS) - 1
    assert list(FAULTS) == list(range(1, len(FAULTS) + 1))
