"""An offset of the accelerometer that is almost a thrust that is not quadratic: what a sensor can have decides."""

from __future__ import annotations

from functools import lru_cache

import pytest

from quadid.diagnose import handover
from quadid.diagnose.handover import LIKELY, hand_over, sensor_errors
from quadid.diagnose.models import Model, extend
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with

DEAD_SPEED = 26.0
TESTS = 25


@lru_cache(maxsize=2)
def blamed(effect: str) -> tuple[Problem, Model]:
    """A flight with one of the two hidden, and the model that blames the accelerometer for it."""
    hidden = {
        "thrust_curve": {"thrust_curve": {"dead_speed": DEAD_SPEED}},
        "accel_bias": {"accel_bias": {"x": 0.0, "y": 0.0, "z": 0.6}},
    }[effect]
    problem = fitted(window_with(hidden), clean().shooting.noise)
    return problem, extend(problem.shooting, problem.nominal, cause(problem, "accel_bias"), iterations=12)


def test_an_offset_no_sensor_has_is_handed_to_the_thrust_curve() -> None:
    problem, model = blamed("thrust_curve")
    assert [e.name for e in sensor_errors(problem.shooting, model, LIKELY)] == ["accel_bias.z"]
    tried = hand_over(problem.shooting, model, problem.listed, TESTS)
    assert tried is not None
    assert tried.accepted is not None
    assert tried.accepted.candidate.effect == "thrust_curve"
    found = tried.accepted.model
    at = problem.shooting.layout.entry
    assert float(found.theta[at("thrust_curve.dead_speed").index]) == pytest.approx(DEAD_SPEED, rel=0.4)
    before, after = (abs(float(m.theta[at("accel_bias.z").index])) for m in (model, found))
    assert after < 0.5 * before
    assert found.worth["thrust_curve"] == tried.accepted.gain.total > 0.0


def test_a_true_offset_of_that_size_stays_with_the_sensor() -> None:
    problem, model = blamed("accel_bias")
    assert sensor_errors(problem.shooting, model, LIKELY)
    tried = hand_over(problem.shooting, model, problem.listed, TESTS)
    assert tried is not None
    assert tried.accepted is None


def test_likely_errors_are_believed_without_another_look(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, model = blamed("accel_bias")
    monkeypatch.setattr(handover, "LIKELY", 100.0)
    monkeypatch.setattr(handover, "screen", lambda *given: pytest.fail("looked"))
    assert hand_over(problem.shooting, model, problem.listed, TESTS) is None
