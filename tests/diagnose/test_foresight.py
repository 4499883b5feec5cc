"""Where the catalogue does not explain a flight, the extended file is refitted to predict, and says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log

from quadid.diagnose import Diagnosis, diagnose
from quadid.diagnose.foresight import AHEAD, BETTER
from quadid.flight import draw_truth, fly
from quadid.grid import to_windows
from quadid.identify.horizon import horizon_scores
from quadid.model.layout import Layout
from quadid.vehicle import Vehicle
from quadid.window import Window
from tests.identify.flights import PELICAN, guessed

SEED = 7
SECONDS = 15.0


def recorded(folder: Path, name: str, vehicle: Vehicle) -> Window:
    """The first seconds of a recorded flight whose states were filtered and shifted, which no cause says."""
    (window,) = to_windows(open_log(folder / "nanodrone" / f"{name}.csv"), vehicle)
    return window.slice(0, round(SECONDS / window.dt))


@pytest.fixture(scope="module")
def unexplained(data_dir: Path) -> tuple[Diagnosis, Window]:
    """The diagnosis of two flights, and a third one."""
    vehicle = Vehicle.from_yaml((data_dir / "nanodrone" / "vehicle.yaml").read_text(encoding="utf-8"))
    train = [recorded(data_dir, name, vehicle) for name in ("random_run1", "chirp_run1")]
    other = recorded(data_dir, "random_run3", vehicle)
    return diagnose(train, vehicle, [other])[0], other


def error(yaml: str, window: Window) -> dict[str, float]:
    """Error of a vehicle file `AHEAD` seconds on, by quantity."""
    vehicle = Vehicle.from_yaml(yaml)
    steps = round(AHEAD / window.dt)
    return horizon_scores([[window]], vehicle, Layout(vehicle).initial(vehicle), (steps,))[0].at(steps)


def still(window: Window) -> float:
    """Error [rad/s] of the rate after `AHEAD` when no change is predicted."""
    assert window.gyro is not None
    steps = round(AHEAD / window.dt)
    return float(np.mean(np.linalg.norm(window.gyro[steps:] - window.gyro[:-steps], axis=1)))


def test_the_file_of_an_unknown_flight_predicts_better_and_says_what_it_is(
    unexplained: tuple[Diagnosis, Window],
) -> None:
    found, unseen = unexplained
    assert found.verdict.value == "unknown"
    assert found.foresight is not None
    assert any("no physics" in w for w in found.warnings)
    assert found.to_dict()["prediction"]["on"] == "validation logs"
    before, after = found.foresight.diagnosed, found.foresight.refitted
    # Selected on the training flights, measured on the other: the mean over the quantities holds there too.
    assert np.mean([np.log(after[q] / before[q]) for q in before]) < np.log(BETTER)
    assert after["rate"] < still(unseen)


def test_the_file_holds_what_was_measured(unexplained: tuple[Diagnosis, Window]) -> None:
    found, unseen = unexplained
    assert found.foresight is not None
    measured = error(found.vehicle_yaml, unseen)
    for quantity, value in found.foresight.refitted.items():
        assert measured[quantity] == pytest.approx(value, rel=0.02)


def test_an_explained_flight_keeps_its_most_likely_parameters() -> None:
    truth = draw_truth(PELICAN, SEED)
    window = fly(PELICAN, truth, 40.0, 3, effects={"motor_lag": {"tau": 0.03}}).window
    found, _ = diagnose([window], guessed(truth, SEED))
    assert found.verdict.value == "explained"
    assert found.foresight is None
    assert found.to_dict()["prediction"] is None
