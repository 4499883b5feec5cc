"""Every mistake is answered with one line that names it, and docs/results/mistakes.md shows these lines."""

import re
from pathlib import Path

import pytest

from tests.cli.mistakes import MISTAKES, Mistake, Place, first_line, prepare


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """The flight that the mistakes are made with."""
    return prepare(tmp_path_factory.mktemp("mistakes"))


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda m: m.what)
def test_the_first_line_names_the_mistake(mistake: Mistake, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    code, line = first_line(mistake, place)
    assert code == mistake.code or mistake.vague, line
    assert bool(re.search(mistake.names, line)) or mistake.vague, line
    assert len(line) < 1000


def test_the_page_lists_every_mistake(repository: Path) -> None:
    text = (repository / "docs" / "results" / "mistakes.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| (.+?)(?: \*)? \| `(.+)` \|$", text, re.M))
    assert list(rows) == [m.what for m in MISTAKES]
    for mistake in MISTAKES:
        assert mistake.vague or re.search(mistake.names, rows[mistake.what]), mistake.what
    assert len(MISTAKES) >= 40
