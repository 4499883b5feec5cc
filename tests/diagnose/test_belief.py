"""Numbers that no vehicle has are not believed; those that a vehicle may have are."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import pytest

from quadid.diagnose.belief import beyond_belief
from quadid.diagnose.models import Model, extend
from tests.diagnose.hidden import answer, of_class
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with


@lru_cache(maxsize=1)
def dragged() -> tuple[Problem, Model]:
    """A flight with rotor drag and its moment, and the model that says so."""
    hidden = {"rotor_drag": {"k_x": 0.3, "k_y": 0.25}, "rotor_drag_moment": {"h_x": 0.03, "h_y": 0.03}}
    problem = fitted(window_with(hidden), clean().shooting.noise)
    model = extend(problem.shooting, problem.nominal, cause(problem, "rotor_drag"), iterations=12)
    return problem, extend(problem.shooting, model, cause(problem, "rotor_drag_moment"), iterations=12)


def with_number(name: str, value: float) -> list[str]:
    problem, model = dragged()
    theta = model.theta.copy()
    theta[problem.shooting.layout.entry(name).index] = value
    return beyond_belief(problem.shooting, replace(model, theta=theta))


def test_what_a_vehicle_may_have_is_believed() -> None:
    problem, model = dragged()
    assert beyond_belief(problem.shooting, model) == []
    assert with_number("rotor_drag.k_x", -0.001) == []
    assert with_number("rotor_drag_moment.h_x", -0.06) == []


def test_air_that_pushes_is_not_believed() -> None:
    (told,) = with_number("rotor_drag.k_y", -0.09)
    assert told.startswith("rotor_drag.k_y = -0.09 1/s cannot be negative")


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_number_on_its_bound_is_not_believed(sign: float) -> None:
    problem, _ = dragged()
    entry = problem.shooting.layout.entry("rotor_drag_moment.h_x")
    (told,) = with_number(entry.name, sign * entry.upper)
    assert "rests on its bound" in told
    assert with_number("rotor_drag_moment.h_x", 0.9 * sign * entry.upper) == []


def test_lift_that_grows_with_airspeed_is_not_called_drag() -> None:
    """The nearest the catalogue comes to it is air that pushes, or drag a foot below the vehicle."""
    found, _ = answer(of_class("outside", 1029, 120.0))
    assert found.verdict.value == "unknown"
    assert not [f for f in found.findings if f.confident]
    assert any("it stands for something else" in w for w in found.warnings)
