"""The gate: what it accepts is physical, known, agreed upon, predictive and near what was approved."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadid.checks.motion import Factor
from quadid.chi_square import Z95
from quadid.online.fusion import with_tangent
from quadid.online.gate import CHECKS, JUDGED, Case, GateSettings, decide
from quadid.online.records import OnlineSet, SetState
from quadid.parameters import NOMINAL_NAMES, NOMINAL_UNITS, Parameter, ParameterSet, Status, impossible_inertia
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened

PELICAN = Vehicle.shipped("pelican")
ACCEPTED = SetState.ACCEPTED
TRUE = dict(zip(NOMINAL_NAMES, (2.33e-5, 4.96e-7, 0.010, 0.0136, 0.0226, 5e-5), strict=True))


def parameter_set(values: dict[str, float], sigma: float = 0.005, **status: Status) -> ParameterSet:
    parameters = tuple(
        Parameter(
            name,
            NOMINAL_UNITS[name],
            values[name],
            abs(values[name]) * sigma,
            bounds=PELICAN.parameters[name].limits,
            status=status.get(name, Status.IDENTIFIED),
        )
        for name in NOMINAL_NAMES
    )
    return ParameterSet(parameters, np.diag(np.square([p.sigma for p in parameters])))


def known_b(sigma: float) -> ParameterSet:
    """A vehicle file whose b is 25 % high and has a standard deviation."""
    b = Parameter("b", NOMINAL_UNITS["b"], 1.25 * TRUE["b"], sigma)
    return ParameterSet((b,), np.array([[sigma**2]]))


def online_set(values: dict[str, float], state: SetState = SetState.ACCEPTED, sigma: float = 0.005) -> OnlineSet:
    return OnlineSet(1, state, "", parameter_set(values, sigma), 0.0, 30.0, 1500, mass=PELICAN.mass)


def good(**changes: Any) -> Case:
    case = Case(parameter_set(TRUE), True, 1.0, 3, "", (50.0, 60.0), None, None, "auto")
    return replace(case, **changes)


def test_rotors_too_light_to_be_seen_hold_nothing_back() -> None:
    low, high = PELICAN.parameters["J_r"].limits
    light, heavy = (parameter_set({**TRUE, "J_r": bound}, J_r=Status.UNRELIABLE) for bound in (low, high))
    assert decide(good(parameters=light), GateSettings()).state is SetState.ACCEPTED
    assert decide(good(parameters=heavy), GateSettings()).check == "physical_bounds"


def test_it_says_where_faster_logs_are_missing_and_no_longer_flight() -> None:
    wide = good(parameters=parameter_set(TRUE, sigma=0.04), between_rows={"J_xx": 0.2})
    assert "faster" not in decide(wide, GateSettings()).reason, "b is asked for first, and the rows tell it"
    narrow = {name: 0.04 if name == "J_xx" else 0.005 for name in TRUE}
    some = parameter_set(TRUE)
    some = ParameterSet(tuple(replace(p, sigma=abs(p.value) * narrow[p.name]) for p in some), some.covariance)
    assert "log motors faster" in decide(good(parameters=some, between_rows={"J_xx": 0.2}), GateSettings()).reason
    assert "faster" not in decide(good(parameters=some, between_rows={"J_xx": 0.01}), GateSettings()).reason


def scaled(**factors: float) -> dict[str, float]:
    return {name: value * factors.get(name, 1.0) for name, value in TRUE.items()}


@pytest.mark.parametrize(
    ("changes", "check", "word"),
    [
        ({"parameters": parameter_set(scaled(b=-1.0))}, "physical_bounds", "not positive"),
        ({"parameters": parameter_set(scaled(J_zz=1.8))}, "physical_bounds", "triangle"),
        ({"parameters": parameter_set(scaled(b=math.nan))}, "physical_bounds", "not a number"),
        ({"parameters": parameter_set({**TRUE, "b": PELICAN.parameters["b"].limits[1]})}, "physical_bounds", "bound"),
        ({"thrust_ratio": 2.0}, "physical_bounds", "accelerometer"),
        ({"parameters": parameter_set(TRUE, sigma=0.04)}, "interval_width", "keep flying"),
        ({"parameters": parameter_set(TRUE, J_xx=Status.PRIOR_DOMINATED)}, "interval_width", "J_xx"),
        ({"agreeing": 2}, "agreement", "2 of 3"),
        ({"disagreement": "J_xx differs"}, "agreement", "J_xx differs"),
    ],
)
def test_each_check_objects_with_its_reason(changes: dict[str, Any], check: str, word: str) -> None:
    decision = decide(good(**changes), GateSettings())
    assert decision.check == check
    assert word in decision.reason
    assert decision.state is not SetState.ACCEPTED


@pytest.mark.parametrize("factors", [{"J_xx": 4.0, "J_yy": 4.0, "J_zz": 4.0}, {"b": 2.0}, {"b": -1.0}, {"J_xx": 0.25}])
def test_a_set_that_would_destabilise_a_controller_is_refused(factors: dict[str, float]) -> None:
    case = good(parameters=parameter_set(scaled(**factors)), in_force=online_set(TRUE), baseline=online_set(TRUE))
    assert decide(case, GateSettings()).state is SetState.REJECTED


def crept(names: tuple[str, ...]) -> float:
    """Factor at which steps of 2 % of these parameters are no longer accepted by themselves."""
    baseline = force = online_set(TRUE)
    factor = 1.0
    for _ in range(40):
        factor *= 1.02
        moved = scaled(**dict.fromkeys(names, factor))
        case = good(parameters=parameter_set(moved), in_force=force, baseline=baseline)
        if decide(case, GateSettings()).state is not SetState.ACCEPTED:
            break
        force = online_set(moved)
    return factor


def test_small_steps_do_not_creep_past_the_baseline(happened: Happened) -> None:
    assert 1.3 < crept(("d", "J_zz", "J_r")) < 1.0 + GateSettings().creep + 0.05
    factor = crept(NOMINAL_NAMES)
    assert 1.04 < factor < 1.0 + GateSettings().width + 0.03, "roll and pitch inertia no further than sensors may err"
    happened(17, f"all parameters in steps of 2 %: stopped at {factor - 1.0:+.0%} of the approved baseline")


@pytest.mark.parametrize("name", ["b", "J_xx", "J_yy"])
def test_torque_over_inertia_creeps_no_further_than_sensors_may_err(name: str, happened: Happened) -> None:
    factor = crept((name,))
    assert 1.04 < factor < 1.09
    happened(17, f"{name} in steps of 2 %: stopped at {factor - 1.0:+.0%} of the approved baseline")


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"baseline": online_set(scaled(b=1.25))}, "first accepted or last approved set"),
        ({"stated": known_b(1e-7)}, "the vehicle file"),
    ],
)
def test_rotor_speeds_that_may_be_wrong_wait_for_a_person(changes: dict[str, Any], word: str) -> None:
    decision = decide(good(**changes), GateSettings())
    assert (decision.state, decision.check) == (SetState.PENDING, "reference")
    assert word in decision.reason
    assert "-20.0%" in decision.reason
    assert "a person must approve it" in decision.reason


def test_a_guess_of_the_vehicle_file_and_a_wide_deviation_are_no_reference() -> None:
    assert decide(good(stated=known_b(0.2 * TRUE["b"])), GateSettings()).state is SetState.ACCEPTED


@pytest.mark.parametrize(
    ("factors", "known_together", "passes"),
    [
        ({"b": 1.06}, True, False),
        ({"b": 1.06, "J_xx": 1.06, "J_yy": 1.06}, True, False),
        ({"b": 1.01, "J_xx": 1.01, "J_yy": 1.01}, True, True),
        ({"b": 1.06, "J_xx": 1.06, "J_yy": 1.06}, False, True),
    ],
)
def test_what_the_reference_left_open_buys_no_room(
    factors: dict[str, float], known_together: bool, passes: bool
) -> None:
    """A set is compared with what the flight before told; a wide interval of its own, that is another thing."""
    narrow = online_set(TRUE, sigma=0.001)
    wide = replace(narrow, parameters=narrow.parameters.scaled_together(0.09), reference_sd=0.09 * known_together)
    decision = decide(good(parameters=parameter_set(scaled(**factors)), baseline=wide, in_force=wide), GateSettings())
    assert decision.check == ("approval" if passes else "reference")


def test_an_interval_from_nothing_to_infinity_stays_one() -> None:
    """Of an estimate known to a thousand times its value: an unexpected error, after which learning restarted."""
    narrow = parameter_set(TRUE, sigma=0.001)
    vague = [replace(p, ci95=(0.0, math.inf)) for p in narrow.parameters]
    wide = ParameterSet(tuple(vague), np.array(narrow.covariance)).scaled_together(0.09)
    assert {p.ci95 for p in wide.parameters} == {(0.0, math.inf)}


def test_a_file_whose_values_have_a_factor_in_common_tells_torque_over_inertia() -> None:
    """As a set without a reference is exported: each value to 8 %, b over J to 0.1 %."""
    stated = parameter_set(TRUE, sigma=0.001).scaled_together(0.08)
    assert decide(good(stated=stated, parameters=parameter_set(scaled(b=1.06))), GateSettings()).check == "reference"
    both = parameter_set(scaled(b=1.06, J_xx=1.06, J_yy=1.06))
    assert decide(good(stated=stated, parameters=both), GateSettings()).state is ACCEPTED


def test_an_estimate_buys_no_room_by_a_wide_deviation_of_its_own() -> None:
    wide = parameter_set(scaled(b=1.05), sigma=0.012)
    narrow, vague = (online_set(TRUE, sigma=sigma) for sigma in (0.001, 0.012))
    decision = decide(good(parameters=wide, baseline=narrow, in_force=narrow), GateSettings())
    assert (decision.state, decision.check) == (SetState.PENDING, "reference")
    assert decide(good(parameters=wide, baseline=vague, in_force=vague), GateSettings()).state is SetState.ACCEPTED


def test_mass_leaves_torque_over_inertia_as_it_is_and_is_asked_for() -> None:
    lighter = online_set(scaled(**dict.fromkeys(NOMINAL_NAMES, 1.2)))
    decision = decide(good(baseline=lighter, in_force=lighter), GateSettings())
    assert (decision.state, decision.check) == (SetState.PENDING, "reference")
    assert "J_xx is -16.7% off" in decision.reason


def test_windows_whose_torque_over_inertia_walks_do_not_agree() -> None:
    decision = decide(good(walked={"J_xx": (0.08, 0.01)}), GateSettings())
    assert (decision.state, decision.check) == (SetState.REJECTED, "agreement")
    assert "+8.3%" in decision.reason
    assert decide(good(walked={"J_xx": (0.08, 0.03)}), GateSettings()).state is SetState.ACCEPTED


def test_sensors_that_are_not_compared_yet_are_waited_for() -> None:
    decision = decide(good(doubts=(Factor("roll turn", 1.0, 0.1),)), GateSettings())
    assert (decision.state, decision.check) == (SetState.REJECTED, "sensors")


def test_what_sensors_may_be_off_by_together_is_bounded() -> None:
    """Each within its own limit, b and the inertias were published 7 % off."""
    assert decide(good(doubts=(Factor("accelerometer times turn", 1.02, 0.01),)), GateSettings()).state is ACCEPTED
    decision = decide(good(doubts=(Factor("accelerometer times turn", 1.07, 0.01),)), GateSettings())
    assert (decision.state, decision.check) == (SetState.PENDING, "sensors")
    assert "off by it" in decision.reason


@pytest.mark.parametrize(
    ("values", "word"),
    [((0.12, 0.12, 0.12, 0.12), "support"), ((-0.09, 0.03, 0.03, 0.03), "rotor 1"), ((0.05, -0.05) * 2, "rotor")],
)
def test_what_the_six_leave_out_of_the_thrust_waits_for_a_person(values: tuple[float, ...], word: str) -> None:
    decision = decide(good(left_out=off_by(values)), GateSettings())
    assert (decision.state, decision.check) == (SetState.PENDING, "thrust")
    assert word in decision.reason
    assert decide(good(left_out=off_by([0.01] * 4, 0.01)), GateSettings()).state is ACCEPTED
    vague = decide(good(left_out=off_by([0.01] * 4, 0.03)), GateSettings())
    assert (vague.state, vague.check) == (SetState.REJECTED, "sensors")


@pytest.mark.parametrize(
    ("values", "at_rest", "state"),
    [
        ((-0.28,) * 4, (0.004, 0.005), SetState.ACCEPTED),  # the rotors' own curve, which the set states
        ((-0.28,) * 4, (0.12, 0.005), SetState.PENDING),  # something carries an eighth of the weight
        ((-0.28,) * 4, (0.0, 1.0), SetState.PENDING),  # which of both is not known
        ((-0.40, -0.24, -0.24, -0.24), (0.004, 0.005), SetState.PENDING),  # a rotor of its own
        ((0.01,) * 4, (0.0, 1.0), SetState.ACCEPTED),
    ],
)
def test_a_curve_of_all_rotors_is_published_where_nothing_is_carried_at_rest(
    values: tuple[float, ...], at_rest: tuple[float, float], state: SetState
) -> None:
    left_out = off_by(values, at_rest=at_rest)
    curved = with_tangent(parameter_set(TRUE), float(np.mean(values)), 0.005)
    assert curved["b_tangent"].value == pytest.approx(TRUE["b"] * math.exp(np.mean(values)))
    assert decide(good(parameters=curved, left_out=left_out), GateSettings()).state is state
    if abs(np.mean(values)) > 0.1:
        assert decide(good(left_out=left_out), GateSettings()).check == "thrust", "a set that states no curve"


def test_torque_over_inertia_goes_with_the_slope_of_thrust() -> None:
    """A curve that a later set states and its reference did not know: torque and inertia are as they were."""
    curved = with_tangent(
        parameter_set({**TRUE, "b": TRUE["b"] * 1.04, "J_xx": TRUE["J_xx"] * 1.04, "J_yy": TRUE["J_yy"] * 1.04}),
        -math.log(1.04),
        0.005,
    )
    assert [curved[n].value for n in ("b_tangent", "J_xx")] == pytest.approx([TRUE["b"], TRUE["J_xx"]])
    left_out = off_by([-math.log(1.04)] * 4, at_rest=(0.0, 0.005))
    before = online_set(TRUE, sigma=0.001)
    case = good(parameters=curved, left_out=left_out, in_force=before, baseline=before, held_out=(50.0,))
    assert decide(case, GateSettings()).state is ACCEPTED, decide(case, GateSettings()).reason
    faster = good(
        parameters=with_tangent(parameter_set(TRUE), -math.log(1.04), 0.005),
        left_out=left_out,
        baseline=before,
        in_force=before,
        held_out=(50.0,),
    )
    assert decide(faster, GateSettings()).state is ACCEPTED, "b, and torque over inertia, are as they were"


def off_by(values: Sequence[float], sigma: float = 0.005, at_rest: tuple[float, float] = (0.0, 1.0)) -> FloatArray:
    return np.array([[*values, at_rest[0]], [*([sigma] * len(values)), at_rest[1]]])


def test_what_sensors_and_thrust_are_off_by_is_added_up() -> None:
    sensors, thrust = (Factor("accelerometer times turn", 1.03, 0.005),), off_by([-0.03] * 4, 0.004)
    assert decide(good(doubts=sensors), GateSettings()).state is ACCEPTED
    assert decide(good(left_out=thrust), GateSettings()).state is ACCEPTED
    for sign in (1.0, -1.0):  # one may hide the other: no sign makes them cancel
        both = good(doubts=sensors, left_out=thrust * [[sign], [1.0]])
        decision = decide(both, GateSettings())
        assert (decision.state, decision.check) == (SetState.PENDING, "sensors")
        assert "thrust" in decision.reason


def test_a_set_that_rests_on_another_mass_waits_for_a_person() -> None:
    decision = decide(good(loaded="the mass changed by +20 %"), GateSettings())
    assert (decision.state, decision.check) == (SetState.PENDING, "mass")


def test_a_stale_set_is_confirmed_without_news() -> None:
    case = good(in_force=online_set(TRUE, SetState.STALE), baseline=online_set(TRUE), held_out=(0.5,))
    assert decide(case, GateSettings()).state is SetState.ACCEPTED


numbers = st.floats(-1e6, 1e6) | st.sampled_from([math.nan, math.inf, -math.inf])


@given(
    factors=st.lists(st.floats(0.05, 8.0) | numbers, min_size=6, max_size=6),
    sigma=st.floats(0.0, 0.2),
    statuses=st.lists(st.sampled_from(list(Status)), min_size=6, max_size=6),
    excited=st.booleans(),
    ratio=st.floats(0.5, 2.0) | numbers,
    agreeing=st.integers(0, 6),
    held_out=st.lists(st.floats(-50.0, 100.0) | numbers, max_size=4),
    force=st.none() | st.lists(st.floats(0.7, 1.4), min_size=6, max_size=6),
    unproven=st.booleans(),
    approval=st.sampled_from(["auto", "manual"]),
)
def test_nothing_is_accepted_that_breaks_a_promise(
    factors: list[float],
    sigma: float,
    statuses: list[Status],
    excited: bool,
    ratio: float,
    agreeing: int,
    held_out: list[float],
    force: list[float] | None,
    unproven: bool,
    approval: str,
) -> None:
    values = {n: TRUE[n] * f for n, f in zip(NOMINAL_NAMES, factors, strict=True)}
    named = dict(zip(NOMINAL_NAMES, statuses, strict=True))
    before = None if force is None else online_set({n: TRUE[n] * f for n, f in zip(NOMINAL_NAMES, force, strict=True)})
    settings = GateSettings()
    case = Case(
        parameter_set(values, sigma, **named),
        excited,
        ratio,
        agreeing,
        "",
        tuple(held_out),
        before,
        before,
        approval,
        doubts=(Factor("roll turn", 1.0, 0.2),) if unproven else (),
    )
    decision = decide(case, settings)
    assert decision.reason
    assert decision.check in {name for name, _ in CHECKS + JUDGED} | {"approval"}
    if decision.state is SetState.REJECTED:
        return
    assert not unproven
    assert excited
    assert agreeing >= settings.windows
    assert all(math.isfinite(v) and v > 0.0 for v in values.values())
    assert impossible_inertia([values[n] for n in ("J_xx", "J_yy", "J_zz")], settings.inertia_slack) is None
    assert all(Z95 * sigma <= settings.width for n in ("b", "J_xx", "J_yy") if named[n] is not Status.PRIOR_DOMINATED)
    assert sum(held_out) >= -settings.gain * len(held_out)
    if decision.state is SetState.ACCEPTED:
        assert approval == "auto"
        if before is not None:
            for name in ("b", "J_xx", "J_yy"):
                change = abs(math.log(values[name] / before.parameters[name].value))
                assert change <= math.log1p(settings.step + 0.02)


# --- At its edges: what mutation testing found that no test held (`make mutation`)


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
    assert (decision.state is SetState.ACCEPTED) is (check == "approval" and "approval" not in changes)


@pytest.mark.parametrize(("share", "state"), [(0.70, SetState.PENDING), (0.62, SetState.REJECTED)])
def test_a_person_may_approve_twice_the_step_and_no_more(share: float, state: SetState) -> None:
    """Of everything alike, so that no torque over inertia changes: limit 25 %, twice that for a person."""
    case = good(parameters=parameter_set(scaled(**dict.fromkeys(NOMINAL_NAMES, share))), in_force=online_set(TRUE))
    decision = decide(case, GateSettings())
    assert (decision.state, decision.check) == (state, "step_limit")
    assert ("a person must approve it" in decision.reason) is (state is SetState.PENDING)


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


@pytest.mark.parametrize(("gains", "news"), [((6.0, 6.0), False), ((6.0, 6.1), True), ((4.0, 3.0, 3.0), False)])
def test_a_gain_counts_by_the_window(gains: tuple[float, ...], news: bool) -> None:
    case = good(in_force=online_set(TRUE), held_out=gains)
    assert (decide(case, GateSettings()).state is SetState.ACCEPTED) is news


@pytest.mark.parametrize(("age", "news"), [(9.9, False), (10.0, True)])
def test_a_sharper_set_waits_for_its_pause(age: float, news: bool) -> None:
    case = good(in_force=online_set(TRUE, sigma=0.01), held_out=(), age=age)
    assert (decide(case, GateSettings()).state is SetState.ACCEPTED) is news


def test_a_parameter_that_is_new_hides_no_step_of_those_after_it() -> None:
    force = online_set(scaled(**dict.fromkeys(NOMINAL_NAMES, 2.0)))
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
        parameters=parameter_set(scaled(**dict.fromkeys(NOMINAL_NAMES, factor))), in_force=online_set(TRUE, sigma=0.1)
    )
    assert decide(case, GateSettings()).state is state


def test_what_was_only_guessed_may_be_learned() -> None:
    force = online_set(scaled(d=2.5))
    assert decide(good(in_force=force), GateSettings()).check == "step_limit"
    guessed = replace(force, parameters=changed(force.parameters, "d", status=Status.PRIOR_DOMINATED))
    assert decide(good(in_force=guessed), GateSettings()).state is SetState.ACCEPTED
