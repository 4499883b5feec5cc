"""Sensor noise as specified, and independent of everything else."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from quadid.errors import ParameterError
from quadid.flight import Flight, SensorNoise, fly
from quadid.flight.loop import butterworth, coloured
from quadid.rotation import exponential, product
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

PELICAN = Vehicle.shipped("pelican")


def attitude_error(flight: Flight) -> FloatArray:
    """Error of the logged attitude as a body rotation vector [rad]."""
    assert flight.window.attitude is not None
    real = Rotation.from_quat(flight.truth.quaternion[:, [1, 2, 3, 0]])
    return np.asarray((real.inv() * Rotation.from_quat(flight.window.attitude[:, [1, 2, 3, 0]])).as_rotvec())


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(PELICAN, seconds=200.0, seed=8, extras=("velocity", "position", "battery"))


def test_gyro_noise_is_white(flight: Flight) -> None:
    assert flight.window.gyro is not None
    error = flight.window.gyro - flight.truth.rates
    sigma = np.hypot(0.02, 0.005)
    np.testing.assert_allclose(error.std(axis=0), sigma, rtol=0.05)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=5 * sigma / 100)
    for axis in range(3):
        e = error[:, axis]
        for lag in (1, 2, 5):
            assert abs(np.corrcoef(e[lag:], e[:-lag])[0, 1]) < 0.06


def test_vibration_sits_at_the_rotors_frequency() -> None:
    """At 2 kHz nothing is aliased: the gyro's vibration peaks where the rotors turn, about 370 / 2 pi = 59 Hz."""
    noise = SensorNoise(gyro=0.0, attitude=0.0, attitude_slow=0.0, accel=0.0)
    flight = fly(PELICAN, None, 4.0, 1, "hover", noise=noise, log_rate=500.0)
    assert flight.window.gyro is not None
    error = (flight.window.gyro - flight.truth.rates)[:, 0]
    spectrum = np.abs(np.fft.rfft(error * np.hanning(len(error))))
    peak = np.fft.rfftfreq(len(error), 0.002)[spectrum.argmax()]
    assert peak == pytest.approx(flight.truth.parameters.hover_speed(4) / (2 * np.pi), rel=0.02)
    assert error.std() == pytest.approx(0.005, rel=0.35)


def test_accelerometer_noise() -> None:
    noise = SensorNoise(gyro=0.0, attitude=0.0, attitude_slow=0.0, gyro_shake=0.0, accel_shake=0.0)
    loud = fly(PELICAN, seconds=100.0, seed=8, noise=noise)
    still = fly(PELICAN, seconds=100.0, seed=8, noise_scale=0.0)
    assert loud.window.accel is not None
    assert still.window.accel is not None
    error = loud.window.accel - still.window.accel
    np.testing.assert_allclose(error.std(axis=0), 0.2, rtol=0.05)


def test_attitude_noise_is_white_plus_slowly_coloured(flight: Flight) -> None:
    error = attitude_error(flight)
    np.testing.assert_allclose(error.std(axis=0), np.hypot(0.003, 0.004), rtol=0.15)
    rough = np.diff(error, axis=0).std(axis=0) / np.sqrt(2.0)
    np.testing.assert_allclose(rough, np.hypot(0.003, 0.004 * np.sqrt(1 - np.exp(-0.02))), rtol=0.05)
    lagged = [(error[50:, a] * error[:-50, a]).mean() / 0.004**2 for a in range(3)]
    assert np.mean(lagged) == pytest.approx(np.exp(-1.0), abs=0.25)


def test_gauss_markov_noise_has_its_correlation_time() -> None:
    rng = np.random.default_rng(1)
    x = coloured(rng, 200_000, 2.0, 1.0, 0.02)
    assert x.std() == pytest.approx(2.0, rel=0.03)
    assert x[0].size == 3
    assert np.mean(x[50:] * x[:-50]) / 4.0 == pytest.approx(np.exp(-1.0), abs=0.03)


def test_optional_channels(flight: Flight) -> None:
    w, truth = flight.window, flight.truth
    assert w.velocity is not None
    assert w.position is not None
    assert w.battery is not None
    np.testing.assert_allclose((w.velocity - truth.velocity).std(axis=0), 0.05, rtol=0.05)
    np.testing.assert_allclose((w.position - truth.position).std(axis=0), 0.02, rtol=0.05)
    assert w.battery.mean() == pytest.approx(12.4, abs=0.01)
    assert set(flight.recording.channels) >= {"velocity", "position", "battery"}
    sagging = fly(PELICAN, seconds=20.0, effects={"battery_sag": {"fraction": 0.1}}, extras=("battery",)).window.battery
    assert sagging is not None
    assert sagging[-50:].mean() == pytest.approx(12.4 * np.sqrt(0.9), abs=0.03)
    with pytest.raises(ParameterError, match="velocity, position, battery"):
        fly(PELICAN, seconds=2.0, extras=("airspeed",))


def test_noise_is_gaussian_and_scales(flight: Flight) -> None:
    assert flight.window.velocity is not None
    error = (flight.window.velocity - flight.truth.velocity)[:, 0]
    assert kstest(error / 0.05, "norm").pvalue > 1e-3
    louder = fly(PELICAN, seconds=50.0, seed=8, noise_scale=3.0)
    assert louder.window.gyro is not None
    assert (louder.window.gyro - louder.truth.rates).std() == pytest.approx(3 * np.hypot(0.02, 0.005), rel=0.1)


def test_noise_free_log_is_the_truth() -> None:
    flight = fly(PELICAN, seconds=10.0, seed=8, noise_scale=0.0)
    assert flight.window.gyro is not None
    np.testing.assert_array_equal(flight.window.gyro, flight.truth.rates)
    assert np.abs(attitude_error(flight)).max() < 1e-7


def test_butterworth_keeps_slow_signals_and_their_level() -> None:
    t = np.arange(20_000) * 1e-3
    steady = butterworth(np.ones((100, 2)), 5.0, 1e-3)
    np.testing.assert_allclose(steady, 1.0, rtol=1e-9)
    slow = butterworth(np.sin(2 * np.pi * 0.2 * t)[:, None], 5.0, 1e-3)[:, 0]
    delay = np.sqrt(2.0) / (2 * np.pi * 5.0)
    np.testing.assert_allclose(slow[5000:], np.sin(2 * np.pi * 0.2 * (t - delay))[5000:], atol=2e-3)
    at_cutoff = butterworth(np.sin(2 * np.pi * 5.0 * t)[:, None], 5.0, 1e-3)[5000:, 0]
    assert at_cutoff.std() * np.sqrt(2.0) == pytest.approx(1.0 / np.sqrt(2.0), rel=1e-3)


def test_quaternion_algebra_agrees_with_scipy() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 20, 3))
    both = product(exponential(a), exponential(b))
    other = (Rotation.from_rotvec(a) * Rotation.from_rotvec(b)).as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(both * other, axis=1)), 1.0, rtol=1e-12)
