"""Slopes along residual terms are those of the simulation."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.data.window import Window
from quadid.flight import fly
from quadid.identification.open_loop import OpenLoop
from quadid.identification.residual_fit import candidate_terms
from quadid.identification.term_sensitivity import term_sensitivity, typical
from quadid.model.layout import Layout
from quadid.types import FloatArray
from quadid.vehicle import ResidualTerm, Vehicle
from tests.identify.flights import PELICAN

AT = np.array([5, 25])
SHARE = 1e-3
"""Of a typical size, for differences."""
FOUND = (ResidualTerm(acts_on="moment_x", product=("p",), value=-0.02),)
"""What was learnt before: it answers to the state, so later slopes depend on it."""


@pytest.fixture(scope="module")
def window() -> Window:
    flight = fly(PELICAN, seconds=6.0, seed=3, extras=("velocity", "position"))
    return flight.window


def misses(window: Window, own: Vehicle, terms: tuple[ResidualTerm, ...]) -> FloatArray:
    vehicle = own.model_copy(update={"residual": terms})
    return np.asarray(OpenLoop(window, vehicle, int(AT[-1]), 10).misses(Layout(vehicle).initial(vehicle)[None], AT)[0])


@pytest.mark.parametrize("effects", [{}, {"imu_lag": {"cutoff": 20.0}, "drag_torque_curve": {"growth": 1.0}}])
@pytest.mark.parametrize("found", [(), FOUND])
def test_they_are_differences_of_the_simulation(
    window: Window, found: tuple[ResidualTerm, ...], effects: dict[str, dict[str, float]]
) -> None:
    """Also of rotors that are simulated on from one start to the next."""
    own = PELICAN.model_copy(update={"effects": effects})
    candidates = (*candidate_terms()[::37], ResidualTerm(acts_on="force_z", product=("T",), value=0.0))
    assert {c.acts_on for c in candidates} > {"force_x", "moment_x"}
    vehicle: Vehicle = own.model_copy(update={"residual": found})
    slopes = term_sensitivity(OpenLoop(window, vehicle, int(AT[-1]), 10), vehicle, candidates, AT)
    before, sizes = misses(window, own, found), typical(vehicle, candidates)
    for i, term in enumerate(candidates):
        moved = (*found, term.model_copy(update={"value": SHARE * float(sizes[i])}))
        expected = (misses(window, own, moved) - before) / SHARE
        off = np.linalg.norm(slopes[..., i] - expected) / np.linalg.norm(expected)
        assert off < 0.1, term  # the simulation extrapolates the mean of a product over a step; slopes know it
