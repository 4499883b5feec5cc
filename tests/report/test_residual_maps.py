"""The picture of a cause: where the physics says it shows, as large as that says, and flat once it is modelled."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.data.grid import to_windows
from quadid.effects import EFFECTS, NEVER
from quadid.flight import fly
from quadid.model.layout import Layout
from quadid.report.residual_maps import PAIRS, ResidualMap, map_figure, residual_map, switched_off
from quadid.vehicle import Vehicle


@pytest.fixture(scope="module")
def pelican() -> Vehicle:
    """The Pelican with the true parameters, so that nothing but the effect is missing."""
    from quadid.flight import TruthParameters

    vehicle = Vehicle.shipped("pelican")
    truth = TruthParameters.of(vehicle).as_dict()
    parameters = {n: p.model_copy(update={"initial": truth[n]}) for n, p in vehicle.parameters.items()}
    return vehicle.model_copy(update={"parameters": parameters})


def drawn(
    vehicle: Vehicle, effect: str, values: dict[str, float], names: tuple[str, ...],
    extras: tuple[str, ...] = ("velocity", "position"),
) -> ResidualMap:  # fmt: skip
    """The map of an effect that a vehicle flew with, at its true values."""
    flight = fly(vehicle, seconds=40.0, seed=8, effects={effect: values}, extras=extras)
    layout = Layout(vehicle)
    theta = layout.initial(vehicle)
    for name in names:
        entry = layout.entry(name)
        theta[entry.index] = values["loss"] if effect == "weak_rotor" else values[name.split(".")[1]]
    found = residual_map(to_windows(flight.recording, vehicle), vehicle, theta, effect, names)
    assert found is not None
    return found


def slope(found: ResidualMap) -> float:
    """Slope of the mean residual without the cause."""
    return float(np.polyfit(found.x, found.before, 1)[0])


def flat(found: ResidualMap) -> bool:
    """Whether nearly all bins with the cause hold zero in their interval, widened a little."""
    return bool(np.mean(np.abs(found.after) < 1.7 * found.after_error) > 0.85)


def test_a_lag_is_an_error_in_step_with_angular_acceleration(pelican: Vehicle) -> None:
    found = drawn(pelican, "motor_lag", {"tau": 0.04}, ("motor_lag.tau",))
    assert found.channel in ("p", "q", "r")
    assert "acceleration" in found.against
    # Late by tau: measured - simulated = -tau times the rate of change.
    assert slope(found) == pytest.approx(-0.04, rel=0.15)
    assert flat(found)


@pytest.mark.parametrize("extras", [("velocity", "position"), ()])
def test_drag_is_a_force_in_step_with_speed(pelican: Vehicle, extras: tuple[str, ...]) -> None:
    found = drawn(pelican, "rotor_drag", {"k_x": 0.3, "k_y": 0.3}, ("rotor_drag.k_x", "rotor_drag.k_y"), extras)
    assert (found.channel, found.unit, found.against_unit) in {("a_x", "m/s^2", "m/s"), ("a_y", "m/s^2", "m/s")}
    assert slope(found) == pytest.approx(-0.3, rel=0.15)
    assert flat(found)


def test_a_weak_rotor_is_an_angular_acceleration(pelican: Vehicle) -> None:
    found = drawn(pelican, "weak_rotor", {"rotor": 2.0, "loss": 0.03}, ("weak_rotor.loss_2",))
    assert found.channel == "dp/dt"
    hover, arm, inertia = 1.3 * 9.81 / 4.0, 0.21, pelican.parameters["J_xx"].initial
    assert abs(float(np.median(found.before))) == pytest.approx(0.03 * hover * arm / inertia, rel=0.1)
    assert flat(found)


def test_every_effect_has_its_place_and_every_time_is_switched_off(pelican: Vehicle) -> None:
    assert set(PAIRS) == set(EFFECTS)
    assert all(PAIRS.values())
    layout = Layout(pelican)
    theta = layout.initial(pelican)
    theta[layout.entry("mass_change.time").index] = 12.0
    theta[layout.entry("mass_change.fraction").index] = 0.2
    off = switched_off(layout, theta, "mass_change", ("mass_change.fraction",))
    assert off[layout.entry("mass_change.fraction").index] == 0.0
    assert off[layout.entry("mass_change.time").index] == NEVER
    assert theta[layout.entry("mass_change.time").index] == 12.0


def test_figure_names_quantity_unit_and_both_models() -> None:
    one = np.ones(3)
    found = ResidualMap("a_x", "m/s^2", "forward speed", "m/s", one, one, 0 * one, one, one, 5.0)
    figure = map_figure(found, "x", "rotor drag")
    assert [d["name"] for d in figure["views"][0]["data"]] == ["without rotor drag", "with rotor drag"]
    assert figure["views"][0]["layout"]["xaxis"]["title"]["text"] == "forward speed [m/s]"


def test_a_flight_too_short_has_no_map(pelican: Vehicle) -> None:
    windows = to_windows(fly(pelican, seconds=3.0, seed=1).recording, pelican)
    layout = Layout(pelican)
    assert residual_map(windows, pelican, layout.initial(pelican), "motor_lag", ("motor_lag.tau",)) is None


@pytest.mark.parametrize("extras", [(), ("velocity", "position")])
def test_rotor_drag_is_drawn_against_speed_whether_measured_or_not(pelican: Vehicle, extras: tuple[str, ...]) -> None:
    """In a slow drift time tells as much as speed does, and explains nothing."""
    names = ("rotor_drag.k_x", "rotor_drag.k_y")
    found = drawn(pelican, "rotor_drag", {"k_x": 0.3, "k_y": 0.3}, names, extras)
    assert found.against in ("forward speed", "speed to the right")
    assert slope(found) == pytest.approx(-0.3, rel=0.25)
