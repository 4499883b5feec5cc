"""Estimates that a right model makes agree, and what is said when they do not."""

import numpy as np
import pytest

from quadid.flight import draw_truth, fly
from quadid.identification.fit import Fit, FitOptions, fit
from quadid.parameters import NOMINAL_NAMES, Status
from tests.identify.flights import PELICAN, flown, guessed

Effects = dict[str, dict[str, float]]


def fitted(seed: int, effects: Effects, seconds: float = 60.0) -> tuple[Fit, dict[str, float]]:
    """The nominal fit of a flight with hidden effects, and the truth."""
    truth = draw_truth(PELICAN, seed)
    window = fly(PELICAN, truth, seconds, seed, effects=effects).window
    return fit([window], guessed(truth, seed), FitOptions(iterations=0)), truth.as_dict()


def test_a_right_model_keeps_its_statuses_and_nearly_its_intervals() -> None:
    grown = []
    for seed in (3, 8, 11, 12):
        found = fit([flown(seed).window], guessed(flown(seed).truth.parameters), FitOptions(iterations=0))
        assert {p.status for p in found.parameters} == {Status.IDENTIFIED}
        assert found.uncertainty.grown is not None
        grown.append(found.uncertainty.grown)
    assert np.median(grown) < 1.001
    assert np.mean(grown) < 1.2


@pytest.mark.parametrize(
    "effects",
    [
        {"motor_lag": {"tau": 0.03}},
        {"thrust_curve": {"dead_speed": 60.0}},
        {"gyro_scale": {"x": 0.03, "y": 0.0, "z": 0.0}},
    ],
)
def test_what_is_called_identified_holds_the_truth_although_the_model_lacks_an_effect(effects: Effects) -> None:
    """Without the comparison these intervals are ten and more standard deviations away from the truth."""
    found, truth = fitted(22, effects)
    named = [p for p in found.parameters if p.status is Status.IDENTIFIED]
    held = [p.ci95[0] <= truth[p.name] <= p.ci95[1] for p in named]
    assert sum(held) >= 0.8 * len(held), [(p.name, p.value / truth[p.name], p.sigma / p.value) for p in named]
    assert found.uncertainty.grown is not None
    assert np.max(found.uncertainty.grown) > 2.0 or len(named) < len(NOMINAL_NAMES)


def test_slow_moments_of_an_offset_do_not_pass_for_inertia() -> None:
    found, truth = fitted(23, {"cg_offset": {"x": 0.01, "y": -0.01}})
    for name in ("J_xx", "J_yy"):
        p = found.parameters[name]
        assert p.status is Status.IDENTIFIED
        assert p.ci95[0] <= truth[name] <= p.ci95[1]
        assert p.sigma < 0.002 * p.value
