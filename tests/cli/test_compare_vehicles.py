"""`quadid compare-vehicles`: the file nearer to the truth predicts better, and a file equals itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quadid
from quadid.errors import LogError, ParameterError
from quadid.flight import TruthParameters
from quadid.vehicle import ParameterPrior, Vehicle
from tests.cli.conftest import Flights

PELICAN = Vehicle.shipped("pelican")


def near(factor: float = 1.0, **more: Any) -> Vehicle:
    """A Pelican with the truth's parameters but for a factor on the roll and pitch inertia."""
    values = {
        n: ParameterPrior(initial=v * (factor if n in ("J_xx", "J_yy") else 1.0), sigma=0.01 * v)
        for n, v in TruthParameters.of(PELICAN).as_dict().items()
    }
    return PELICAN.model_copy(update={"parameters": values, **more})


def test_the_truer_file_predicts_better_from_both_sides(flights: Flights) -> None:
    found = quadid.compare_vehicles(PELICAN, near(), flights.unseen).result
    assert found["better"] == "b"
    assert found["ci95"][0] < found["ratio"] < found["ci95"][1] < 0.9
    rate = found["horizons"]["50"]["rate"]
    assert rate["b"] < rate["a"]
    assert rate["ci95"][0] < rate["ratio"] < rate["ci95"][1]
    turned = quadid.compare_vehicles(near(), PELICAN, flights.unseen).result
    assert turned["better"] == "a"
    assert turned["ratio"] == pytest.approx(1.0 / found["ratio"])
    scored = quadid.score(str(flights.unseen), vehicle=PELICAN).result
    for quantity, value in scored["horizons"]["10"].items():
        assert found["horizons"]["10"][quantity]["a"] == pytest.approx(value, rel=1e-9)


def test_a_file_equals_itself_and_a_small_difference_is_small(flights: Flights) -> None:
    same = quadid.compare_vehicles(near(), near(), flights.unseen).result
    assert same["better"] == "neither"
    assert same["ratio"] == pytest.approx(1.0)
    assert {p["name"]: p["apart"] for p in same["parameters"]}["J_xx"] == 0.0
    apart = quadid.compare_vehicles(near(), near(1.03), flights.unseen).result
    assert {p["name"]: p["apart"] for p in apart["parameters"]}["J_xx"] == pytest.approx(0.03 / 0.01 / 2**0.5)


def test_the_interval_covers_what_other_flights_show(flights: Flights) -> None:
    """Halves of a flight: the ratio on one lies within a few widths of the interval of the other."""
    one, two = (
        quadid.compare_vehicles(PELICAN, near(1.05), f"{flights.unseen}@{span}").result for span in ("0:15", "15:30")
    )
    middle, width = np.log(one["ratio"]), 0.5 * np.log(one["ci95"][1] / one["ci95"][0])
    assert 0.0 < width < 0.5
    assert abs(np.log(two["ratio"]) - middle) < 3.0 * width


def test_effects_stand_side_by_side(flights: Flights) -> None:
    lagged = near(effects={"motor_lag": {"tau": 0.001}})
    made = quadid.compare_vehicles(near(1.2), lagged, str(flights.unseen))
    assert made.result["effects"] == [{"effect": "motor_lag", "name": "tau", "a": None, "b": 0.001}]
    assert "predicts better than" in made.text()
    frame = made.to_frame()
    assert len(frame) == 12
    assert frame.loc["rate.10", "low"] <= frame.loc["rate.10", "ratio"] <= frame.loc["rate.10", "high"]
    assert "Effects side by side" in made.page()


def test_what_cannot_be_compared_is_refused(flights: Flights) -> None:
    with pytest.raises(LogError, match="at least one flight"):
        quadid.compare_vehicles(PELICAN, near(), [])
    with pytest.raises(ParameterError, match="horizons"):
        quadid.compare_vehicles(PELICAN, near(), flights.unseen, horizons=(0,))
    with pytest.raises(LogError, match="at least 8 for an interval"):
        quadid.compare_vehicles(PELICAN, near(), f"{flights.unseen}@0:4")
