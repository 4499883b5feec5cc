"""Numbers that no vehicle has are not believed, nor a bias that is not constant; others are."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from quadid.diagnosis.evidence import impossible_causes, late_unknown, slight_causes
from quadid.diagnosis.hypotheses import Model, Start, candidates, extend, free_names, without
from quadid.diagnosis.pipeline import _nominal_parameters, fit_numbers
from quadid.diagnosis.residual_tests import inconstant_causes, remainder
from quadid.identification.fit import NO_FILTER, possible_moments
from quadid.identification.result import with_values
from quadid.parameters import Parameter, Status
from quadid.vehicle import Vehicle
from tests.diagnose.hidden import answer, of_class
from tests.diagnose.problems import Problem, cause, clean, fitted, window_with


@lru_cache(maxsize=1)
def dragged() -> tuple[Problem, Model]:
    """A flight with rotor drag and its moment, and the model that says so."""
    hidden = {"rotor_drag": {"k_x": 0.3, "k_y": 0.25}, "rotor_drag_moment": {"h_x": 0.03, "h_y": 0.03}}
    problem = fitted(window_with(hidden), clean().shooting.noise)
    theta = problem.nominal.theta.copy()
    theta[[problem.shooting.layout.entry(f"rotor_drag.{k}").index for k in ("k_x", "k_y")]] = 0.25
    start = Start(theta, problem.nominal.states)
    model = extend(problem.shooting, problem.nominal, cause(problem, "rotor_drag"), start, iterations=1)
    start = Start(theta, model.states)
    return problem, extend(problem.shooting, model, cause(problem, "rotor_drag_moment"), start, iterations=20)


def doubts(model: Model) -> list[str]:
    return list(impossible_causes(model).values())


def with_number(name: str, value: float) -> list[str]:
    problem, model = dragged()
    theta = model.theta.copy()
    theta[problem.shooting.layout.entry(name).index] = value
    return doubts(replace(model, theta=theta))


def test_what_a_vehicle_may_have_is_believed() -> None:
    assert doubts(dragged()[1]) == []
    assert with_number("rotor_drag.k_x", -0.001) == []
    assert with_number("rotor_drag_moment.h_x", -0.06) == []


def test_a_rotor_stronger_than_the_others_is_no_weak_rotor() -> None:
    """A regression flight of a Crazyflie had one of -21 % beside a thrust coefficient 10 % too small, `identified`."""
    problem = fitted(window_with({"weak_rotor": {"rotor": 2, "loss": 0.05}}), clean().shooting.noise)
    start = Start(problem.nominal.theta, problem.nominal.states)
    model = extend(problem.shooting, problem.nominal, cause(problem, "weak_rotor 2"), start, iterations=10)
    assert doubts(model) == []
    theta = model.theta.copy()
    theta[problem.shooting.layout.entry("weak_rotor.loss_2").index] = -0.2
    (reason,) = doubts(replace(model, theta=theta))
    assert "weak_rotor.loss_2 = -0.2 cannot be negative" in reason


def test_air_that_pushes_is_not_believed() -> None:
    (told,) = with_number("rotor_drag.k_y", -0.09)
    assert told.startswith("rotor_drag.k_y = -0.09 1/s cannot be negative")


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_number_on_its_bound_is_not_believed(sign: float) -> None:
    problem, _ = dragged()
    entry = problem.shooting.layout.entry("rotor_drag_moment.h_x")
    (told,) = with_number(entry.name, sign * entry.upper)
    assert "rests on its bound" in told
    assert with_number("rotor_drag_moment.h_x", 0.9 * sign * entry.upper) == []


def test_lift_that_grows_with_airspeed_is_not_called_drag() -> None:
    """The nearest the catalogue comes to it is air that pushes, or drag a foot below the vehicle."""
    found, _ = answer(of_class("outside", 1029, 120.0))
    assert found.verdict.value == "unknown"
    assert not [f for f in found.findings if f.confident]
    pushing = [p for f in found.findings for p in f.parameters if p.name in ("k_x", "k_y", "k_z") and p.ci95[1] < 0.0]
    assert not pushing or any("it replaces another cause" in w for w in found.warnings)
    assert found.unexplained or found.unexplained_follows, "an unknown must say where it sits"


BIAS = np.array([0.03, -0.02, 0.01])


def with_bias(problem: Problem, effect: str) -> Model:
    """The nominal model extended by a bias."""
    cause = next(c for c in problem.listed if c.effect == effect)
    return extend(problem.shooting, problem.nominal, cause)


def doubts_about(problem: Problem, effect: str) -> dict[str, str]:
    model = with_bias(problem, effect)
    return inconstant_causes(model, remainder(problem.shooting, model).sites)


def test_a_constant_bias_is_believed() -> None:
    n = len(clean().window.t)
    problem = fitted(window_with(None, gyro=np.tile(BIAS, (n, 1))), clean().shooting.noise)
    assert doubts_about(problem, "gyro_bias") == {}


@pytest.mark.parametrize("follows", ["time", "acceleration"])
def test_a_bias_that_changes_is_doubted(follows: str) -> None:
    window = clean().window
    assert window.accel is not None
    change = {
        "time": 1.0 - np.exp(-window.t / 20.0),
        "acceleration": np.roll(window.accel[:, 2], 1) / np.mean(window.accel[:, 2]),
    }[follows]
    problem = fitted(window_with(None, gyro=change[:, None] * BIAS), clean().shooting.noise)
    ((label, sentence),) = doubts_about(problem, "gyro_bias").items()
    assert label == "gyro_bias"
    assert "not constant" in sentence
    assert ("time" in sentence) == (follows == "time")


def test_other_findings_are_not_asked_for_constancy() -> None:
    assert doubts_about(clean(), "rate_damping") == {}


def test_an_extended_file_holds_moments_of_inertia_that_a_body_can_have() -> None:
    """Where the catalogue lacks the cause, J_zz may run away; the file keeps its guess and every command takes it."""
    problem = clean()
    theta = problem.nominal.theta.copy()
    layout, vehicle = problem.shooting.layout, problem.shooting.vehicle
    theta[layout.entry("J_zz").index] *= 8.0
    far = replace(problem.nominal, theta=theta)
    nominal, reasons = _nominal_parameters(problem.shooting, far, [None], {})
    assert reasons == (NO_FILTER,)
    parameters, said = possible_moments(nominal)
    assert said is not None
    assert "J_zz: moved" in said
    written = Vehicle.from_yaml(with_values(vehicle, parameters).to_yaml())
    moved = {p.name: p for p in parameters}["J_zz"]
    assert written.parameters["J_zz"].initial == vehicle.parameters["J_zz"].initial
    assert written.parameters["J_zz"].sigma is None
    assert moved.status is Status.UNRELIABLE


def numbers(problem: Problem, model: Model, *doubted: str) -> tuple[dict[str, Parameter], str]:
    """The nominal six beside a model, some of whose causes are doubtful, and the remarks."""
    fits = [fit_numbers([problem.window], problem.shooting, m) for m in (model, problem.nominal)[: 1 + bool(doubted)]]
    less = {label: without(problem.shooting, model, cause(problem, label)).theta for label in doubted}
    steps = {label: model.free.step(model.theta, theta) for label, theta in less.items()}
    found, reasons = _nominal_parameters(problem.shooting, model, fits, steps)
    return {p.name: p for p in found}, " ".join(reasons)


def test_numbers_beside_a_cause_that_stands_for_something_else_hold_what_they_are_without_it() -> None:
    """Without the moment of the drag the inertias change, and nobody knows what is in its place."""
    problem, model = dragged()
    plain, doubtful = numbers(problem, model)[0], numbers(problem, model, "rotor_drag_moment")[0]
    assert plain["J_xx"].status is plain["b"].status is Status.IDENTIFIED
    less = without(problem.shooting, model, cause(problem, "rotor_drag_moment"))
    for name in ("J_xx", "J_yy", "J_zz"):
        low, high = doubtful[name].ci95
        assert high - low > plain[name].ci95[1] - plain[name].ci95[0]
        assert low < less.theta[problem.shooting.layout.entry(name).index] < high


def test_what_is_late_is_not_known_beside_inertias_that_are_not_to_be_used() -> None:
    problem = fitted(window_with({"motor_lag": {"tau": 0.04}}), clean().shooting.noise)
    model = extend(problem.shooting, problem.nominal, cause(problem, "motor_lag"), iterations=12)
    found = tuple(numbers(problem, model)[0].values())
    assert late_unknown(model, found) == {}
    useless = [replace(p, status=Status.UNRELIABLE) for p in found]
    assert list(late_unknown(model, useless)) == ["motor_lag"]
    one = [replace(p, status=Status.UNRELIABLE) if p.name == "J_xx" else p for p in found]
    assert late_unknown(model, one) == {}


@pytest.mark.parametrize(
    ("name", "value", "believed"),
    [
        ("thrust_drop.fraction", 0.015, False),
        ("thrust_drop.fraction", -0.015, False),
        ("thrust_drop.fraction", 0.05, True),
        ("wind.north", 0.4, False),
        ("wind.east", -2.0, True),
    ],
)
def test_what_any_flight_may_have_is_no_event_and_no_wind(name: str, value: float, believed: bool) -> None:
    problem = clean()
    layout = problem.shooting.layout
    (found,) = (c for c in candidates(layout, True, True) if c.label == name.split(".")[0])
    theta = problem.nominal.theta.copy()
    theta[layout.entry(name).index] = value
    model = replace(problem.nominal, theta=theta, causes=(found,), free=problem.shooting.free(free_names((found,))))
    assert (slight_causes(model) == {}) == believed


def test_without_gyroscopic_coupling_yaw_inertia_is_known_relative_to_the_drag_torque() -> None:
    problem = fitted(window_with({"no_gyroscopic_coupling": {"share": 1.0}}), clean().shooting.noise)
    model = extend(problem.shooting, problem.nominal, cause(problem, "no_gyroscopic_coupling"), iterations=12)
    found, _ = numbers(problem, model)
    assert found["J_zz"].status is not Status.IDENTIFIED
    assert found["J_zz"].relative_to in ("d", None)
    assert found["J_xx"].status is Status.IDENTIFIED
