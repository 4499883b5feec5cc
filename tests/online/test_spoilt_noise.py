"""Noise that was taken from bad data must not hide the motion of good data for ever (found by `make chaos`)."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.data.grid import to_windows
from quadid.data.window import Window
from quadid.identification.noise import NoiseModel
from quadid.model.layout import Layout
from quadid.online.fit_job import FitReply, FitRequest
from quadid.online.fusion import Estimator
from quadid.online.grid_buffer import WindowCut
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from tests.online.driving import flight

PELICAN = Vehicle.shipped("pelican")
TRUE_B = 2.33e-5


@pytest.fixture(scope="module")
def windows() -> tuple[Window, ...]:
    """Ten seconds of lively flight."""
    return tuple(to_windows(flight(10.0, 6).recording, PELICAN))


def fitted(windows: tuple[Window, ...], noise: NoiseModel | None, search: bool = False) -> FitReply:
    theta = Layout(PELICAN).initial(PELICAN)
    return FitRequest(1, PELICAN, windows, 0.0, 10.0, theta, noise, search, 0).answer()


def spoilt(channels: int) -> NoiseModel:
    """As a fit of a window says whose gyro had the wrong sign: some rad/s of noise."""
    usual = NoiseModel.guess(channels)
    white = usual.white.copy()
    white[:3], white[3:6] = 3.0, 1.0
    return NoiseModel(white, usual.slow)


def test_a_spoilt_noise_is_found_anew_and_the_fit_done(windows: tuple[Window, ...]) -> None:
    good = fitted(windows, None, search=True)
    assert good.noise is not None
    reply = fitted(windows, spoilt(len(good.noise.white)))
    assert reply.excited
    assert reply.noise is not None
    assert reply.theta is not None
    assert np.allclose(reply.noise.white, good.noise.white, rtol=0.3)
    assert reply.theta[NOMINAL_NAMES.index("b")] == pytest.approx(TRUE_B, rel=0.02)


def test_the_learner_takes_the_noise_that_was_found_anew(windows: tuple[Window, ...]) -> None:
    learner = Estimator(PELICAN, 60.0, 0)
    learner.take(learner.request(1, WindowCut(windows, 10.0, 0), 0.0, 10.0), fitted(windows, None, search=True))
    (good,) = learner.noises.values()
    learner.noises[len(good.white)] = spoilt(len(good.white))
    asked = learner.request(2, WindowCut(windows, 10.0, 0), 0.0, 10.0)
    assert asked.noise is not None
    assert asked.noise.white[0] == 3.0
    learner.take(asked, asked.answer())
    assert np.allclose(learner.noises[len(good.white)].white, good.white, rtol=0.3)


def test_calm_flight_is_still_not_excited(windows: tuple[Window, ...]) -> None:
    """The usual noise decides only where the one at hand is far above it."""
    calm = tuple(to_windows(flight(10.0, 6, "hover").recording, PELICAN))
    good = fitted(windows, None, search=True).noise
    assert good is not None
    assert not fitted(calm, good).excited
    assert not fitted(calm, spoilt(len(good.white))).excited
