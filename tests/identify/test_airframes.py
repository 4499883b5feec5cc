"""Any arrangement of rotors: each flies a minute in simulation and gives its parameters back."""

import math

import numpy as np
import pytest

from quadid.flight import draw_truth, fly
from quadid.identification.fit import FitOptions, fit
from quadid.parameters import NOMINAL_NAMES, Status
from quadid.vehicle import Rotor, Vehicle
from tests.identify.flights import guessed


def ring(count: int, arm: float, first: float) -> tuple[Rotor, ...]:
    """Rotors evenly on a circle [m], the first at an angle [deg] from forward, spins alternating."""
    angles = np.radians(first + 360.0 / count * np.arange(count))
    return tuple(
        Rotor(position=(arm * math.cos(a), arm * math.sin(a), 0.0), spin=1 if i % 2 else -1)
        for i, a in enumerate(angles)
    )


def from_corners(*corners: tuple[float, float, int]) -> tuple[Rotor, ...]:
    """Rotors from (x, y [m], spin)."""
    return tuple(Rotor(position=(x, y, 0.0), spin=1 if s > 0 else -1) for x, y, s in corners)


PLUS, X, HEXA = (Vehicle.shipped(n) for n in ("pelican", "pelican_x", "hexacopter"))


def like(vehicle: Vehicle, name: str, rotors: tuple[Rotor, ...]) -> Vehicle:
    """A vehicle with other rotors."""
    return vehicle.model_copy(update={"name": name, "rotors": rotors})


AIRFRAMES = {
    "plus": PLUS,
    "x": X,
    "hexa": HEXA,
    "octo": like(HEXA, "octo", ring(8, 0.3, 22.5)),
    "dead cat": like(
        X, "dead_cat", from_corners((0.11, 0.22, 1), (-0.15, 0.13, -1), (-0.15, -0.13, 1), (0.11, -0.22, -1))
    ),
    "long": like(X, "long", from_corners((0.24, 0.12, 1), (-0.24, 0.12, -1), (-0.24, -0.12, 1), (0.24, -0.12, -1))),
}


@pytest.mark.parametrize("name", AIRFRAMES)
def test_an_airframe_gives_its_parameters_back(name: str) -> None:
    vehicle = AIRFRAMES[name]
    truth = draw_truth(vehicle, 5)
    flight = fly(vehicle, truth, 60.0, 5)
    start = guessed(truth, 5).model_copy(update={"name": name, "mass": vehicle.mass, "rotors": vehicle.rotors})
    found = fit([flight.window], start, FitOptions(seed=5))
    for p in found.parameters:
        error = math.log(p.value / truth.as_dict()[p.name])
        assert p.status is Status.IDENTIFIED, p
        assert abs(error) < 3.5 * p.sigma / p.value, p
        assert abs(error) < 0.06, p


def test_rotors_of_unequal_strength_are_told_apart() -> None:
    """One rotor is weaker than the others by 8 per cent; every loss is found beside the six."""
    truth = draw_truth(X, 6)
    flight = fly(X, truth, 60.0, 6, effects={"weak_rotor": {"rotor": 2, "loss": 0.08}})
    names = [*NOMINAL_NAMES, *(f"weak_rotor.loss_{i}" for i in (2, 3, 4))]
    start = guessed(truth, 6).model_copy(update={"rotors": X.rotors, "mass": X.mass})
    found = fit([flight.window], start, FitOptions(iterations=0), names)
    losses = {n: found.parameters[f"weak_rotor.loss_{n}"] for n in (2, 3, 4)}
    assert losses[2].value == pytest.approx(0.08, abs=4.0 * losses[2].sigma)
    for n in (3, 4):
        assert losses[n].value == pytest.approx(0.0, abs=4.0 * losses[n].sigma)
    assert max(p.sigma for p in losses.values()) < 0.02
