"""Segments that decide: the longest that the model follows, and long ones only where airspeed must be found."""

from functools import lru_cache

import pytest

from quadid.diagnosis.hypotheses import extend
from quadid.diagnosis.search import CLEAN_MISFIT, LINEAR_MISFIT, USUAL_SECONDS, Stage
from quadid.identification.problem import Shooting
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with

SECONDS = (4.0, 2.0, 1.0, 0.5, 0.2)


def schedule(problem: Problem) -> list[Shooting]:
    whole = problem.shooting
    return [Shooting.cut([problem.window], whole.vehicle, t, whole.noise, whole.layout) for t in SECONDS]


@lru_cache(maxsize=1)
def late() -> Problem:
    """Rotors that lag so much that no nominal model follows a second of flight."""
    return fitted(window_with({"motor_lag": {"tau": 0.06}}), clean().shooting.noise)


def begun(problem: Problem) -> Stage:
    return Stage.begin(schedule(problem), problem.nominal.theta)


def test_a_model_that_follows_decides_on_segments_of_usual_length() -> None:
    stage = begun(clean())
    assert stage.shooting.seconds == USUAL_SECONDS
    assert stage.model.lin.reduced_chi_square < CLEAN_MISFIT
    assert stage.continued() is stage, "there is nowhere to go"


def test_one_that_does_not_begins_on_shorter_ones_and_the_true_cause_leads_back() -> None:
    stage = begun(late())
    assert stage.shooting.seconds < USUAL_SECONDS
    assert not stage.at(2).follows, "the flight is too easy for this test"
    named = extend(stage.shooting, stage.model, cause(late(), "motor_lag"), iterations=12)
    again = Stage(stage.schedule, stage.rung, named).continued()
    assert again.shooting.seconds == USUAL_SECONDS
    assert again.model.lin.reduced_chi_square < LINEAR_MISFIT
    assert [c.label for c in again.model.causes] == ["motor_lag"]


def test_where_airspeed_must_be_found_the_longest_segments_that_are_followed_decide() -> None:
    """No velocity is measured here, and drag makes it matter."""
    problem = fitted(window_with({"rotor_drag": {"k_x": 0.3, "k_y": 0.25}}), clean().shooting.noise)
    stage = begun(problem)
    named = extend(stage.shooting, stage.model, cause(problem, "rotor_drag"), iterations=12)
    assert named.finds_velocity
    longest = Stage(stage.schedule, stage.rung, named).continued()
    assert longest.shooting.seconds == SECONDS[0]
    assert longest.model.lin.reduced_chi_square < CLEAN_MISFIT


@pytest.mark.parametrize(("problem", "there"), [(clean, True), (late, False)])
def test_the_longest_of_all_are_looked_at_only_where_hardly_more_than_noise_is_left(
    problem: object, there: bool
) -> None:
    stage = begun(problem())  # type: ignore[operator]
    far = stage.longest()
    assert (far is not None) is there
    if far is not None:
        assert far.shooting.seconds == SECONDS[0]
        assert far.longest() is None
