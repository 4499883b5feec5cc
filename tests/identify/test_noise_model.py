"""Noise: what was drawn is found again, and the whitener turns it into unit white noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import freqz, lfilter

from quadid.identification.fit import LOWEST, shaped_noise
from quadid.identification.noise import SHAPE_POINTS, SLOW_TIME, NoiseModel, estimate_noise
from quadid.identification.problem import Shooting
from quadid.identification.result import settle_states
from quadid.types import FloatArray
from quadid.vehicle import Noise
from tests.identify.flights import PELICAN, at_truth, flown, turned

DT = 0.02
WHITE = np.array([0.02, 0.01, 0.03, 0.003, 0.004, 0.002, 0.2, 0.1, 0.3])
SLOW = np.array([0.0, 0.0, 0.0, 0.004, 0.002, 0.006, 0.0, 0.0, 0.0])


def drawn(rng: np.random.Generator, segments: int, length: int, white: FloatArray, slow: FloatArray) -> FloatArray:
    """White plus first-order Gauss-Markov noise of `SLOW_TIME`, shape (segments, length, channels)."""
    pole = np.exp(-DT / SLOW_TIME)
    drive = rng.standard_normal((segments, length, len(white)))
    drive[:, 1:] *= np.sqrt(1.0 - pole**2)
    return np.asarray(
        white * rng.standard_normal((segments, length, len(white))) + slow * lfilter([1.0], [1.0, -pole], drive, axis=1)
    )


def with_trend(rng: np.random.Generator, noise: FloatArray) -> FloatArray:
    """Noise beside what a wrong initial state leaves: rates off by a constant, attitude by a line."""
    segments, length, _ = noise.shape
    out, ramp = noise.copy(), np.linspace(-1.0, 1.0, length)[None, :, None]
    out[..., :6] += rng.standard_normal((segments, 1, 6))
    out[..., 3:6] += rng.standard_normal((segments, 1, 3)) * ramp
    return out


def test_white_and_slow_part_are_both_found_whatever_the_initial_states_did() -> None:
    rng = np.random.default_rng(1)
    residual = with_trend(rng, drawn(rng, 800, 50, WHITE, SLOW))
    found = estimate_noise(residual, np.ones_like(residual), DT, 1.0)
    # 800 segments of about 48 degrees of freedom: the standard error of a white sigma is 1 / sqrt(2 * 38400) = 0.4 %.
    fast = SLOW == 0.0
    np.testing.assert_allclose(found.white[fast], WHITE[fast], rtol=0.02)
    # Beside a slow part three times as large, two quadratic forms tell the white part less well.
    np.testing.assert_allclose(found.white[~fast], WHITE[~fast], rtol=0.1)
    # A one-second segment holds about one independent value of noise with 0.66 s of memory.
    np.testing.assert_allclose(found.slow[3:6], SLOW[3:6], rtol=0.15)
    assert not found.slow[[0, 1, 2, 6, 7, 8]].any()
    np.testing.assert_allclose(found.variance, found.white**2 + found.slow**2)


def test_the_variance_is_not_biased_by_trimming_or_by_fitted_parameters() -> None:
    """Mean of many estimates from few segments; 4 standard errors of that mean."""
    rng = np.random.default_rng(2)
    draws = []
    for _ in range(60):
        residual = drawn(rng, 60, 25, WHITE, np.zeros(9))
        draws.append(estimate_noise(0.9 * residual, np.ones_like(residual), DT, 0.81).white / WHITE)
    # Attitude may have been given a slow part, which takes from the white one.
    power = np.array(draws)[:, [0, 1, 2, 6, 7, 8]] ** 2
    assert abs(power.mean() - 1.0) < 4.0 * power.mean(axis=1).std() / np.sqrt(len(power)) + 1e-3


def test_a_burst_of_outliers_hardly_moves_the_estimate() -> None:
    rng = np.random.default_rng(3)
    residual = drawn(rng, 300, 25, WHITE, np.zeros(9))
    residual[:5] *= 30.0
    found = estimate_noise(residual, np.ones_like(residual), DT, 1.0)
    np.testing.assert_allclose(found.white[[0, 1, 2, 6, 7, 8]], WHITE[[0, 1, 2, 6, 7, 8]], rtol=0.04)


def test_a_channel_that_was_never_measured_keeps_the_typical_noise() -> None:
    rng = np.random.default_rng(4)
    residual = drawn(rng, 50, 25, WHITE, np.zeros(9))
    weights = np.ones_like(residual)
    weights[..., 6:9] = 0.0
    residual[..., 6:9] = 1e6
    found = estimate_noise(residual, weights, DT, 1.0)
    np.testing.assert_array_equal(found.white[6:9], NoiseModel.guess(9).white[6:9])


def test_scattered_samples_give_a_noise_too() -> None:
    """Attitude at a fifth of the grid's rate: no segment is complete, two directions of each are fitted away."""
    rng = np.random.default_rng(5)
    residual = drawn(rng, 400, 50, WHITE, np.zeros(9))
    weights = np.ones_like(residual)
    weights[..., 3:6] = 0.0
    weights[:, ::5, 3:6] = 1.0
    t = np.linspace(-1.0, 1.0, 10)
    basis = np.linalg.qr(np.vander(t, 2))[0]
    sparse = residual[:, ::5, 3:6]
    residual[:, ::5, 3:6] = sparse - np.einsum("ij,kj,skc->sic", basis, basis, sparse)
    found = estimate_noise(residual, weights, DT, 1.0)
    np.testing.assert_allclose(found.white[3:6], WHITE[3:6], rtol=0.05)
    assert not found.slow[3:6].any()


