"""Where the catalogue does not explain a flight, the extended file is refitted to predict, and says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log

from quadid.diagnose import Diagnosis, diagnose
from quadid.diagnose.extended_vehicle import extended_vehicle
from quadid.diagnose.hypotheses import candidates
from quadid.diagnose.model import Model, fit_model
from quadid.diagnose.prediction import AHEAD, BETTER, Foresight, _relative, refit_to_predict
from quadid.effects import EFFECTS
from quadid.flight import draw_truth, fly
from quadid.grid import to_windows
from quadid.identify.prediction import horizon_scores
from quadid.identify.shooting import Shooting
from quadid.model import layout as ix
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


def refitted(
    data_dir: Path, validation: list[Window], velocity: bool = True
) -> tuple[Foresight, Vehicle, Model]:  # fmt: skip
    """The refit after a diagnosis that found nothing, of one recorded flight with or without its velocity."""
    vehicle = Vehicle.from_yaml((data_dir / "nanodrone" / "vehicle.yaml").read_text(encoding="utf-8"))
    window = recorded(data_dir, "random_run1", vehicle)
    if not velocity:
        window = replace(window, velocity=None, position=None)
    effects = {"motor_lag": {"tau": 0.01}, "rotor_drag": {"k_x": 0.4, "k_y": 0.4}}
    vehicle = vehicle.model_copy(update={"effects": effects})
    shooting = Shooting.cut([window], vehicle, 0.5)
    found = fit_model(shooting, shooting.layout.initial(vehicle), ())
    listed = candidates(shooting.layout, shooting.has_velocity, shooting.channels >= 15)
    listed = [c for c in listed if c.effect not in vehicle.effects]
    foresight = refit_to_predict([window], vehicle, shooting, found, listed, validation)
    assert foresight is not None
    return foresight, vehicle, found


def test_effects_of_the_vehicle_file_are_no_stand_ins_and_stay(data_dir: Path) -> None:
    foresight, vehicle, _ = refitted(data_dir, [])
    assert set(foresight.stand_ins) == {e.name for e in EFFECTS.values() if e.stand_in} - set(vehicle.effects)
    layout = Layout(vehicle)
    written = Vehicle.from_yaml(extended_vehicle(vehicle, layout, foresight.fitted))
    assert written.effects["rotor_drag"] == {"k_x": 0.4, "k_y": 0.4}
    np.testing.assert_allclose(Layout(written).initial(written), foresight.fitted.theta, rtol=1e-12)
    assert {p.sigma for p in written.parameters.values()} == {None}, "its numbers are no physics"


def test_without_velocity_thrust_stays_as_found(data_dir: Path) -> None:
    """Runs of rate and attitude tell thrust only relative to inertia, and no force at all."""
    foresight, _, found = refitted(data_dir, [], velocity=False)
    assert foresight.fitted.theta[ix.B] == found.theta[ix.B]
    assert foresight.fitted.theta[ix.KZ] == 0.0
    assert set(foresight.stand_ins) == {"rate_damping", "cg_offset", "rotor_spin_up"}


def test_a_validation_flight_into_which_no_run_fits_does_not_measure(data_dir: Path) -> None:
    _, vehicle, _ = refitted(data_dir, [])
    short = recorded(data_dir, "random_run3", vehicle).slice(0, 20)
    assert refitted(data_dir, [short])[0].on == "training logs"
    assert refitted(data_dir, [recorded(data_dir, "random_run3", vehicle)])[0].on == "validation logs"


@pytest.mark.parametrize(
    ("after", "before", "expected"),
    [
        ({"rate": 0.5, "velocity": np.nan}, {"rate": 1.0, "velocity": np.nan}, np.log(0.5)),
        ({"rate": 0.5}, {"rate": np.inf}, -np.inf),
        ({"rate": np.inf}, {"rate": np.inf}, np.inf),
        ({"rate": np.inf}, {"rate": 1.0}, np.inf),
    ],
)
def test_a_prediction_that_ran_away_is_worse_than_any(
    after: dict[str, float], before: dict[str, float], expected: float
) -> None:
    assert _relative(after, before) == pytest.approx(expected)
