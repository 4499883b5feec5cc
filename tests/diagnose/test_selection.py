"""The moves of the selection: what is superfluous goes, the wrong look-alike gives way, a right answer stays."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from quadid.diagnosis.evidence import Everything, better
from quadid.diagnosis.hypotheses import Model, extend, without
from quadid.diagnosis.search import pruned, select
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with

LAG = 0.03
TESTS = 25.0


@lru_cache(maxsize=1)
def late() -> Problem:
    """Rotors that lag, fitted by the nominal model."""
    return fitted(window_with({"motor_lag": {"tau": LAG}}), clean().shooting.noise)


@lru_cache(maxsize=8)
def named(*labels: str) -> Model:
    problem = late()
    model = problem.nominal
    for label in labels:
        model = extend(problem.shooting, model, cause(problem, label), iterations=12, tried=TESTS)
    return model


def answer(a: Model, b: Model) -> bool:
    return better(b, a)


def selected(known: Model | None) -> Model:
    problem = late()
    return select([problem.shooting], problem.nominal.theta, problem.listed, lambda *_: None, known).model


def test_a_true_cause_is_better_than_none_and_none_than_an_absent_one() -> None:
    assert answer(named(), named("motor_lag"))
    assert not answer(named("motor_lag"), named())
    assert not answer(named("motor_lag"), named("motor_lag", "gyro_bias"))
    assert answer(named("motor_lag", "gyro_bias"), named("motor_lag"))


def test_of_two_look_alikes_the_true_one_is_better() -> None:
    assert answer(named("command_delay"), named("motor_lag"))
    assert not answer(named("motor_lag"), named("command_delay"))


def test_a_cause_is_not_replaced_because_scores_of_the_other_one_vary() -> None:
    """What explains nothing has no claim on what another cause explains, however little its own scores count."""
    lag, nothing = named("motor_lag"), named("rotor_spin_up")
    loud = replace(nothing, tried=dict.fromkeys(nothing.tried, 0.1 * TESTS))
    loud.__dict__["inflation"] = np.where(np.arange(len(loud.free.names)) < len(lag.free.names) - 1, 1.0, 1e9)
    assert not better(loud, lag)
    assert better(lag, loud)


def test_what_gains_in_a_single_block_is_not_relevant() -> None:
    lag = named("motor_lag")
    assert lag.gains_beside(named())
    held_out = named().held_out.copy()
    held_out[1:] = lag.held_out[1:]
    held_out[0] += 1e6
    assert not lag.gains_beside(replace(named(), held_out=held_out, rest=lag.rest))


def test_what_only_one_block_determines_is_not_relevant_whatever_the_others_gain_by_it() -> None:
    """A stretch that is kept apart bends the fit of the others no more; without it there is nothing to gain."""
    lag, rest = named("motor_lag"), named().rest.copy()
    best = int(np.argmax(named().held_out - lag.held_out))
    rest[best] = lag.rest[best]
    assert (named().held_out - lag.held_out).sum() > 0.5 * named().rows
    assert not lag.gains_beside(replace(named(), rest=rest))


def test_what_gains_nothing_is_dropped_and_nothing_else() -> None:
    problem = late()
    kept = pruned(problem.shooting, named("motor_lag", "gyro_bias"))
    assert [c.effect for c in kept.causes] == ["motor_lag"]
    assert pruned(problem.shooting, kept) is kept


@pytest.mark.parametrize("begun", [(), ("command_delay",), ("command_delay", "gyro_bias"), ("motor_lag",)])
def test_the_search_ends_at_the_truth_wherever_it_begins(begun: tuple[str, ...]) -> None:
    model = selected(named(*begun) if begun else None)
    assert [c.label for c in model.causes] == ["motor_lag"]
    tau = float(model.theta[late().shooting.layout.entry("motor_lag.tau").index])
    assert tau == pytest.approx(LAG, rel=0.1)


def test_the_score_test_predicts_what_dropping_a_cause_costs() -> None:
    problem = late()
    model = named("motor_lag", "gyro_bias")
    everything = Everything.of(problem.shooting, model, problem.listed)
    for label in ("motor_lag", "gyro_bias"):
        gone = cause(problem, label)
        refitted = without(problem.shooting, model, gone)
        assert everything.loss(gone) == pytest.approx(refitted.deviance - model.deviance, rel=0.3, abs=3.0)


def test_the_score_test_of_a_swap_prefers_the_look_alike_to_anything_else() -> None:
    problem = late()
    model = named("command_delay")
    everything = Everything.of(problem.shooting, model, problem.listed)
    best = everything.scores(cause(problem, "command_delay"))[0]
    assert best.candidate.label in ("motor_lag", "imu_lag", "attitude_delay")
    assert best.drop > -everything.loss(cause(problem, "command_delay"))
