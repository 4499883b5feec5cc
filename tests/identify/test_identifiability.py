"""The last word on a fit: guesses stay guesses, and what is written passes our own checks."""

from dataclasses import replace

import numpy as np
import pytest

from quadid.identification.fit import Fit, FitOptions, final_answer, fit
from quadid.identification.result import fitted_vehicle, parameter_entry
from quadid.parameters import INERTIAS, ParameterSet, Status, at_bound, impossible_inertia
from quadid.vehicle import ParameterPrior, Vehicle
from tests.identify.flights import PELICAN, flown, guessed


@pytest.fixture(scope="module")
def found() -> Fit:
    return fit([flown(3).window], guessed(flown(3).truth.parameters), FitOptions(iterations=0))


def changed(fit: Fit, **values: tuple[float, Status]) -> Fit:
    """The fit with other values and statuses."""
    out = tuple(
        replace(p, value=values[p.name][0], status=values[p.name][1]) if p.name in values else p for p in fit.parameters
    )
    return replace(fit, parameters=ParameterSet(out, np.array(fit.parameters.covariance)))


def test_only_identified_values_are_written_with_a_sigma(found: Fit) -> None:
    b, d = found.parameters["b"].value, found.parameters["d"].value
    doubtful = changed(found, b=(b, Status.UNRELIABLE), d=(d, Status.RATIO_ONLY))
    written = fitted_vehicle(doubtful).parameters
    assert written["b"].sigma is None
    assert written["d"].sigma is None
    assert written["J_xx"].sigma is not None
    given = found.vehicle.parameters
    for name in ("b", "d"):  # as the former file has them
        assert (written[name].initial, written[name].bounds) == (given[name].initial, given[name].bounds)
    assert written["J_xx"].initial == pytest.approx(found.parameters["J_xx"].value, rel=1e-6)
    # Correlations are those between what has a sigma, in and out of the file.
    file = Vehicle.from_yaml(fitted_vehicle(doubtful).to_yaml())
    assert not {"b", "d"} & {n for one, others in file.correlation.items() for n in (one, *others)}
    known = [found.parameters.names.index(n) for n in ("J_xx", "J_yy")]
    expected = found.parameters.covariance[np.ix_(known, known)]
    np.testing.assert_allclose(file.covariance[2:4, 2:4], expected, atol=0.012 * expected[0, 0])


def test_a_guess_beside_identified_moments_stays_a_rigid_body(found: Fit) -> None:
    J_zz = found.vehicle.parameters["J_zz"].initial
    small = changed(
        found,
        J_xx=(0.1 * J_zz, Status.IDENTIFIED),
        J_yy=(0.1 * J_zz, Status.IDENTIFIED),
        J_zz=(J_zz, Status.UNRELIABLE),
    )
    written = Vehicle.from_yaml(fitted_vehicle(small).to_yaml()).parameters
    assert written["J_zz"].initial == pytest.approx(0.2 * J_zz)
    assert written["J_zz"].sigma is None
    assert written["J_xx"].sigma is not None


def test_what_no_channel_shows_keeps_the_guess_without_a_sigma(found: Fit) -> None:
    masked = final_answer(found, {"J_zz": "the log has no yaw"})
    assert masked.parameters["J_zz"].status is Status.PRIOR_DOMINATED
    assert masked.parameters["J_zz"].prior_share == 1.0
    assert masked.parameters["J_zz"].value == found.vehicle.parameters["J_zz"].initial
    assert any("no yaw" in w for w in masked.warnings)
    assert fitted_vehicle(masked).parameters["J_zz"].sigma is None


def test_a_guess_that_no_rigid_body_has_is_moved_and_said(found: Fit) -> None:
    wrong = changed(found, J_zz=(20.0 * found.parameters["J_zz"].value, Status.PRIOR_DOMINATED))
    moved = final_answer(wrong, {})
    assert impossible_inertia([moved.parameters[n].value for n in INERTIAS], 1.0) is None
    assert moved.parameters["J_xx"] == wrong.parameters["J_xx"]
    assert any(w.startswith("J_zz: moved from") for w in moved.warnings)
    text = fitted_vehicle(moved).to_yaml()
    guess = found.vehicle.parameters["J_zz"].initial
    assert Vehicle.from_yaml(text, "moved").parameters["J_zz"].initial == pytest.approx(guess)


def test_identified_values_that_no_rigid_body_has_are_not_left_identified(found: Fit) -> None:
    wrong = changed(found, J_zz=(20.0 * found.parameters["J_zz"].value, Status.IDENTIFIED))
    assert final_answer(wrong, {}).parameters["J_zz"].status is Status.UNRELIABLE
    assert final_answer(found, {}).parameters.parameters == found.parameters.parameters


def test_a_prior_that_decides_is_named() -> None:
    """A file whose b is sharp and wrong decides b; the same file with a wide prior leaves it to the flight."""
    truth = flown(3).truth.parameters
    sharp = guessed(truth)
    b = 0.98 * truth.as_dict()["b"]
    priors = {**sharp.parameters, "b": ParameterPrior(initial=b, sigma=1e-5 * b)}
    decided = fit([flown(3).window], sharp.model_copy(update={"parameters": priors}), FitOptions(iterations=0))
    assert decided.parameters["b"].status is not Status.IDENTIFIED
    assert parameter_entry(decided.parameters["b"])["prior_share"] > 0.5
    free = fit([flown(3).window], sharp, FitOptions(iterations=0))
    assert free.parameters["b"].status is Status.IDENTIFIED
    assert parameter_entry(free.parameters["b"])["prior_share"] < 1e-3


@pytest.mark.parametrize(
    ("value", "low", "high", "rests"),
    [
        (1.0005, 1.0, 2.0, True),
        (1.002, 1.0, 2.0, False),
        (1.999, 1.0, 2.0, True),
        (0.0, 0.0, 0.2, True),
        (0.001, 0.0, 0.2, False),
        (1.0, -np.inf, np.inf, False),
    ],
)
def test_one_tolerance_says_what_rests_on_a_bound(value: float, low: float, high: float, rests: bool) -> None:
    assert at_bound(value, low, high) is rests


def test_a_value_on_a_bound_is_unreliable() -> None:
    truth = flown(3).truth.parameters
    b = truth.as_dict()["b"]
    priors = {**guessed(truth).parameters, "b": ParameterPrior(initial=0.6 * b, bounds=(0.5 * b, 0.7 * b))}
    vehicle = PELICAN.model_copy(update={"parameters": priors})
    assert fit([flown(3).window], vehicle, FitOptions(iterations=0)).parameters["b"].status is Status.UNRELIABLE


def test_a_value_whose_interval_reaches_its_bound_is_unreliable() -> None:
    """A bound one standard deviation above the estimate has a say in it."""
    window = flown(3).window.slice(0, 500)
    vehicle = PELICAN.model_copy(update={"parameters": guessed(flown(3).truth.parameters).parameters})
    free = fit([window], vehicle, FitOptions(iterations=0)).parameters["J_xx"]
    assert free.status is Status.IDENTIFIED
    high = free.value + free.sigma
    priors = {**vehicle.parameters, "J_xx": ParameterPrior(initial=0.9 * high, bounds=(0.3 * high, high))}
    near = fit([window], vehicle.model_copy(update={"parameters": priors}), FitOptions(iterations=0))
    found = near.parameters["J_xx"]
    assert not at_bound(found.value, 0.3 * high, high), "the estimate itself lies inside"
    assert found.status is Status.UNRELIABLE
    assert any("the interval of J_xx reaches its bound" in text for text in near.warnings)
