"""The model that windows are fitted with: what it lacks is fitted along, and the truth is published."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadid.model.layout import Layout
from quadid.model.thrust import ThrustModel
from quadid.online import Session, SessionSettings
from quadid.online.model_vehicle import moved
from quadid.vehicle import GRAVITY, Vehicle
from tests.online.driving import drive, events, flight, published, samples
from tests.online.test_gate import TRUE

PELICAN = Vehicle.shipped("pelican")
LAGGING = (("motor_lag", "tau", 0.05), ("rotor_drag", "k_x", 0.4), ("rotor_drag", "k_y", 0.4))


def test_what_the_model_lacks_is_fitted_along_and_the_truth_is_published() -> None:
    session = Session(PELICAN, SessionSettings(diagnose=0.0))
    actions = drive(session, samples(flight(60.0, 5, effects=LAGGING).recording))
    assert len(events(actions, "model")) == 1
    first, *_ = published(actions)
    assert first.stop - first.start <= 45.0
    for item in published(actions):
        for name in ("b", "J_xx", "J_yy"):
            assert item.parameters[name].value == pytest.approx(TRUE[name], rel=0.03), name


def test_the_secant_of_a_thrust_curve_carries_the_weight() -> None:
    model = PELICAN.model_copy(update={"effects": {"thrust_curve": {"dead_speed": -120.0}}})
    theta = Layout(model).initial(model)
    thrust, weight = ThrustModel(Layout(model), theta), PELICAN.mass * GRAVITY
    hover = math.sqrt(weight / 4.0 / float(theta[0])) - 120.0
    assert thrust.total(np.full((1, 4), hover))[0] == pytest.approx(weight)
    secant = thrust.secant(weight) * float(theta[0])
    assert 4.0 * secant * hover**2 == pytest.approx(weight)
    assert thrust.tangent(secant, weight) == pytest.approx(theta[0])


def test_a_bare_guess_moves_with_its_bounds_and_given_bounds_stay() -> None:
    theta = Layout(PELICAN).initial(PELICAN)
    theta[:6] *= 1.5
    model = moved(PELICAN, theta)
    assert model.parameters["J_xx"].initial == pytest.approx(1.5 * PELICAN.parameters["J_xx"].initial)
    assert model.parameters["J_xx"].limits[1] == pytest.approx(6.0 * PELICAN.parameters["J_xx"].initial)
    assert model.parameters["b"].limits == PELICAN.parameters["b"].limits
