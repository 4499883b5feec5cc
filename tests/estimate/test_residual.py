"""Terms beyond the catalogue: found on what is missing where something acts, none where nothing does; they fly."""

from functools import lru_cache

import numpy as np
import pytest

from quadid.data.window import Window
from quadid.estimate.missing import Missing, Vehicles, removed
from quadid.estimate.residual import candidate_products, learn
from quadid.flight import Flight, fly
from quadid.model.closed_loop import ClosedLoop
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import SIGNALS, ParameterPrior, ResidualTerm, Vehicle

PELICAN = Vehicle.shipped("pelican")
DAMPING = {"rate_damping": {"l_p": 3.0, "m_q": 3.0}}


@lru_cache
def flown(seed: int, damped: bool) -> Flight:
    truth = fly(PELICAN, seconds=1.0, seed=3).truth.parameters
    effects = DAMPING if damped else {}
    return fly(PELICAN, truth, 30.0, seed, effects=effects, extras=("velocity",))


def true_vehicle(flight: Flight) -> Vehicle:
    """The vehicle with the parameters that were flown, without effects."""
    truth = flight.truth.parameters.as_dict()
    return PELICAN.model_copy(update={"parameters": {n: ParameterPrior(initial=truth[n]) for n in NOMINAL_NAMES}})


def seen(vehicle: Vehicle, *windows: Window) -> list[list[Missing]]:
    theta = Layout(vehicle).initial(vehicle)
    flights = Vehicles([windows[0]], vehicle, theta)
    return [flights.missing([w], theta) for w in windows]


@lru_cache
def learnt() -> tuple[Vehicle, tuple[ResidualTerm, ...], list[list[Missing]]]:
    one, other = flown(3, True), flown(4, True)
    vehicle = true_vehicle(one)
    before = seen(vehicle, one.window, other.window)
    return vehicle, learn(before[0], before[1:]), before


def test_what_acts_is_learnt_and_is_missing_no_more_on_another_flight() -> None:
    vehicle, terms, before = learnt()
    by_axis = {t.acts_on: t for t in terms}
    for axis, signal, J in (("moment_x", "p", "J_xx"), ("moment_y", "q", "J_yy")):
        assert by_axis[axis].product == (signal,), by_axis[axis].formula
        assert by_axis[axis].value == pytest.approx(-3.0 * vehicle.parameters[J].initial, rel=0.1)
    wiser = vehicle.model_copy(update={"residual": terms})
    after = seen(wiser, flown(3, True).window, flown(4, True).window)
    assert removed(before[1], after[1]) > 0.9


def test_nothing_is_learnt_from_flights_that_the_physics_explain() -> None:
    one, other = flown(5, False), flown(6, False)
    parts = seen(true_vehicle(one), one.window, other.window)
    assert learn(parts[0], parts[1:]) == ()
    assert learn(parts[0]) == ()


def test_what_acts_on_one_flight_only_is_not_kept() -> None:
    vehicle = true_vehicle(flown(3, True))
    damped, other = seen(vehicle, flown(3, True).window), seen(vehicle, flown(6, False).window)
    assert learn(damped[0])
    assert learn(damped[0], other) == ()


def test_no_term_is_made_of_the_rotors_own_thrust_or_torque() -> None:
    for velocity in (True, False):
        products = candidate_products(velocity)
        assert len(set(products)) == len(products)
        assert all(set(p) <= set(SIGNALS) - {"T"} for p in products)
        assert all(set(p) - {"W"} for p in products), "the rotors' speed alone is thrust by another name"
    assert not any(SIGNALS[s] == "m/s" for p in candidate_products(False) for s in p)


def test_a_flight_too_short_to_be_judged_by_teaches_nothing() -> None:
    _, _, before = learnt()
    assert learn([before[0][0].rows(0, 150)]) == ()


def test_a_file_with_terms_flies_in_closed_loop() -> None:
    """Under its stabiliser, from references alone, it flies what was flown, and better than without the terms."""
    vehicle, terms, _ = learnt()
    flight, errors = flown(4, True), []
    measured = flight.window.gyro
    assert measured is not None
    for file in (vehicle, vehicle.model_copy(update={"residual": terms})):
        loop = ClosedLoop(flight.window, file, flight.gains)
        rates = loop.fly(Layout(file).initial(file)[None]).rates[0]
        assert np.isfinite(rates).all()
        errors.append(float(np.sqrt(np.nanmean((rates - measured)[:, :2] ** 2))))
    assert errors[1] < 0.7 * errors[0], errors
    assert errors[1] < 0.1 * float(np.std(measured[:, :2])), errors