def test_the_whitener_inverts_the_covariance_of_white_and_slow_noise_exactly() -> None:
    length = 25
    noise = NoiseModel(WHITE, SLOW)
    lag = DT * np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    for c, whitener in enumerate(noise.whitener(length, DT)):
        covariance = WHITE[c] ** 2 * np.eye(length) + SLOW[c] ** 2 * np.exp(-lag / SLOW_TIME)
        np.testing.assert_allclose(whitener @ covariance @ whitener.T, np.eye(length), atol=1e-9)
    np.testing.assert_array_equal(noise.coloured, SLOW > 0.0)


def test_the_whitener_makes_drawn_noise_white() -> None:
    rng = np.random.default_rng(6)
    noise = NoiseModel(WHITE, SLOW)
    white = np.einsum("cij,sjc->sic", noise.whitener(25, DT), drawn(rng, 4000, 25, WHITE, SLOW))
    covariance = np.einsum("sic,sjc->cij", white, white) / len(white)
    # 4000 draws: each entry has a standard error of 1.6 %, the diagonal of 2.2 %; 5 of them for 9 * 625 entries.
    np.testing.assert_allclose(covariance, np.broadcast_to(np.eye(25), covariance.shape), atol=0.11)


def hump(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """Noise of unit variance with a hump near 12 Hz, shape (n, 3), and its relative spectrum on `SHAPE_POINTS`."""
    radius, angle = 0.8, 2.0 * np.pi * 12.0 * DT
    denominator = np.array([1.0, -2.0 * radius * np.cos(angle), radius**2])
    _, response = freqz([1.0], denominator, worN=np.linspace(0.0, np.pi, SHAPE_POINTS))
    power = np.abs(response) ** 2
    noise = lfilter([1.0], denominator, rng.standard_normal((n + 100, 3)), axis=0)[100:]
    return np.asarray(noise / np.sqrt(np.mean(power))), np.asarray(power / np.mean(power))


def test_the_whitener_flattens_a_spectrum() -> None:
    rng = np.random.default_rng(7)
    coloured, shape = hump(rng, 50 * 2000)
    shapes = np.vstack([np.tile(shape, (3, 1)), np.ones((6, SHAPE_POINTS))])
    model = NoiseModel(np.full(9, 0.1), np.zeros(9), shape=shapes)
    assert model.coloured[:3].all()
    assert not model.coloured[3:].any()
    segments = 0.1 * coloured.reshape(2000, 50, 3)
    white = np.einsum("cij,sjc->sic", model.whitener(50, DT)[:3], segments)
    covariance = np.einsum("sic,sjc->cij", white, white) / len(white)
    power = covariance[:, range(50), range(50)]
    # Fifty samples do not cut the modes apart: a hump of 20 dB leaks up to a fifth into its quiet neighbours.
    np.testing.assert_allclose(power, 1.0, atol=0.3)
    assert abs(power.mean() - 1.0) < 0.1
    np.testing.assert_allclose(covariance - np.eye(50) * covariance, 0.0, atol=0.25)


def test_the_spectrum_of_a_flight_is_found_above_3_hz_and_flat_below() -> None:
    """A noiseless flight with drawn noise: hump in the gyro, white elsewhere."""
    flight = flown(1, noise_scale=0.0)
    rng = np.random.default_rng(8)
    window = flight.window
    assert window.gyro is not None
    assert window.accel is not None
    assert window.attitude is not None
    n = len(window)
    coloured, shape = hump(rng, n)
    window = replace(
        window,
        gyro=window.gyro + 0.02 * coloured,
        accel=window.accel + 0.2 * rng.standard_normal((n, 3)),
        attitude=turned(window.attitude, 0.0015 * rng.standard_normal((n, 3))),
    )
    shooting = Shooting.cut([window], PELICAN, 0.5)
    theta = at_truth(shooting, flight.truth.parameters)
    lin = settle_states(shooting, theta)
    shooting = shooting.with_noise(estimate_noise(lin.residuals, lin.weights, shooting.dt, 1.0))
    states = settle_states(shooting, theta).states
    found = shaped_noise(shooting, theta, shooting.free([]), states)
    assert found.shape is not None
    frequency = np.linspace(0.0, 25.0, SHAPE_POINTS)
    above = frequency > LOWEST + 1.0
    spectrum = (found.white[:, None] ** 2 * found.shape)[:3, above]
    # Three neighbouring modes of 1 Hz are averaged, so the hump is a little wider and lower than the one drawn.
    np.testing.assert_allclose(spectrum.mean(axis=0), 0.02**2 * shape[above], rtol=0.5)
    assert abs(frequency[above][np.argmax(spectrum.mean(axis=0))] - frequency[np.argmax(shape)]) <= 1.0
    np.testing.assert_allclose(np.sqrt(found.variance[:3]), 0.02, rtol=0.06)
    np.testing.assert_allclose(found.shape[:3, frequency < LOWEST - 0.5].std(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(found.white[6:9], 0.2, rtol=0.03)
    np.testing.assert_allclose(found.shape[6:9, above].mean(axis=1), 1.0, atol=0.05)
    np.testing.assert_allclose(np.sqrt(found.variance[3:6]), 0.003, rtol=0.05)


def test_known_noise_of_the_vehicle_file_is_the_first_guess() -> None:
    guess = NoiseModel.guess(12, Noise(gyro=0.5, accel=2.0))
    np.testing.assert_array_equal(guess.white[:3], 0.5)
    np.testing.assert_array_equal(guess.white[6:9], 2.0)
    np.testing.assert_array_equal(guess.white[3:6], NoiseModel.guess(9).white[3:6])
    assert len(guess.white) == 12


@pytest.mark.parametrize("length", [4, 10, 50])
def test_segments_of_any_length_can_be_whitened(length: int) -> None:
    for shape in (None, np.ones((9, SHAPE_POINTS))):
        whitener = NoiseModel(WHITE, SLOW, shape=shape).whitener(length, DT)
        assert whitener.shape == (9, length, length)
        assert np.isfinite(whitener).all()
