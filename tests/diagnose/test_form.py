"""A bias that is not constant is not named with confidence; one that is, is."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.diagnose.candidates import Candidate
from quadid.diagnose.form import inconstant
from quadid.diagnose.models import Model, extend
from quadid.diagnose.remainder import remainder
from tests.diagnose.problems import Problem, clean, fitted, window_with

BIAS = np.array([0.03, -0.02, 0.01])


def with_bias(problem: Problem, effect: str) -> Model:
    """The nominal model extended by a bias, with its worth."""
    cause = next(c for c in problem.listed if c.effect == effect)
    model = extend(problem.shooting, problem.nominal, cause)
    model.worth[cause.label] = problem.nominal.deviance - model.deviance
    return model


def doubts(problem: Problem, effect: str) -> list[tuple[Candidate, str]]:
    model = with_bias(problem, effect)
    return list(inconstant(model, remainder(problem.shooting, model)))


def test_a_constant_bias_is_believed() -> None:
    n = len(clean().window.t)
    problem = fitted(window_with(None, gyro=np.tile(BIAS, (n, 1))), clean().shooting.noise)
    assert doubts(problem, "gyro_bias") == []


@pytest.mark.parametrize("follows", ["time", "acceleration"])
def test_a_bias_that_changes_is_doubted(follows: str) -> None:
    window = clean().window
    assert window.accel is not None
    change = {
        "time": 1.0 - np.exp(-window.t / 20.0),
        "acceleration": np.roll(window.accel[:, 2], 1) / np.mean(window.accel[:, 2]),
    }[follows]
    problem = fitted(window_with(None, gyro=change[:, None] * BIAS), clean().shooting.noise)
    ((cause, sentence),) = doubts(problem, "gyro_bias")
    assert cause.effect == "gyro_bias"
    assert "not constant" in sentence
    assert ("time" in sentence) == (follows == "time")


def test_other_findings_are_not_asked_for_constancy() -> None:
    problem = clean()
    model = with_bias(problem, "rate_damping")
    assert list(inconstant(model, remainder(problem.shooting, model))) == []
