"""Cuts of the fit's windows: into segments that fill them, at borders that differ from window to window."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.flight import TruthParameters
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Shooting
from quadid.model.layout import Layout
from quadid.online import SessionSettings
from quadid.online.fit_job import FIT_SECONDS, FitRequest
from quadid.online.grid_buffer import SHORTEST
from quadid.online.session import WARM_UP
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from tests.online.driving import flight

PELICAN = Vehicle.shipped("pelican")
SETTINGS = SessionSettings()
INERTIA = NOMINAL_NAMES.index("J_xx")
STEP = 1.0 / SETTINGS.rate


def cut(seconds: float) -> Shooting:
    rows = round(seconds / STEP)
    return Shooting.cut([flight(24.0).window.slice(0, rows)], PELICAN, FIT_SECONDS)


@pytest.mark.parametrize(("seconds", "count"), [(SHORTEST, 1), (SETTINGS.window + WARM_UP + STEP, 6)])
def test_segments_fill_a_window_and_a_short_stretch_holds_one(seconds: float, count: int) -> None:
    shooting = cut(seconds)
    assert shooting.count == count
    assert count * shooting.length * STEP > 0.8 * seconds


def test_windows_that_overlap_have_their_borders_at_different_places() -> None:
    length = cut(SETTINGS.window).length
    overlapping = round(SETTINGS.window / SETTINGS.refit)
    phases = np.sort([round(k * SETTINGS.refit / STEP) % length for k in range(overlapping)])
    widest = np.max(np.diff(np.append(phases, phases[0] + length)))
    assert widest < 0.25 * length, "in between all of the flight is near the middle of a segment of some window"


@pytest.mark.parametrize("flexible", [False, True])
def test_a_start_from_which_the_simulation_diverges_is_left(flexible: bool) -> None:
    """Once every later window was called too quiet, and nothing was learned any more."""
    layout, window = Layout(PELICAN), flight(24.0, 5).window.slice(0, 600)
    lost = layout.initial(PELICAN)
    lost[INERTIA] *= 1e-6
    noise = NoiseModel.guess(Shooting.cut([window], PELICAN, FIT_SECONDS).channels, PELICAN.noise)
    reply = FitRequest(1, PELICAN, (window,), 0.0, 12.0, lost, noise, False, 0, flexible=flexible).answer()
    assert reply.excited, reply
    assert reply.theta is not None
    assert reply.theta[INERTIA] == pytest.approx(TruthParameters.of(PELICAN).J_xx, rel=0.2)
