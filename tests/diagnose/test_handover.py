"""An offset of the accelerometer that is almost a thrust that is not quadratic: what a sensor can have decides."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import pytest

from quadid.diagnose import handover
from quadid.diagnose.handover import LIKELY, hand_over, sensor_errors
from quadid.diagnose.models import Model, extend
from quadid.effects import EFFECTS
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


def test_what_takes_over_comes_in_parts_and_is_no_error_of_a_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every candidate counts as better and as taking over; one that stands for two causes is split."""
    problem, model = blamed("thrust_curve")
    monkeypatch.setattr(handover, "_is_better", lambda trial: True)
    monkeypatch.setattr(handover, "_is_taken_over", lambda *given: True)
    monkeypatch.setattr(handover, "MOST_REFITS", 100)
    lag, delay = cause(problem, "motor_lag"), cause(problem, "command_delay")
    joint = replace(lag, names=(*lag.names, *delay.names), starts=((0.01, 0.01),), label="both", split=(lag, delay))
    monkeypatch.setattr(handover, "exceeded", lambda *given: -1e9)
    tried = hand_over(problem.shooting, model, [joint, *problem.listed], TESTS)
    assert tried is not None
    assert not any(EFFECTS[t.candidate.effect].sized for t in tried.trials)
    (both,) = [t for t in tried.trials if t.candidate.label == "both"]
    assert [c.label for c in both.model.causes] == ["accel_bias", "motor_lag", "command_delay"]
