"""Numbers beside their truth on the page of vehicles of others."""

from __future__ import annotations

from typing import Any

import pytest
from quadid_evaluation.studies.flight_sets import SETS
from quadid_evaluation.studies.foreign import of_set, outside_table

IRIS = SETS["iris"]


def answered(b: float, status: str, *effects: str) -> dict[str, Any]:
    """An answer with b known to 5 % and these findings."""
    number = {"name": "b", "value": b, "ci95": [0.95 * b, 1.05 * b], "status": status}
    return {"parameters": [number], "findings": [{"effect": e} for e in effects]}


def test_b_beside_a_thrust_curve_has_a_truth_of_its_own() -> None:
    """Rotors at pwm - 900 rad/s, in a file that has 1.1 (pwm - 1000): less 110 rad/s, of speeds 1.1 times as large."""
    low, high = IRIS.beside_curve["b"]
    assert low < high == pytest.approx(5.84e-6 / 1.21)
    (curved,) = of_set("iris", IRIS, {"diagnose": answered(4.8e-6, "identified", "thrust_curve")})
    (plain,) = of_set("iris", IRIS, {"diagnose": answered(4.8e-6, "identified")})
    assert curved.inside
    assert not plain.inside


def test_the_share_counts_identified_numbers_and_names_those_outside() -> None:
    answers = {"identify": answered(6.1e-6, "identified"), "diagnose": answered(9.0e-6, "identified")}
    unused = of_set("iris", IRIS, {"diagnose": answered(9.0e-6, "unreliable")})
    text = outside_table([*of_set("iris", IRIS, answers), *unused])
    assert "Of 2 identified values with known truth, 1 have it inside" in text
    assert text.count("**+") == 1


def test_refused_data_have_no_numbers() -> None:
    assert list(of_set("iris", IRIS, {"identify": None, "diagnose": None})) == []
    assert outside_table([]) == ""
