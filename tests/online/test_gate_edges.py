"""The gate at its edges: what mutation testing found that no test held (`make mutation`)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quadid.online.gate import GateSettings, decide
from quadid.online.records import OnlineSet, SetState
from quadid.parameters import Parameter, ParameterSet, Status
from tests.online.test_gate import PELICAN, TRUE, good, online_set, parameter_set, scaled

ALL = ("b", "d", "J_xx", "J_yy", "J_zz", "J_r")
LOW, HIGH = PELICAN.parameters["b"].limits


def changed(item: ParameterSet, name: str, **what: Any) -> ParameterSet:
    """The set with one parameter changed."""
    return replace(item, parameters=tuple(replace(p, **what) if p.name == name else p for p in item))


def led_by(item: OnlineSet | ParameterSet, value: float, sigma: float = 0.01) -> Any:
    """The same with the parameter of an effect before all others."""
    parameters = item.parameters if isinstance(item, OnlineSet) else item
    first = Parameter("rotor_drag.k_x", "1/s", value, sigma)
    made = ParameterSet((first, *parameters), np.eye(len(parameters) + 1))
    return replace(item, parameters=made) if isinstance(item, OnlineSet) else made


@pytest.mark.parametrize(
    ("changes", "check", "reason"),
    [
        ({}, "approval", "3 windows agree; better on 2 held-out windows (deviance -110.0)"),
        ({"approval": "manual"}, "approval", "waits for approval: 3 windows agree; better on 2 held-out windows"),
        ({"held_out": (), "in_force": online_set(TRUE, sigma=0.01)}, "approval",
         "3 windows agree; narrower intervals than before"),
        ({"held_out": (-1.0,), "in_force": online_set(TRUE, sigma=0.01)}, "approval",
         "3 windows agree; no better on 1 held-out window (deviance +1.0)"),
        ({"held_out": (7.0,), "in_force": online_set(TRUE)}, "approval", "3 windows agree; better on 1 held-out"),
        ({"excited": False}, "excitation", "the newest window does not reveal roll and pitch"),
        ({"held_out": ()}, "held_out_gain", "no window yet that the estimate has not seen"),
        ({"held_out": (math.nan,)}, "held_out_gain", "the estimate cannot be scored on data it has not seen"),
        ({"held_out": (-100.0,)}, "held_out_gain",
         "predicts unseen data worse than the set in force: deviance 100.0 more in 1 windows"),
        ({"held_out": (1.0,), "in_force": online_set(TRUE)}, "held_out_gain",
         "no improvement over the set in force: it predicts as well with about as narrow intervals"),
        ({"in_force": online_set(scaled(b=2.0))}, "step_limit", "b would change by -50% from the set in force, all"),
        ({"baseline": online_set(scaled(b=2.0))}, "step_limit", "b would change by -50% from the approved baseline"),
        ({"parameters": parameter_set(scaled(b=1.2, J_xx=0.84)), "baseline": online_set(TRUE)}, "reference",
         "torque over inertia (J_xx) is +42.9% off the first accepted or last approved set, allowed 2.5%: rotor"),
    ],
)  # fmt: skip
def test_who_decided_and_why_is_told_in_these_words(changes: dict[str, Any], check: str, reason: str) -> None:
    decision = decide(good(**changes), GateSettings())
    assert decision.check == check
    assert decision.reason.startswith(reason)


@pytest.mark.parametrize(("share", "state"), [(0.70, SetState.PENDING), (0.62, SetState.REJECTED)])
def test_a_person_may_approve_twice_the_step_and_no_more(share: float, state: SetState) -> None:
    """Of everything alike, so that no torque over inertia changes: limit 25 %, twice that for a person."""
    case = good(parameters=parameter_set(scaled(**dict.fromkeys(ALL, share))), in_force=online_set(TRUE))
    assert decide(case, GateSettings()).state is state


@pytest.mark.parametrize("what", [{"sigma": math.nan}, {"sigma": math.inf}, {"value": math.inf}])
def test_one_of_value_and_deviation_that_is_no_number_is_enough(what: dict[str, float]) -> None:
    decision = decide(good(parameters=changed(parameter_set(TRUE), "J_r", **what)), GateSettings())
    assert decision.check == "physical_bounds"
    assert "is not a number" in decision.reason


def test_nothing_that_must_be_positive_is_zero_even_where_the_data_say_nothing() -> None:
    case = good(parameters=changed(parameter_set(TRUE), "d", value=0.0, status=Status.PRIOR_DOMINATED))
    assert "is not positive" in decide(case, GateSettings()).reason


@pytest.mark.parametrize("value", [LOW, HIGH])
def test_a_value_on_either_bound_is_refused(value: float) -> None:
    case = good(parameters=changed(parameter_set(TRUE), "b", value=value))
    assert "rests on its bound" in decide(case, GateSettings()).reason


@pytest.mark.parametrize(("ratio", "passes"), [(0.94, False), (0.96, True), (1.04, True), (1.06, False)])
def test_thrust_that_the_accelerometer_did_not_feel(ratio: float, passes: bool) -> None:
    assert (decide(good(thrust_ratio=ratio), GateSettings()).state is SetState.ACCEPTED) is passes


@pytest.mark.parametrize(
    ("status", "passes"),
    [(Status.IDENTIFIED, False), (Status.RATIO_ONLY, True), (Status.PRIOR_DOMINATED, True)],
)
def test_a_wide_yaw_parameter_is_refused_only_where_it_claims_to_be_known(status: Status, passes: bool) -> None:
    case = good(parameters=changed(parameter_set(TRUE), "d", sigma=0.4 * TRUE["d"], status=status))
    decision = decide(case, GateSettings())
    assert (decision.state is SetState.ACCEPTED) is passes
    assert passes or "yaw more" in decision.reason


@pytest.mark.parametrize(("gains", "news"), [((6.0, 6.0), False), ((6.0, 6.1), True), ((4.0, 3.0, 3.0), False)])
def test_a_gain_counts_by_the_window(gains: tuple[float, ...], news: bool) -> None:
    case = good(in_force=online_set(TRUE), held_out=gains)
    assert (decide(case, GateSettings()).state is SetState.ACCEPTED) is news


@pytest.mark.parametrize(("age", "news"), [(9.9, False), (10.0, True)])
def test_a_sharper_set_waits_for_its_pause(age: float, news: bool) -> None:
    case = good(in_force=online_set(TRUE, sigma=0.01), held_out=(), age=age)
    assert (decide(case, GateSettings()).state is SetState.ACCEPTED) is news


def test_a_parameter_that_is_new_hides_no_step_of_those_after_it() -> None:
    force = online_set(scaled(**dict.fromkeys(ALL, 2.0)))
    decision = decide(good(parameters=led_by(parameter_set(TRUE), 0.3), in_force=force), GateSettings())
    assert decision.reason.startswith("b would change by -50%")


@pytest.mark.parametrize("value", [-0.3, 0.1, 3.0])
def test_an_effect_may_change_as_far_as_it_likes(value: float) -> None:
    """Effects are neutral at 0, where no relative change has a meaning."""
    case = good(parameters=led_by(parameter_set(TRUE), value), in_force=led_by(online_set(TRUE), 0.3))
    assert decide(case, GateSettings()).state is SetState.ACCEPTED


@pytest.mark.parametrize(("factor", "state"), [(1.40, SetState.ACCEPTED), (1.52, SetState.PENDING)])
def test_what_was_known_badly_may_move_by_two_deviations_more(factor: float, state: SetState) -> None:
    case = good(
        parameters=parameter_set(scaled(**dict.fromkeys(ALL, factor))), in_force=online_set(TRUE, sigma=0.1)
    )  # fmt: skip
    assert decide(case, GateSettings()).state is state


def test_what_was_only_guessed_may_be_learned() -> None:
    force = online_set(scaled(d=2.5))
    assert decide(good(in_force=force), GateSettings()).check == "step_limit"
    guessed = replace(force, parameters=changed(force.parameters, "d", status=Status.PRIOR_DOMINATED))
    assert decide(good(in_force=guessed), GateSettings()).state is SetState.ACCEPTED
