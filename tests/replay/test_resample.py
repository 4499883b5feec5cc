"""Interpolation, holding, and the low-pass: no lag, known amplitude, constants and gaps respected."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage
from scipy.interpolate import CubicHermiteSpline

from quadid.data.grid import interpolate, lowpass, lowpass_span, moving_mean, split_stretches
from quadid.data.window import fresh_rows, measured_period, measured_rows
from quadid.types import FloatArray

STEP = 0.02


def test_interpolated_rows_are_told_from_measured_ones() -> None:
    rng = np.random.default_rng(3)
    slow, fast = 0.1 * np.arange(200.0), 0.01 * np.arange(1980.0)
    values = np.rint(1500.0 + 40.0 * rng.standard_normal((len(slow), 4)))
    values[50:60] = values[50]
    filled: FloatArray = np.column_stack([np.round(np.interp(fast, slow, column), 3) for column in values.T])
    assert measured_period(fast, filled) == pytest.approx(0.1, rel=0.05)
    noisy: FloatArray = filled + 0.1 * rng.standard_normal(filled.shape)
    assert measured_rows(fast, noisy).all(), "noise was measured"
    staircase = values[np.searchsorted(slow, fast + 1e-9, side="right") - 1]
    assert measured_rows(fast, staircase).all(), "held, not interpolated"
    few_lost = rng.standard_normal((1000, 4)).cumsum(axis=0)
    few_lost[10:-10:10] = 0.5 * (few_lost[9:-11:10] + few_lost[11:-9:10])
    assert measured_rows(0.01 * np.arange(1000.0), few_lost).all(), "a filled gap is bridged like any other"


def tone(t: FloatArray, hertz: float) -> FloatArray:
    return np.column_stack([np.sin(2 * np.pi * hertz * t), np.cos(2 * np.pi * hertz * t)])


def response(hertz: float, t: FloatArray, held: bool = False) -> complex:
    """Complex gain of the low-pass at one frequency, seen through samples at `t`."""
    a, b = lowpass_span(t, STEP, held)
    at = np.arange(a, b, STEP)
    out = lowpass(t, tone(t, hertz), at, STEP, held)
    reference = np.exp(2j * np.pi * hertz * at)
    return complex(np.mean((out[:, 1] + 1j * out[:, 0]) * np.conj(reference)))


@pytest.mark.parametrize("rate", [100.0, 137.0, 500.0, 1000.0])
@pytest.mark.parametrize("hertz", [0.5, 2.0, 5.0, 8.0])
def test_pass_band_keeps_phase_and_amplitude(rate: float, hertz: float) -> None:
    gain = response(hertz, np.arange(0.0, 8.0, 1.0 / rate))
    assert abs(np.angle(gain)) < 1e-3
    assert abs(gain) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("rate", [137.0, 500.0, 1000.0])
@pytest.mark.parametrize("hertz", [35.0, 45.0, 60.0])
def test_stop_band_keeps_aliases_out(rate: float, hertz: float) -> None:
    assert abs(response(hertz, np.arange(0.0, 8.0, 1.0 / rate))) < 0.01


def test_half_amplitude_at_the_cutoff() -> None:
    assert abs(response(0.4 / STEP, np.arange(0.0, 8.0, 0.001))) == pytest.approx(0.5, abs=0.01)


def test_held_samples_count_at_the_middle_of_their_step() -> None:
    """A staircase of rate 1/T is half a sample late; its low-pass sees that and the staircase's own droop."""
    period, hertz = 0.004, 5.0
    gain = response(hertz, np.arange(0.0, 8.0, period), held=True)
    assert np.angle(gain) == pytest.approx(-np.pi * hertz * period, abs=1e-3)
    assert abs(gain) == pytest.approx(np.sinc(hertz * period) * abs(response(hertz, np.arange(0, 8, 0.001))), abs=2e-3)


@given(st.floats(-1e3, 1e3), st.booleans(), st.floats(60.0, 900.0))
def test_constants_pass_exactly(value: float, held: bool, rate: float) -> None:
    t = np.arange(0.0, 1.0, 1.0 / rate)
    a, b = lowpass_span(t, STEP, held)
    out = lowpass(t, np.full((len(t), 1), value), np.arange(a, b, STEP), STEP, held)
    np.testing.assert_allclose(out, value, rtol=1e-12, atol=1e-12)


def test_stretches_end_at_gaps_and_breaks() -> None:
    t = np.array([0.0, 1.0, 2.0, 5.0, 6.0, 7.0])
    assert split_stretches(t, 1.5, [6.5]) == [slice(0, 3), slice(3, 5), slice(5, 6)]
    assert split_stretches(t, 1.5, [5.0]) == [slice(0, 3), slice(3, 6)]
    assert split_stretches(np.empty(0), 1.0) == []


def test_fresh_rows_of_a_staircase_and_of_a_resting_signal() -> None:
    slow = np.repeat(np.arange(50.0), 5)[:, None]
    assert list(fresh_rows(slow)) == list(range(0, 250, 5))
    noise = np.random.default_rng(1).normal(size=(100, 2))
    assert len(fresh_rows(noise)) == 100
    resting = np.concatenate([np.zeros((60, 1)), slow])
    assert set(range(60)) <= set(fresh_rows(resting))
    held = np.repeat(np.arange(40.0), 100)[:, None]  # 5 Hz at 500 Hz: all its rows once passed for readings
    assert list(fresh_rows(held)) == list(range(0, 4000, 100))
    rare = np.repeat(np.arange(30.0), np.random.default_rng(2).integers(60, 600, 30))[:, None]
    assert len(fresh_rows(rare)) == len(rare), "commands that rarely change, at any time"


@pytest.mark.parametrize("width", [1, 2, 24, 25])
def test_moving_mean_is_that_of_scipy(width: int) -> None:
    values = np.random.default_rng(4).normal(size=(100, 3))
    mirrored = ndimage.uniform_filter1d(values, width, axis=0)
    np.testing.assert_allclose(moving_mean(values, width, mirrored=True), mirrored, atol=1e-14)
    held = ndimage.uniform_filter1d(values[:, 0], width, mode="nearest")
    np.testing.assert_allclose(moving_mean(values[:, 0], width), held, atol=1e-14)


def test_smooth_interpolation_is_scipys_hermite_spline() -> None:
    rng = np.random.default_rng(5)
    t, values = np.cumsum(rng.uniform(0.5, 1.5, 50)), rng.normal(size=(50, 3))
    at = np.array([t[0], *np.sort(rng.uniform(t[0], t[-1], 99)), t[-1]])
    spline = CubicHermiteSpline(t, values, np.gradient(values, t, axis=0), axis=0)
    np.testing.assert_allclose(interpolate(t, values, at, smooth=True), spline(at), atol=1e-12)
