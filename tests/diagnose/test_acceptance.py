"""Causes that come to nothing are noticed and taken out, others stay."""

from __future__ import annotations

from functools import lru_cache

from quadid.diagnose.acceptance import doubtful, prune
from quadid.diagnose.models import Model, extend
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with


@lru_cache(maxsize=1)
def late() -> tuple[Problem, Model]:
    """A motor lag, and the model that names it and a gyro bias beside it that is not there."""
    problem = fitted(window_with({"motor_lag": {"tau": 0.03}}), clean().shooting.noise)
    model = extend(problem.shooting, problem.nominal, cause(problem, "motor_lag"), iterations=12)
    return problem, extend(problem.shooting, model, cause(problem, "gyro_bias"), iterations=12)


def test_only_what_chance_would_bring_is_doubtful() -> None:
    _, model = late()
    assert [c.effect for c in doubtful(model, 25)] == ["gyro_bias"]


def test_a_suspect_that_gains_nothing_is_dropped_and_nothing_else() -> None:
    problem, model = late()
    kept = prune(problem.shooting, model, doubtful(model, 25), problem.nominal, 25)
    assert [c.effect for c in kept.causes] == ["motor_lag"]
    assert prune(problem.shooting, model, [], problem.nominal, 25) is model
    proven = prune(problem.shooting, model, [cause(problem, "motor_lag")], problem.nominal, 25)
    assert [c.effect for c in proven.causes] == ["motor_lag", "gyro_bias"]
