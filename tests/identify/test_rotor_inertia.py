"""Rotors without inertia, as many simulators have them: a guess of J_r does not bend what is beside it."""

from dataclasses import replace

from quadid.flight import TruthParameters, fly
from quadid.identification.fit import FitOptions, fit
from quadid.parameters import Status
from quadid.vehicle import ParameterPrior, Vehicle


def test_rotors_without_inertia_leave_yaw_and_roll_right() -> None:
    pelican = Vehicle.shipped("pelican")
    truth = replace(TruthParameters.of(pelican), J_r=1e-9)
    flight = fly(pelican, truth, 60.0, seed=5)
    guessed = {**pelican.parameters, "J_r": ParameterPrior(initial=1e-3)}
    found = fit([flight.window], pelican.model_copy(update={"parameters": guessed}), FitOptions(seed=1)).parameters
    for name in ("d", "J_xx", "J_yy", "J_zz"):
        error = found[name].value / truth.as_dict()[name] - 1.0
        assert abs(error) < 0.01, name
        assert abs(error) < 3.0 * found[name].sigma / found[name].value, name
    assert found["J_r"].value < 1e-5
    assert found["J_r"].status is not Status.IDENTIFIED


def test_bounds_of_the_file_hold() -> None:
    given = {"J_r": ParameterPrior(initial=1e-5, bounds=(9e-6, 2e-5))}
    assert Vehicle.shipped("pelican").model_copy(update={"parameters": given}).limits("J_r") == (9e-6, 2e-5)
