"""Status of a number from the joint covariance and from other estimates, on covariances made by hand."""

import numpy as np
import pytest

from quadid.identification.problem import Free
from quadid.identification.uncertainty import Uncertainty, parameter_set
from quadid.model.layout import Layout
from quadid.parameters import ParameterSet, Status
from tests.identify.flights import PELICAN

LAYOUT = Layout(PELICAN)
FREE = Free(tuple(LAYOUT.entry(n) for n in ("b", "J_xx", "thrust_curve.dead_speed")))


def told(sigma: tuple[float, float, float], b_with_curve: float, steps: tuple[float, ...] = ()) -> ParameterSet:
    """Parameters with scaled deviations `sigma`, b and the dead speed correlated; `steps` of b to other estimates."""
    correlation = np.eye(3)
    correlation[0, 2] = correlation[2, 0] = b_with_curve
    unc = Uncertainty(correlation * np.outer(sigma, sigma), np.ones(3), np.array([0.7, 0.7, 10.0]))
    theta = LAYOUT.initial(PELICAN)
    return parameter_set(FREE, theta, theta, unc.differing([np.array([s, 0.0, 0.0]) for s in steps]))


def test_thrust_that_is_known_only_with_its_curve_is_not_a_known_coefficient() -> None:
    """In the flown range b (omega - omega_0)^2 is sharp; b alone goes with the dead speed."""
    b = told((0.15, 0.02, 1.0), b_with_curve=0.99)["b"]
    assert (b.status, b.relative_to) == (Status.RATIO_ONLY, "thrust_curve.dead_speed")


@pytest.mark.parametrize(("sigma", "correlation"), [(0.02, 0.99), (0.15, 0.5)])
def test_a_sharp_coefficient_or_one_of_its_own_is_identified_beside_a_curve(sigma: float, correlation: float) -> None:
    assert told((sigma, 0.02, 1.0), correlation)["b"].status is Status.IDENTIFIED


def test_an_estimate_that_other_estimates_contradict_is_not_to_be_used() -> None:
    near, far = told((0.02, 0.02, 1.0), 0.0, (0.03, -0.05)), told((0.02, 0.02, 1.0), 0.0, (0.03, -0.25))
    assert [p.status for p in (near["b"], far["b"])] == [Status.IDENTIFIED, Status.UNRELIABLE]
    assert [p.status for p in (near["J_xx"], far["J_xx"])] == [Status.IDENTIFIED] * 2
    low, high = near["b"].ci95
    assert low < near["b"].value * np.exp(-0.05) < near["b"].value * np.exp(0.03) < high
