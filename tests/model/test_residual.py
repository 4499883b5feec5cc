"""Terms beyond the catalogue: the same as the catalogue where both can say it, nothing where they are zero."""

import numpy as np
import pytest

from quadid.errors import VehicleError
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout, Segments
from quadid.vehicle import SIGNALS, TARGETS, ResidualTerm, Vehicle
from tests.model.test_lanes import noisy_window

PELICAN = Vehicle.shipped("pelican")


def with_terms(*terms: tuple[str, tuple[str, ...], float]) -> Vehicle:
    made = tuple(ResidualTerm(acts_on=target, product=product, value=value) for target, product, value in terms)
    return PELICAN.model_copy(update={"residual": made})


def residuals(vehicle: Vehicle, effects: dict[str, dict[str, float]] | None = None) -> np.ndarray:
    window = noisy_window(motion=True)
    rollout, layout = Rollout(window, vehicle), Layout(vehicle)
    theta = layout.initial(vehicle)
    layout.write_effects(theta, effects or {})
    segments = Segments.cut(len(window), 25, 8)
    return np.asarray(rollout.roll(segments, theta[None], rollout.initial_states(segments))[0][0, ..., 0])


def test_zero_terms_change_nothing() -> None:
    every = [(target, (signal,), 0.0) for target in TARGETS for signal in SIGNALS]
    np.testing.assert_array_equal(residuals(with_terms(*every)), residuals(PELICAN))


@pytest.mark.parametrize(
    ("terms", "effects", "channels"),
    [
        (
            [("moment_x", ("p",), -8e-3 * 0.5), ("moment_y", ("q",), -8e-3 * 0.4)],
            {"rate_damping": {"l_p": 0.5, "m_q": 0.4}},
            slice(0, 3),
        ),
        (
            [
                ("force_x", ("V", "v_x"), -1.3 * 0.03),
                ("force_y", ("V", "v_y"), -1.3 * 0.03),
                ("force_z", ("V", "v_z"), -1.3 * 0.03),
            ],
            {"parasitic_drag": {"c": 0.03}},
            slice(6, 9),
        ),
    ],
)
def test_a_term_is_the_effect_that_has_its_form(
    terms: list[tuple[str, tuple[str, ...], float]], effects: dict[str, dict[str, float]], channels: slice
) -> None:
    vehicle = PELICAN.model_copy(update={"mass": 1.3})
    assert vehicle.mass == PELICAN.mass
    plain = residuals(PELICAN)
    change, expected = residuals(with_terms(*terms)) - plain, residuals(PELICAN, effects) - plain
    error = np.abs(change[..., channels] - expected[..., channels]).max()
    assert error < 0.03 * np.abs(expected[..., channels]).max()
    assert np.abs(expected[..., channels]).max() > 1e-3


def test_a_term_survives_the_vehicle_file_and_says_its_formula() -> None:
    vehicle = with_terms(("moment_x", ("v_y", "T"), -1.25e-5))
    read = Vehicle.from_yaml(vehicle.to_yaml())
    assert read.residual == vehicle.residual
    assert read.residual[0].formula == "moment_x += -1.25e-05 v_y T"
    assert read.residual[0].unit == "N m / (m/s) / (N)"


@pytest.mark.parametrize(
    ("term", "reason"),
    [
        ("{acts_on: moment_w, value: 1.0}", "moment_"),
        ("{acts_on: moment_x, product: [v_w], value: 1.0}", "v_"),
        ("{acts_on: moment_x, product: [tau_x], value: -1.0}", "signal 'tau_x' is none of"),
        ("{acts_on: moment_x, product: [p, q, r, p], value: 1.0}", "residual"),
        ("{acts_on: moment_x, product: [p], value: .nan}", "residual"),
    ],
)
def test_a_term_that_cannot_be_is_refused_by_its_name(term: str, reason: str) -> None:
    with pytest.raises(VehicleError, match=reason):
        Vehicle.from_yaml(PELICAN.to_yaml() + f"residual: [{term}]\n")
