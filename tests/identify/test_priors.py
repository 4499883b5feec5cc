"""Prior knowledge: mass, arm, thrust stand, CAD inertia; each with its uncertainty, seen in the posterior."""

from typing import Any

import numpy as np
import pytest
import yaml

from quadid.errors import VehicleError
from quadid.flight import draw_truth, fly
from quadid.identification.fit import Fit, FitOptions, fit
from quadid.parameters import NOMINAL_NAMES, Status
from quadid.vehicle import ParameterPrior, ThrustPoint, Vehicle
from tests.identify.flights import PELICAN, flown, guessed

SEED = 3


def fitted(**changes: Any) -> Fit:
    """A fit of one flight with the vehicle file changed."""
    vehicle = guessed(flown(SEED).truth.parameters).model_copy(update=changes)
    return fit([flown(SEED).window], vehicle, FitOptions(iterations=0))


def with_prior(name: str, value: float, sigma: float) -> dict[str, ParameterPrior]:
    """Priors of a poor guess, one of them known well."""
    priors = dict(guessed(flown(SEED).truth.parameters).parameters)
    return {**priors, name: ParameterPrior(initial=value, sigma=sigma)}


@pytest.fixture(scope="module")
def exact() -> Fit:
    """Mass and arm taken for exact."""
    return fitted()


def test_an_uncertain_mass_is_in_every_interval(exact: Fit) -> None:
    found = fitted(mass_sigma=0.05 * PELICAN.mass)
    np.testing.assert_allclose(found.theta, exact.theta, rtol=3e-3)
    expected = np.hypot(exact.uncertainty.sigma, 0.05)
    np.testing.assert_allclose(found.uncertainty.sigma, expected, rtol=0.01)
    # Ratios are as sharp as before: all six go with the mass.
    covariance = found.uncertainty.covariance
    ratio = np.sqrt(covariance[2, 2] + covariance[3, 3] - 2.0 * covariance[2, 3])
    assert ratio < 2.0 * np.hypot(*exact.uncertainty.sigma[2:4])
    assert found.parameters["J_xx"].status is Status.RATIO_ONLY


def test_an_uncertain_arm_is_in_all_but_b(exact: Fit) -> None:
    found = fitted(arm_sigma=0.02 * PELICAN.arm)
    np.testing.assert_allclose(found.uncertainty.sigma[0], exact.uncertainty.sigma[0], rtol=0.01)
    np.testing.assert_allclose(found.uncertainty.sigma[1:], np.hypot(exact.uncertainty.sigma[1:], 0.02), rtol=0.01)


def test_an_inertia_from_cad_tells_an_uncertain_mass() -> None:
    """The flight ties b and all inertias together, so one that is known sharpens all."""
    truth = flown(SEED).truth.parameters.as_dict()
    cad = with_prior("J_xx", truth["J_xx"], 0.01 * truth["J_xx"])
    found = fitted(mass_sigma=0.05 * PELICAN.mass, parameters=cad)
    assert 0.009 < found.uncertainty.sigma[0] < 0.0101
    assert np.all(found.uncertainty.sigma[[0, 2, 3]] < 0.0101)


def test_a_wrong_mass_is_mended_by_what_is_known_better() -> None:
    truth = flown(SEED).truth.parameters.as_dict()
    cad = with_prior("J_xx", truth["J_xx"], 0.005 * truth["J_xx"])
    vehicle = {"mass": 1.06 * PELICAN.mass, "mass_sigma": 0.05 * PELICAN.mass}
    trusting, found = fitted(mass=vehicle["mass"]), fitted(parameters=cad, **vehicle)
    exact = np.array([truth[n] for n in NOMINAL_NAMES])
    before, after = (np.abs(np.log(f.theta[:6] / exact)) for f in (trusting, found))
    assert np.all(before[[0, 2, 3]] > 0.05)
    assert np.all(after[[0, 2, 3]] < 0.012)
    assert np.all(after < 3.0 * found.uncertainty.sigma)


def test_intervals_cover_when_the_mass_is_off_by_its_own_uncertainty() -> None:
    """Forty flights, each with a mass drawn about the one in the file."""
    inside = []
    for seed in range(40):
        rng = np.random.default_rng([seed, 8])
        truth = draw_truth(PELICAN, seed)
        window = fly(PELICAN, truth, 20.0, seed).window
        wrong = PELICAN.mass * (1.0 + 0.03 * rng.standard_normal())
        vehicle = guessed(truth, seed).model_copy(update={"mass": wrong, "mass_sigma": 0.03 * PELICAN.mass})
        result = fit([window], vehicle, FitOptions(iterations=0))
        error = np.log(result.theta[:6] / np.array([truth.as_dict()[n] for n in NOMINAL_NAMES]))
        inside.append(np.abs(error) < 1.96 * result.uncertainty.sigma)
    assert np.all(np.mean(inside, axis=0) > 0.82)  # 95 % less four binomial standard deviations


def test_a_thrust_stand_tells_b_before_any_flight() -> None:
    speeds = np.linspace(200.0, 700.0, 6)
    scatter = np.exp(0.05 * np.random.default_rng(0).standard_normal(6))
    points = tuple(ThrustPoint(speed=w, thrust=2.0e-5 * w**2 * e) for w, e in zip(speeds, scatter, strict=True))
    stand = PELICAN.model_copy(update={"thrust_stand": points}).stand_thrust
    assert stand is not None
    assert stand[0] == pytest.approx(2.0e-5, rel=0.06)
    assert stand[1] == pytest.approx(0.05 / np.sqrt(6), rel=0.6)
    hover = fly(PELICAN, draw_truth(PELICAN, 1), 20.0, 1, "hover").window
    truth = draw_truth(PELICAN, 1).as_dict()["b"]
    one = (ThrustPoint(speed=500.0, thrust=truth * 500.0**2),)
    vehicle = PELICAN.model_copy(update={"thrust_stand": one, "mass_sigma": 0.2 * PELICAN.mass})
    found = fit([hover], vehicle, FitOptions(iterations=0))
    assert found.parameters["b"].value == pytest.approx(truth, rel=0.01)
    assert found.parameters["b"].sigma / truth == pytest.approx(0.02, rel=0.05)


def test_a_vehicle_file_says_so_and_keeps_it() -> None:
    data = yaml.safe_load(PELICAN.to_yaml())
    assert "mass_sigma" not in data
    given = {**data, "mass_sigma": 0.02, "arm_sigma": 0.003, "thrust_stand": [{"speed": 500.0, "thrust": 5.0}]}
    vehicle = Vehicle.from_yaml(yaml.safe_dump(given))
    assert Vehicle.from_yaml(vehicle.to_yaml()) == vehicle
    for wrong, said in (
        ({"mass_sigma": -1.0}, "mass_sigma"),
        ({"thrust_stand": [{"speed": 500.0, "thrust": 500.0}]}, "outside its bounds"),
        ({"thrust_stand": [{"speed": 500.0, "thrust": 5.0, "thrst": 5.0}]}, "did you mean 'thrust'"),
    ):
        with pytest.raises(VehicleError, match=said):
            Vehicle.from_yaml(yaml.safe_dump({**data, **wrong}))
