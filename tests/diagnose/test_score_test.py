"""Screening: what one linearisation promises is what a refit delivers."""

from dataclasses import replace

import numpy as np
import pytest

from quadid.diagnosis.evidence import Everything, Score
from quadid.diagnosis.hypotheses import Model, Start, extend, fit_model
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with

SMALL = {
    "accel_bias": {"x": 0.05, "y": -0.03, "z": 0.02},
    "cg_offset": {"x": 0.0003, "y": -0.0002},
    "imu_lever_arm": {"x": 0.01, "y": -0.02, "z": 0.01},
    "rate_damping": {"l_p": 0.1, "m_q": 0.15},
}
"""Sizes at which the model is linear in the effect."""


def screen(problem: Problem, model: Model | None = None) -> list[Score]:
    return Everything.of(problem.shooting, model or problem.nominal, problem.listed).scores()


def score_of(problem: Problem, label: str, model: Model | None = None) -> Score:
    scores = screen(problem, model)
    (found,) = [s for s in scores if s.candidate.label == label]
    return found


@pytest.mark.parametrize("name", SMALL)
def test_the_predicted_drop_is_that_of_a_refit(name: str) -> None:
    problem = fitted(window_with({name: SMALL[name]}), clean().shooting.noise)
    score = score_of(problem, name)
    start = Start(problem.nominal.theta, problem.nominal.states)
    refit = extend(problem.shooting, problem.nominal, cause(problem, name), start, iterations=12)
    drop = problem.nominal.deviance - refit.deviance
    assert drop > 30.0
    assert score.drop == pytest.approx(drop, rel=0.05)
    scores = screen(problem)
    assert max(scores, key=lambda s: s.drop / len(s.candidate.names)).drop <= 1.2 * score.drop + 10.0


def test_without_effects_no_drop_is_beyond_chance() -> None:
    """Chi-square tails of the score tests: smallest of about 25 not below 1e-4, and none promises half a per cent."""
    problem = clean()
    scores = screen(problem)
    assert len(scores) >= 20
    assert max(s.drop for s in scores) < 0.004 * problem.nominal.rows


def test_the_scan_finds_when_thrust_dropped() -> None:
    problem = fitted(window_with({"thrust_drop": {"time": 37.3, "fraction": 0.02}}), clean().shooting.noise)
    score = score_of(problem, "thrust_drop")
    assert score.time == pytest.approx(37.3, abs=1.5)
    assert score.trials == len(problem.nominal.lin.time) * len(problem.listed)


def test_the_scan_is_that_of_masked_columns() -> None:
    """Sums from the end against the score test of a model whose step sits at the found time."""
    problem = fitted(window_with({"thrust_drop": {"time": 30.0, "fraction": 0.02}}), clean().shooting.noise)
    score = score_of(problem, "thrust_drop")
    assert score.time is not None
    theta = problem.nominal.theta.copy()
    timed = score.candidate.timed
    assert timed is not None
    theta[timed] = score.time
    moved = extend(
        problem.shooting, problem.nominal, score.candidate, Start(theta, problem.nominal.states), iterations=8
    )
    assert score.drop == pytest.approx(problem.nominal.deviance - moved.deviance, rel=0.1)


def test_what_is_in_the_model_or_lacks_its_companion_is_not_tried() -> None:
    problem = clean()
    labels = {s.candidate.label for s in screen(problem)}
    assert "rotor_drag_moment" not in labels
    assert "rotor_drag" in labels
    drag = extend(problem.shooting, problem.nominal, cause(problem, "rotor_drag"), iterations=3)
    labels = {s.candidate.label for s in screen(problem, drag)}
    assert "rotor_drag" not in labels
    assert "rotor_drag_moment" in labels


def test_a_direction_the_nominal_parameters_explain_promises_nothing() -> None:
    """A thrust drop before the log begins is a smaller b: nothing is left to gain."""
    problem = clean()
    whole = replace(cause(problem, "thrust_drop"), timed=None)
    (score,) = Everything.of(problem.shooting, problem.nominal, [whole]).scores()
    assert score.drop < 5.0
    assert np.isfinite(score.drop)


def test_a_fit_that_stopped_short_promises_no_more_than_there_is_to_gain() -> None:
    """Deviance is a sum of squares: no move brings it below zero, wherever the model stands."""
    problem = clean()
    short = fit_model(problem.shooting, problem.shooting.layout.initial(problem.shooting.vehicle), (), iterations=1)
    assert short.deviance > 2.0 * problem.nominal.deviance, "the fit has ended after all"
    scores = screen(problem, short)
    assert max(s.drop for s in scores) < short.deviance
