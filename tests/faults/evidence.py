"""Measurements of tests against the rows of `tests.faults.fault_list`: collected, and written as one page.

A test asks for the fixture `happened` and says what it saw, in one sentence with figures, next to the assertion that
holds it.  `pytest --faults-page FILE tests` (`make faults`) runs the tests that do so, and writes the table.  Only what
a passed test said gets into it.  An account beside the page (JSON) keeps what was said when: a run of some of the tests
replaces what these said, and takes out those that failed, and those whose test is gone.
"""

import json
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import pytest
from quadid_evaluation.harness import judged

from tests.faults.fault_list import FAULTS

Happened = Callable[[int, str], None]

_KEY = "fault"
_FOLDERS = (
    Path(__file__).resolve().parents[2],
    Path(sys.prefix),
    Path.home(),
    Path(tempfile.gettempdir()) / "pytest-of-",
)
_HERE = re.compile(f"(?:{'|'.join(re.escape(str(folder)) for folder in _FOLDERS)})(?:[^\\s'\":,;]*/)?")
"""Folders of this machine, which the page in the repository leaves out."""


class Evidence(NamedTuple):
    """One sentence of a test about one row, and the day on which it passed."""

    row: int
    text: str
    test: str
    date: str = ""


@pytest.fixture
def happened(request: pytest.FixtureRequest) -> Happened:
    """`happened(row, text)`: records what was measured against that row of the table, should the test pass."""

    def say(row: int, text: str) -> None:
        if row not in FAULTS:
            raise ValueError(
                f"no row {row} among the faults {min(FAULTS)}..{max(FAULTS)} of tests/faults/fault_list.py"
            )
        request.node.user_properties.append((_KEY, [row, _HERE.sub("", " ".join(text.split()))]))

    return say


class Collector:
    """Pytest plugin: keeps the tests that give evidence, gathers what passed ones said, and writes the page."""

    def __init__(self, page: Path, command: str, writes: bool) -> None:
        self.page, self.command, self.writes = page, command, writes
        self.evidence: list[Evidence] = []
        self.failed: list[str] = []
        self.skipped: list[str] = []

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Deselects the tests that say nothing of faults."""
        silent = [item for item in items if "happened" not in getattr(item, "fixturenames", ())]
        if silent:
            config.hook.pytest_deselected(items=silent)
            items[:] = [item for item in items if item not in set(silent)]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Takes a test's sentences once it has passed; with xdist this runs where the reports come together."""
        test = _alone(report.nodeid)
        if report.failed:
            self.failed.append(test)
        elif report.skipped:
            self.skipped.append(test)
        elif report.when == "call":
            self.evidence += [
                Evidence(value[0], value[1], test, f"{datetime.now(UTC):%Y-%m-%d}")
                for key, value in report.user_properties
                if key == _KEY and isinstance(value, (list, tuple))
            ]

    def pytest_sessionfinish(self) -> None:
        """Writes the page when all tests are done."""
        if not self.writes:
            return
        account = self.page.with_suffix(".json")
        kept = json.loads(account.read_text(encoding="utf-8")) if account.exists() else []
        known = [Evidence(row, text, _alone(test), *day) for row, text, test, *day in kept]
        ran = {e.test for e in self.evidence} | set(self.failed)
        told = sorted(
            [*(e for e in known if e.test not in ran and _stands(e.test)), *self.evidence],
            key=lambda e: (e.row, e.test),
        )
        self.page.parent.mkdir(parents=True, exist_ok=True)
        account.write_text(json.dumps(told, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        text = page(told, self.failed, self.skipped, self.command) + judged(self.page)
        self.page.write_text(text, encoding="utf-8")


def _alone(test: str) -> str:
    """The name of a test without the group that xdist ran it in."""
    name, at, group = test.rpartition("@")
    return name if at and not group.endswith("]") else test


def _stands(test: str) -> bool:
    """Checks whether a test, as pytest names it, is still in its file."""
    file, _, name = test.partition("::")
    function = name.split("[")[0].rsplit("::", 1)[-1]
    return Path(file).exists() and f"def {function}(" in Path(file).read_text(encoding="utf-8")


def page(evidence: Sequence[Evidence], failed: Sequence[str], skipped: Sequence[str], command: str) -> str:
    """Markdown of the page: command, one row a fault with the number of its tests, and what failed or was skipped."""
    rows: Mapping[int, list[Evidence]] = {n: [e for e in evidence if e.row == n] for n in FAULTS}
    green = sum(1 for said in rows.values() if said)
    lines = [
        "# Faults: promise and observation",
        "",
        f"`{command}`: tests inject each fault and record what happened. Only passed tests count; what they "
        "observed is in `faults.json`.",
        "",
        f"{green} of {len(FAULTS)} rows have evidence, from {len({e.test for e in evidence})} tests{_days(evidence)}.",
        "",
        "| fault | promise | passed tests |",
        "|---|---|---|",
        *(_row(number, *FAULTS[number], rows[number]) for number in FAULTS),
    ]
    for title, names in (("Failed", failed), ("Skipped", skipped)):
        if names:
            lines += ["", f"{title}: " + ", ".join(f"`{name}`" for name in sorted(set(names))) + "."]
    return "\n".join(lines) + "\n"


def _row(number: int, fault: str, promise: str, said: Sequence[Evidence]) -> str:
    left = f"| {number}. {_cell(fault)} | {_cell(promise)} |"
    if not said:
        return f"{left} **no test of this row passed** |"
    return f"{left} {len({e.test for e in said})} |"


def _days(evidence: Sequence[Evidence]) -> str:
    days = sorted({e.date for e in evidence if e.date})
    return f", of {' to '.join(dict.fromkeys((days[0], days[-1])))}" if days else ""


def _cell(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")
