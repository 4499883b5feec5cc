"""The prediction file: the same physics, residual terms where the catalogue leaves something, else none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from quadid_replay import open_log
from typer.testing import CliRunner

from quadid.cli.main import app
from quadid.data.grid import grid_recording
from quadid.diagnosis import diagnose, pipeline
from quadid.diagnosis.candidates import candidates
from quadid.flight import fly
from quadid.identification.residual_prediction import AHEAD, _relative, learn_prediction
from quadid.vehicle import Vehicle

NANODRONE = "nanodrone"
FOUND = ("rotor_drag", "rotor_drag_moment", "accel_bias", "velocity_scale", "parasitic_drag", "translational_lift")
"""What a search of the whole catalogue names in these seconds, in a minute."""
PELICAN = Vehicle.shipped("pelican")


@pytest.fixture(scope="module")
def answer(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    folder, out = data_dir / NANODRONE, tmp_path_factory.mktemp("prediction")
    arguments = ["diagnose", f"{folder / 'random_run1.csv'}@0:20",
                 "--validate", f"{folder / 'random_run2.csv'}@0:10",
                 "--vehicle", str(folder / "vehicle.yaml"), "--out", str(out),
                 "--json", str(out / "r.json")]  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "candidates", lambda *data: [c for c in candidates(*data) if c.effect in FOUND])
        done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    found: dict[str, object] = json.loads((out / "r.json").read_text())
    return found


def test_a_real_flight_gets_a_file_that_predicts_and_one_that_is_physics(answer: dict[str, object]) -> None:
    physical, predicts = (
        Vehicle.from_yaml(Path(str(answer[k])).read_text()) for k in ("vehicle_file", "prediction_file")
    )
    assert physical.residual == ()
    assert predicts.residual
    assert predicts.model_copy(update={"residual": ()}) == physical


def test_it_predicts_a_flight_it_has_not_seen_better_than_the_physics(answer: dict[str, object]) -> None:
    prediction = answer["prediction"]
    assert isinstance(prediction, dict)
    assert prediction["on"] == "validation logs"
    assert prediction["seconds_ahead"] == AHEAD
    assert len(prediction["terms"]) >= 6
    for quantity in ("velocity", "rotation", "rate"):
        assert prediction["predicted"][quantity] < 0.8 * prediction["physical"][quantity]


def test_without_velocity_only_moments_are_learnt(data_dir: Path) -> None:
    vehicle = Vehicle.from_yaml((data_dir / NANODRONE / "vehicle.yaml").read_text())
    windows, _ = grid_recording(open_log(data_dir / NANODRONE / "random_run1.csv"), vehicle, 50.0, [(0.0, 15.0)])
    bare = [replace(w, velocity=None, position=None) for w in windows]
    learnt = learn_prediction(bare, vehicle)
    assert learnt is not None
    assert {t.acts_on[:6] for t in learnt.terms} == {"moment"}
    assert not {s for t in learnt.terms for s in t.product} & {"v_x", "v_y", "v_z", "V"}


def test_without_it_the_diagnosis_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a flight that leaves enough for a prediction, as every flight does here."""
    monkeypatch.setattr(pipeline, "POOR", 0.0)
    learnt = SimpleNamespace(sentence="learnt")
    monkeypatch.setattr(pipeline, "learn_prediction", lambda *data: learnt)
    windows = [fly(PELICAN, seconds=20.0, seed=2, effects={"motor_lag": {"tau": 0.04}}).window]
    (full, _), (bare, _) = (diagnose(windows, PELICAN, predict=p) for p in (True, False))
    assert full.prediction is learnt  # type: ignore[comparison-overlap]
    assert full.warnings == (*bare.warnings, "learnt")
    assert bare.prediction is None
    assert bare.findings
    assert replace(full, prediction=None, warnings=bare.warnings).to_dict() == bare.to_dict()


def test_a_flight_that_is_explained_needs_no_other_file() -> None:
    found, _ = diagnose([fly(PELICAN, seconds=40.0, seed=2, extras=("velocity",)).window], PELICAN)
    assert found.prediction is None
    assert found.to_dict()["prediction"] is None
    assert found.to_dict()["prediction_file"] is None


@pytest.mark.parametrize(
    ("after", "before", "better"),
    [
        ({"rate": 1.0}, {"rate": 2.0}, True),
        ({"rate": np.inf}, {"rate": 2.0}, False),
        ({"rate": 1.0}, {"rate": np.inf}, True),
    ],
)
def test_a_prediction_that_ran_away_is_never_better(
    after: dict[str, float], before: dict[str, float], better: bool
) -> None:
    assert (_relative(after, before) < 0.0) is better
