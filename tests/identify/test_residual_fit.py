"""Terms learnt from what the physics leaves: found where something acts, none where nothing does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadid.errors import NotIdentifiableError
from quadid.flight import Flight, fly
from quadid.identification.open_loop import mean_errors
from quadid.identification.residual_fit import candidate_terms, fit_residual
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import ParameterPrior, Vehicle
from tests.identify.flights import PELICAN


def true_vehicle(flight: Flight) -> Vehicle:
    """The vehicle with the parameters that were flown, without effects."""
    truth = flight.truth.parameters.as_dict()
    return PELICAN.model_copy(update={"parameters": {n: ParameterPrior(initial=truth[n]) for n in NOMINAL_NAMES}})


@pytest.fixture(scope="module")
def damped() -> tuple[Flight, Flight]:
    effects = {"rate_damping": {"l_p": 3.0, "m_q": 3.0}}
    extras = ("velocity", "position")
    first = fly(PELICAN, seconds=40.0, seed=3, effects=effects, extras=extras)
    return first, fly(PELICAN, seconds=30.0, seed=4, effects=effects, extras=extras, truth=first.truth.parameters)


def test_what_acts_is_learnt_and_predicts_a_flight_it_has_not_seen(damped: tuple[Flight, Flight]) -> None:
    seen, unseen = damped
    physics = true_vehicle(seen)
    learnt = fit_residual([seen.window], physics)
    moments = {t.product: t.value for t in learnt.terms if t.acts_on == "moment_x"}
    assert moments[("p",)] == pytest.approx(-3.0 * physics.parameters["J_xx"].initial, rel=0.25)
    assert learnt.terms[0].product in (("p",), ("q",))
    wiser = physics.model_copy(update={"residual": learnt.terms})
    errors = [mean_errors([unseen.window], v, Layout(v).initial(v), 25) for v in (physics, wiser)]
    assert errors[1]["rate"] < 0.5 * errors[0]["rate"]
    assert errors[1]["rotation"] < 0.5 * errors[0]["rotation"]


def test_nothing_is_learnt_from_a_flight_that_the_physics_explain() -> None:
    flight = fly(PELICAN, seconds=40.0, seed=5, extras=("velocity", "position"))
    learnt = fit_residual([flight.window], true_vehicle(flight))
    assert learnt.terms == ()
    assert min(learnt.unseen.values()) > 0.9 * learnt.unseen[0]


def test_physics_stay_as_they_are_and_every_candidate_has_a_formula(damped: tuple[Flight, Flight]) -> None:
    formulas = {t.formula for t in candidate_terms()}
    assert len(formulas) == len(candidate_terms())
    wide = true_vehicle(damped[0]).model_copy(update={"residual": candidate_terms()})
    np.testing.assert_array_equal(Layout(wide).initial(wide)[:6], wide.initial)


def test_runs_of_a_vehicle_whose_rotors_follow_the_battery_know_its_voltage(damped: tuple[Flight, Flight]) -> None:
    window = damped[0].window.slice(0, 400)
    sagging = replace(window, battery=np.linspace(12.6, 11.0, len(window))[:, None])
    known = true_vehicle(damped[0]).model_copy(update={"reference_voltage": 12.0})
    follows = known.model_copy(update={"effects": {"supply_voltage": {"exponent": 1.0}}})
    errors = [mean_errors([sagging], v, Layout(v).initial(v), 25)["velocity"] for v in (known, follows)]
    assert errors[1] > 1.05 * errors[0]  # these rotors did not follow it
    assert np.isfinite(errors[1])


def test_from_a_flight_too_short_to_judge_by_nothing_is_learnt(damped: tuple[Flight, Flight]) -> None:
    assert fit_residual([damped[0].window.slice(0, 240)], PELICAN).terms == ()


def test_flights_without_one_run_of_half_a_second_are_refused(damped: tuple[Flight, Flight]) -> None:
    first, other = (replace(flight.window.slice(0, 12), name=name) for flight, name in zip(damped, "ab", strict=True))
    with pytest.raises(NotIdentifiableError, match="run"):
        fit_residual([first, other], PELICAN)
