"""The independent cases: flights from other code, with what was hidden in them."""

from pathlib import Path

import pytest
from quadid_evaluation.studies.campaign import case, row, run

from tests.conftest import absent


def require_right(data_dir: Path, number: int, simulator: str = "cases") -> None:
    """Diagnoses one case and requires verdict and names of its answer sheet."""
    if not (data_dir / simulator).is_dir():
        absent(f"no independent cases at {data_dir / simulator}: set QUADID_DATA to the folder that holds `cases`")
    graded = run(case(f"{simulator} {number}"))
    assert graded.right, row(graded)


# One without effects, one weak rotor, one accelerometer bias.
@pytest.mark.parametrize("number", [1, 12, 17])
def test_a_case_of_other_hands_is_right(data_dir: Path, number: int) -> None:
    require_right(data_dir, number)


@pytest.mark.slow
@pytest.mark.parametrize("number", [n for n in (0, 2, *range(10, 19)) if n not in (12, 17)])
def test_every_other_case_too(data_dir: Path, number: int) -> None:
    require_right(data_dir, number)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(12))
def test_a_case_whose_air_acts_at_each_hub_is_right(data_dir: Path, number: int) -> None:
    require_right(data_dir, number, "cases_hub")
