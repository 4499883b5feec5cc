"""The independent cases: flights from other code, with what was hidden in them."""

import json
from pathlib import Path
from typing import Any

import pytest
from quadid_evaluation.studies.cases import row

from tests.conftest import absent

QUICK = ("case_001", "case_012", "case_017")
"""One without effects, one weak rotor, one accelerometer bias."""


def require_right(data_dir: Path, case: str, simulator: str = "cases") -> None:
    """Diagnoses one case and requires verdict and names of its answer sheet."""
    folder = data_dir / simulator
    if not folder.is_dir():
        absent(f"no independent cases at {folder}: set QUADID_DATA to the folder that holds `cases`")
    sheet: list[dict[str, Any]] = json.loads((folder / "answers.json").read_text(encoding="utf-8"))
    (answer,) = [a for a in sheet if a["case"] == case]
    right, line = row(folder / case, answer)
    assert right, line


@pytest.mark.parametrize("case", QUICK)
def test_a_case_of_other_hands_is_right(data_dir: Path, case: str) -> None:
    require_right(data_dir, case)


@pytest.mark.slow
@pytest.mark.parametrize("case", [f"case_{n:03d}" for n in (0, 2, *range(10, 19)) if n not in (12, 17)])
def test_every_other_case_too(data_dir: Path, case: str) -> None:
    require_right(data_dir, case)


@pytest.mark.slow
@pytest.mark.parametrize("case", [f"case_{n:03d}" for n in range(12)])
def test_a_case_whose_air_acts_at_each_hub_is_right(data_dir: Path, case: str) -> None:
    require_right(data_dir, case, "cases_hub")
