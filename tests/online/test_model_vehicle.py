"""The model that windows are fitted with: what a diagnosis finds in flight is taken in, and only then published."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadid.model.layout import Layout
from quadid.online import Session, SessionSettings
from quadid.online.model_vehicle import ThrustModel, extended, secant_share
from quadid.online.outbox import Action
from quadid.vehicle import GRAVITY, Vehicle
from tests.online.driving import drive, events, flight, published, samples
from tests.online.test_gate import TRUE

PELICAN = Vehicle.shipped("pelican")
LAGGING = (("motor_lag", "tau", 0.05), ("rotor_drag", "k_x", 0.4), ("rotor_drag", "k_y", 0.4))


def played(seconds: float) -> list[Action]:
    """A flight of a vehicle with motor lag and drag that its file does not know; diagnoses answered at once."""
    session = Session(PELICAN, SessionSettings())
    return drive(session, samples(flight(seconds, 5, effects=LAGGING).recording))


def test_what_the_model_lacks_is_learned_in_flight_and_then_the_truth_is_published() -> None:
    actions = played(60.0)
    (model, *_) = events(actions, "model")
    assert "motor_lag" in model.text
    assert "rotor_drag" in model.text
    first, *_ = published(actions)
    assert first.stop <= 60.0
    for item in published(actions):
        for name in ("b", "J_xx", "J_yy"):
            assert item.parameters[name].value == pytest.approx(TRUE[name], rel=0.03), name
    refused = [s for s in published(actions, "candidate") if s.check == "model"]
    assert refused, "until the cause is known nothing is published"
    assert "diagnosis" in refused[0].reason


def test_the_secant_of_a_thrust_curve_carries_the_weight() -> None:
    model = PELICAN.model_copy(update={"effects": {"thrust_curve": {"dead_speed": -120.0}}})
    layout = Layout(model)
    theta = layout.initial(model)
    share = secant_share(PELICAN, model, layout, theta)
    hover = math.sqrt(PELICAN.mass * GRAVITY / 4.0 / float(theta[0])) - 120.0
    assert share * theta[0] * 4.0 * hover**2 == pytest.approx(PELICAN.mass * GRAVITY)
    assert ThrustModel(layout, theta).total(np.full((1, 4), hover))[0] == pytest.approx(PELICAN.mass * GRAVITY)
    assert secant_share(model, model, layout, theta) == 1.0, "a vehicle file with the curve has b of that curve"


def test_a_bare_guess_moves_with_its_bounds_and_given_bounds_stay() -> None:
    found = PELICAN.model_copy(
        update={
            "parameters": {n: p.model_copy(update={"initial": p.initial * 1.5}) for n, p in PELICAN.parameters.items()},
            "effects": {"rotor_drag": {"k_x": 0.3, "k_y": 0.3}, "gyro_scale": {"x": 0.2}, "mass_change": {"time": 3.0}},
        }
    )
    model = extended(PELICAN, found)
    assert model.parameters["J_xx"].initial == pytest.approx(1.5 * PELICAN.parameters["J_xx"].initial)
    assert model.parameters["J_xx"].limits[1] == pytest.approx(6.0 * PELICAN.parameters["J_xx"].initial)
    assert model.parameters["b"].limits == PELICAN.parameters["b"].limits
    assert set(model.effects) == {"rotor_drag"}, "neither a sensor's scale nor a change in time is the vehicle's"
