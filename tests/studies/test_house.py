"""Size of the house: what is recorded holds, and no room escapes the count."""

import ast
import json
import tomllib
from pathlib import Path

from quadid_evaluation.studies import house


def test_no_figure_is_above_the_recorded_one() -> None:
    recorded = json.loads(house.RECORDED.read_text(encoding="utf-8"))
    assert len(recorded["reason"].split()) > 3
    assert house.risen(house.count(), recorded) == []


def test_every_package_of_the_wheel_is_counted(repository: Path) -> None:
    build = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    wheel = set(build["targets"]["wheel"]["packages"])
    counted = {**house.PRODUCT, **house.EVALUATION}.values()
    assert {folder for folder in wheel if not any(folder == c or c.startswith(f"{folder}/") for c in counted)} == set()
    for folder in (*counted, *house.TESTS.values()):
        assert any((repository / folder).rglob("*.py")), folder


def test_a_line_or_a_number_more_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "quadid" / "model"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text("LIMIT = 3.0\n_PAUSES: tuple[float, ...] = (1.0, 2.0)\nNAME = 'x'\nON = True\n")
    before = house.count(tmp_path)
    assert before["lines"]["product"] == 4
    assert before["numbers"]["product"] == 2
    assert house.risen(before, before) == []
    (folder / "b.py").write_text("MORE = 1e-3\n")
    assert house.risen(house.count(tmp_path), before) == [
        "lines of product: 5, recorded 4",
        "numbers of product: 3, recorded 2",
    ]


def test_numbers_are_names_in_capitals_that_stand_for_numbers() -> None:
    text = "A, B = 1, 2\nC = (1.0, A)\nD = f(2)\nc = 3\nE: int = 1 << 20\nF = -1.0\n"
    assert house.named_numbers(ast.parse(text)) == ["A", "B", "C", "E", "F"]
