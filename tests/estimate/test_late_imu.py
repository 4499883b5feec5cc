"""A gyro behind a low-pass is found by the attitude alone, and brought back in time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from quadid.data.window import Window
from quadid.effects import butterworth_delay
from quadid.estimate.late_imu import delay_of, in_time
from quadid.flight import draw_truth, fly
from quadid.vehicle import Vehicle

PELICAN = Vehicle.shipped("pelican")
TRUTH = draw_truth(PELICAN, 3)


def flown(noise: float = 0.1, **effects: dict[str, float]) -> Window:
    return fly(PELICAN, TRUTH, 20.0, 3, effects=effects, noise_scale=noise).window


@pytest.mark.parametrize("noise", [0.1, 1.0, 3.0])
@pytest.mark.parametrize(
    "effects",
    [
        {},
        {"gyro_scale": {"x": 0.05, "y": 0.05, "z": 0.05}},
        {"attitude_delay": {"delay": 0.03}},
        {"gyro_bias": {"x": 0.03}},
        {"motor_lag": {"tau": 0.04}},
    ],
)
def test_a_gyro_in_time_has_no_delay(noise: float, effects: dict[str, dict[str, float]]) -> None:
    assert delay_of([flown(noise, **effects)]) == 0.0


@pytest.mark.parametrize("cutoff", [5.0, 7.0, 10.0, 20.0, 30.0])
def test_the_delay_is_that_of_the_filter(cutoff: float) -> None:
    late = flown(imu_lag={"cutoff": cutoff})
    assert delay_of([late]) == pytest.approx(butterworth_delay(cutoff), rel=0.03)


def test_noise_makes_a_delay_smaller_and_none_from_nothing() -> None:
    late, true = delay_of([flown(1.0, imu_lag={"cutoff": 20.0})]), butterworth_delay(20.0)
    assert 0.6 * true < late < 1.2 * true


def test_what_is_later_than_a_filter_stays() -> None:
    assert delay_of([flown(imu_lag={"cutoff": 4.0})]) == 0.0


def test_in_time_undoes_a_filter_up_to_a_third_of_the_rate() -> None:
    window = flown()
    assert window.gyro is not None
    b, a = butter(2, 10.0, fs=1000.0)
    t = np.arange(20 * len(window)) * 1e-3
    smooth = np.column_stack([np.interp(t, window.t - window.t0, c) for c in window.gyro.T])
    filtered = lfilter(b, a, smooth, axis=0)[::20]
    back = in_time(replace(window, gyro=filtered), butterworth_delay(10.0))
    assert back.gyro is not None
    inside = slice(50, -50)
    before = np.std((filtered - window.gyro)[inside])
    assert np.std((back.gyro - window.gyro)[inside]) < 0.1 * before


def test_rows_that_were_not_measured_stay_so() -> None:
    window = flown()
    assert window.gyro is not None
    gyro = window.gyro.copy()
    gyro[100:103] = np.nan
    back = in_time(replace(window, gyro=gyro), 0.01)
    assert back.gyro is not None
    assert np.array_equal(np.isnan(back.gyro), np.isnan(gyro))
    assert in_time(window, 0.0) is window
