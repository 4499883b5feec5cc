"""One flight, one error: what `identify` states for it is what `diagnose` starts from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import quadid
from quadid.app.diagnose import Diagnosed
from quadid.app.identify import Identified
from quadid.app.logs import Log


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Log, Log]:
    """Two flights with rotor drag and a weak rotor, as in the tutorial."""
    folder = tmp_path_factory.mktemp("flown")
    hidden = ("rotor_drag:k_x=0.3,k_y=0.3", "weak_rotor:rotor=2,loss=0.04")
    paths = [quadid.simulate(seconds=40, seed=s, effects=hidden).save(folder / f"{s}.mcap") for s in (3, 4)]
    return quadid.load(paths[0], vehicle="pelican"), quadid.load(paths[1], vehicle="pelican")


def test_on_an_unseen_flight(flown: tuple[Log, Log]) -> None:
    train, unseen = flown
    fit, found = quadid.identify(train, validate=unseen), quadid.diagnose(train, validate=unseen)
    assert_alike(fit, found)
    stated = found.result["validation"]
    assert stated["mse_nominal"] > 10.0
    assert stated["mse_extended"] == pytest.approx(1.0, abs=0.1)
    assert stated["deciding"]["seconds"] == found.result["findings"][0]["gain"]["seconds"] != 1.0
    assert f"falls from {stated['mse_nominal']:.3g} to" in found.verdict.details[1]
    assert f"In simulations of {stated['deciding']['seconds']:g} s" in found.verdict.details[2]


def test_no_value_is_identified_where_the_model_is_wrong_about_its_errors_on_another_flight(tmp_path: Path) -> None:
    """Fitted to a flight without a payload that the other one drops: the first model expects no such errors."""
    paths = [
        quadid.simulate(seconds=40, seed=s, effects=e).save(tmp_path / f"{s}.mcap")
        for s, e in ((5, ()), (6, ("mass_change:time=20,fraction=-0.2",)))
    ]
    alone, beside = quadid.identify(paths[0], vehicle="pelican"), quadid.identify(*paths, vehicle="pelican")
    assert {p["status"] for p in alone.result["parameters"]} == {"identified"}
    assert beside.verdict.level == "poor"
    assert beside.verdict.headline.startswith("Not to be used yet")
    assert {p["status"] for p in beside.result["parameters"]} == {"unreliable"}
    assert all(p.sigma is None for p in beside.vehicle.parameters.values())


def test_blocks_left_out_are_called_that_and_lie_near_the_fitted_flight(flown: tuple[Log, Log]) -> None:
    train, _ = flown
    fit, found = quadid.identify(train), quadid.diagnose(train)
    assert_alike(fit, found)
    assert found.result["validation"]["on"] == "held-out blocks"
    assert "held-out blocks of the same flight" in found.verdict.details[1]


def test_on_motion_capture(data_dir: Path) -> None:
    """Noise of two millimetres, and a model that misses slow moments: it is right about its errors, and the same."""
    folder = data_dir / "crazyflie_rpm"
    log = quadid.load(f"{folder / 'figure8_27.csv'}@0:25", vehicle=folder / "vehicle.yaml")
    fit, found = quadid.identify(log), quadid.diagnose(log)
    assert_alike(fit, found)
    assert any("fast motion" in warning for warning in fit.warnings)
    # What the model lacks is no noise: a Crazyflie's gyro is quieter than 0.15 rad/s.
    assert np.all(np.sqrt(fit.fit.noise.variance[:3]) < 0.15)


def assert_alike(fit: Identified, found: Diagnosed) -> None:
    """Every log has one error without the findings, and misses one force and moment, in both results."""
    assert fit.result["missing"]["force"]["nominal"] == found.result["missing"]["force"]["nominal"]
    assert fit.result["missing"]["moment"]["nominal"] == found.result["missing"]["moment"]["nominal"]
    assert all(0.85 < s["mse"]["fitted"] < 1.3 for s in fit.result["sets"])
    assert [s["mse"]["fitted"] for s in fit.result["sets"]] == [s["mse"]["nominal"] for s in found.result["sets"]]
    assert [s["log"] for s in fit.result["sets"]] == [s["log"] for s in found.result["sets"]]
