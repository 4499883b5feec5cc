"""Look-alikes in each other's place: the right one stays or comes back, and a clear lead is not fought for twice."""

from __future__ import annotations

from functools import lru_cache

import pytest

from quadid.diagnose import exchange
from quadid.diagnose.exchange import swap_look_alikes
from quadid.diagnose.models import Model, extend
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with

LAG = 0.03


@lru_cache(maxsize=1)
def late() -> Problem:
    """Rotors that lag, fitted by the nominal model."""
    return fitted(window_with({"motor_lag": {"tau": LAG}}), clean().shooting.noise)


def named(label: str) -> Model:
    problem = late()
    return extend(problem.shooting, problem.nominal, cause(problem, label), iterations=12)


def test_the_wrong_look_alike_is_swapped_for_the_right_one() -> None:
    problem = late()
    model, (comparison,) = swap_look_alikes(problem.shooting, named("command_delay"), problem.listed)
    assert [c.label for c in model.causes] == ["motor_lag"]
    assert comparison.accepted is not None
    assert comparison.accepted.candidate.label == "motor_lag"
    assert comparison.trials[0].candidate.label == "command_delay", "the holder stands first"
    assert float(model.theta[problem.shooting.layout.entry("motor_lag.tau").index]) == pytest.approx(LAG, rel=0.1)


def test_one_far_ahead_is_not_compared_again_and_one_barely_ahead_is(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = late()
    model, first = swap_look_alikes(problem.shooting, named("motor_lag"), problem.listed)
    assert [c.label for c in model.causes] == ["motor_lag"]
    again, second = swap_look_alikes(problem.shooting, model, problem.listed, first)
    assert again is model
    assert second == []
    monkeypatch.setattr(exchange, "FAR_AHEAD", 1e6)
    _, third = swap_look_alikes(problem.shooting, model, problem.listed, first)
    assert len(third) == 1
