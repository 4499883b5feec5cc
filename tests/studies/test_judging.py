"""One mistake at a time on right logs of several vehicles: each is named by the first line, or nothing is said."""

from pathlib import Path

import pytest
from quadid_evaluation.studies.judging import cells

SILENT = {"arms 1.35 times", "mass 1.3 times", "arms and mass 1.5 times"}
"""What a vehicle file of guesses does not reveal."""


@pytest.mark.parametrize("vehicle", ["pelican", "pelican_x", "hexacopter", "x8", "crazyflie"])
def test_each_mistake_is_named_first(vehicle: str) -> None:
    answers = {
        mistake: (verdict, line) for mistake, verdict, line in cells(vehicle, Path(), every=vehicle == "pelican_x")
    }
    assert len(answers) >= 45
    assert {name: line for name, (verdict, line) in answers.items() if verdict == "WRONG"} == {}
    assert {name for name, (verdict, _) in answers.items() if verdict == "silent"} <= SILENT


@pytest.mark.parametrize("vehicle", ["crazyflie_rpm", "nanodrone", "mujoco hexa"])
def test_no_recorded_flight_is_answered_with_another_mistake(vehicle: str, data_dir: Path) -> None:
    wrong = {mistake: line for mistake, verdict, line in cells(vehicle, data_dir) if verdict == "WRONG"}
    assert wrong == {}
