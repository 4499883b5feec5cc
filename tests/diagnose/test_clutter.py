"""Worth amid clutter: what a cause gains that a vehicle on which everything is a little untidy could not imitate."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from quadid.diagnose.attribution import UNTIDY, clutter_names, ordinary, untidy_names, without_in_clutter
from quadid.diagnose.model import Model, extend
from quadid.parameters import NOMINAL_NAMES
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with


@lru_cache(maxsize=1)
def untidy() -> tuple[Problem, Model]:
    """A weak rotor beside a little of everything, and the model that names it."""
    effects = {
        "weak_rotor": {"rotor": 2.0, "loss": 0.08}, "accel_bias": {"x": 0.02, "y": -0.02, "z": 0.01},
        "cg_offset": {"x": 0.0003, "y": -0.0002}, "gyro_bias": {"x": 0.001, "y": 0.001, "z": -0.001},
    }  # fmt: skip
    problem = fitted(window_with(effects), clean().shooting.noise)
    model = extend(problem.shooting, problem.nominal, cause(problem, "weak_rotor 2"), iterations=12)
    return problem, model


def refitted(label: str | None) -> Model:
    problem, model = untidy()
    gone = None if label is None else cause(problem, label)
    return without_in_clutter(problem.shooting, model, gone, problem.listed)


def test_with_all_causes_clutter_takes_up_what_is_left() -> None:
    _, model = untidy()
    tidied = refitted(None)
    assert tidied.deviance < model.deviance - 50.0
    assert tidied.causes == model.causes


def test_nothing_moves_farther_than_clutter_may() -> None:
    problem, model = untidy()
    for label, base in ((None, model.theta), ("weak_rotor 2", None)):
        theta = refitted(label).theta
        for name in untidy_names(problem.listed):
            entry = problem.shooting.layout.entry(name)
            start = 0.0 if base is None else base[entry.index]
            if base is None and name == "weak_rotor.loss_2":
                assert theta[entry.index] == 0.0
            else:
                assert abs(theta[entry.index] - start) <= UNTIDY * entry.typical * (1.0 + 1e-9), name


def test_a_true_cause_is_worth_far_more_than_clutter_can_imitate() -> None:
    _, model = untidy()
    without, tidied = refitted("weak_rotor 2"), refitted(None)
    assert not without.causes
    assert float(without.held_out.sum() - tidied.held_out.sum()) > 0.05 * model.rows


@pytest.mark.parametrize(
    ("label", "name", "size", "expected"),
    [
        ("weak_rotor 2", "weak_rotor.loss_2", 0.08, False),
        ("weak_rotor 2", "weak_rotor.loss_2", -0.08, False),
        ("weak_rotor 2", "weak_rotor.loss_2", 0.005, True),
        ("cg_offset", "cg_offset.y", -0.0006, True),
        ("cg_offset", "cg_offset.y", -0.002, False),
        ("mass_change", "mass_change.fraction", 0.005, False),
    ],
)
def test_a_cause_is_ordinary_up_to_the_size_of_clutter(label: str, name: str, size: float, expected: bool) -> None:
    problem, model = untidy()
    theta = problem.nominal.theta.copy()
    theta[problem.shooting.layout.entry(name).index] = size
    assert ordinary(problem.shooting, replace(model, theta=theta), cause(problem, label), problem.listed) is expected


def test_changes_at_a_moment_wind_and_ground_are_no_clutter() -> None:
    problem, model = untidy()
    names = clutter_names(model, problem.listed)
    assert set(NOMINAL_NAMES) <= set(names)
    assert len(names) == len(set(names))
    assert not [n for n in names if n.startswith(("mass_change", "thrust_drop", "wind", "ground_effect"))]
    assert np.isfinite(model.theta).all()


def test_what_acts_through_another_effect_may_take_up_too() -> None:
    """The moment of drag has no slope where drag is neutral, as it is in the model; with drag it imitates damping."""
    free = refitted("weak_rotor 2").free.names
    assert {"rotor_drag.k_x", "rotor_drag_moment.h_x", "rotor_drag_moment.h_y"} <= set(free)
