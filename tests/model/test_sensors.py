"""Sensors: filters, delays, errors, each against SciPy or the contract's wording."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import butter, lsim
from scipy.spatial.transform import Rotation

from quadid.data.window import Window
from quadid.model.rollout import Rollout, Segments
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.model.flights import fly, lively_input, values_of, vector
from tests.model.independent import EULER, RATE, Flown, quaternion

PELICAN = Vehicle.shipped("pelican")
DT = 0.01
GYRO, ATTITUDE, ACCEL, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)


@lru_cache(maxsize=1)
def flight() -> Flown:
    """One flight of 1.2 s with drag, so that all three axes of the accelerometer see something."""
    values = values_of(PELICAN, {"rotor_drag.k_x": 0.4, "rotor_drag.k_y": 0.4, "motor_lag.tau": 0.03})
    return fly(PELICAN, values, lively_input(PELICAN, 1.2, DT))


def residuals(window: Window, effects: dict[str, float], n_pre: int = 1) -> FloatArray:
    """Residuals (rows, channels) of the rows from `n_pre` + 1 on, of a model with these sensor effects."""
    values = values_of(PELICAN, {"rotor_drag.k_x": 0.4, "rotor_drag.k_y": 0.4, "motor_lag.tau": 0.03, **effects})
    first = n_pre + 1
    segments = Segments(len(window) - first - 1, n_pre, np.array([first]))
    rollout = Rollout(window, PELICAN)
    start = flight().states(segments.starts - n_pre)
    return np.asarray(rollout.roll(segments, vector(PELICAN, values)[None], start, n_pre=n_pre)[0][0, 0, :, :, 0])


def filtered(signal: FloatArray, fine: float, cutoff: float) -> FloatArray:
    """Second-order Butterworth filter of a finely sampled signal, by SciPy."""
    b, a = butter(2, 2.0 * np.pi * cutoff, analog=True)
    t = fine * np.arange(len(signal))
    start = signal[0]
    return np.column_stack([lsim((b, a), column - s, t)[1] + s for column, s in zip(signal.T, start, strict=True)])


@pytest.mark.parametrize(("cutoff", "gyro", "accel"), [(4.0, 1e-4, 1e-3), (8.0, 1e-4, 1e-3), (25.0, 1e-4, 1e-3)])
def test_imu_lag_is_scipys_butterworth(cutoff: float, gyro: float, accel: float) -> None:
    """The filter sees a rate that is linear between samples, a force that is linear over their halves."""
    parts = 20
    t = flight().given.t
    fine = np.arange(t[1], t[-2] + 1e-9, DT / parts)
    rate = filtered(flight().at(fine)[:, RATE], DT / parts, cutoff)[::parts]
    force = filtered(flight().mean_force(fine, DT), DT / parts, cutoff)[::parts]
    nothing = np.full((1, 3), np.nan)
    window = flight().window(
        gyro=np.concatenate([nothing, rate, nothing]), accel=np.concatenate([nothing, force, nothing])
    )
    settled = slice(round(2.0 / cutoff / DT), -1)
    found = residuals(window, {"imu_lag.period": 1.0 / cutoff})[settled]
    assert np.abs(found[:, GYRO]).max() < gyro
    assert np.abs(found[:, ACCEL]).max() < accel
    raw = residuals(window, {})[settled]
    assert np.abs(raw[:, GYRO]).max() > 20.0 * gyro
    assert np.abs(raw[:, ACCEL]).max() > 20.0 * accel
    assert np.abs(found[:, ATTITUDE]).max() < 1e-6, "the attitude does not pass that filter"


@pytest.mark.parametrize("delay", [0.004, 0.01, 0.0237, 0.12])
def test_attitude_delay(delay: float) -> None:
    t = flight().given.t
    late = quaternion(flight().at(np.maximum(t - delay, 0.0))[:, EULER])
    found = residuals(flight().window(attitude=late), {"attitude_delay.delay": delay}, n_pre=14)
    assert np.abs(found[:, ATTITUDE]).max() < 1e-5
    assert np.abs(found[:, GYRO]).max() < 1e-6
    assert np.abs(residuals(flight().window(attitude=late), {}, n_pre=14)[:, ATTITUDE]).max() > 2e-3


def test_imu_statics() -> None:
    """Contract: turned by the mounting, then scaled, then biased; the accelerometer has no scale."""
    turn = np.array([0.2, -0.35, 0.15])
    scale, gyro_bias, accel_bias = (
        np.array([0.03, -0.02, 0.05]),
        np.array([0.02, -0.03, 0.01]),
        np.array([0.3, -0.2, 0.1]),
    )
    mounting = Rotation.from_rotvec(turn).as_matrix()
    clean = flight().window()
    assert clean.gyro is not None
    assert clean.accel is not None
    window = flight().window(
        gyro=(clean.gyro @ mounting.T) * (1.0 + scale) + gyro_bias, accel=clean.accel @ mounting.T + accel_bias
    )
    effects = {
        f"{name}.{axis}": float(value)
        for name, values in (
            ("imu_misalignment", turn),
            ("gyro_scale", scale),
            ("gyro_bias", gyro_bias),
            ("accel_bias", accel_bias),
        )
        for axis, value in zip("xyz", values, strict=True)
    }
    found = residuals(window, effects)
    assert np.abs(found[:, GYRO]).max() < 1e-6
    assert np.abs(found[:, ACCEL]).max() < 1e-6


def test_scale_of_the_velocity() -> None:
    """Logged is (1 + horizontal) (north, east), (1 + vertical) down; position and all else stay."""
    clean = flight().window()
    assert clean.velocity is not None
    window = flight().window(velocity=clean.velocity * [1.1, 1.1, 0.95])
    found = residuals(window, {"velocity_scale.horizontal": 0.1, "velocity_scale.vertical": -0.05})
    assert np.abs(found - residuals(clean, {})).max() < 1e-6
    assert np.abs(residuals(window, {})[:, VELOCITY]).max() > 1e-2


def test_small_misalignments_are_smooth() -> None:
    """The rotation's formula changes to its series below 0.01 rad."""
    window = flight().window()
    below, above = (
        residuals(window, {"imu_misalignment.y": angle}) for angle in (0.01 * (1.0 - 1e-9), 0.01 * (1.0 + 1e-9))
    )
    assert np.abs(below - above).max() < 1e-9


@pytest.mark.parametrize(("k", "share"), [(0.3, 3e-4), (2.0, 5e-4)])
def test_ahrs_acceleration_error_is_a_complementary_filter(k: float, share: float) -> None:
    """Mahony's filter: q' = q (nu + k n x d) / 2, n = -f / |f|, d the filter's down; right at the first scored row."""
    t = flight().given.t
    first = 2

    def rhs(now: float, q: FloatArray) -> FloatArray:
        y = flight().at(np.array([now]))[0]
        f = flight().mean_force(np.array([now]), 2e-4)[0]
        down = Rotation.from_quat(q).as_matrix()[2]
        w = y[RATE] + k * np.cross(-f / np.linalg.norm(f), down)
        return 0.5 * np.append(q[3] * w + np.cross(q[:3], w), -q[:3] @ w)

    start = quaternion(flight().at(t[first : first + 1])[:, EULER])[0, [1, 2, 3, 0]]
    solved = solve_ivp(rhs, (t[first], t[-2]), start, t_eval=t[first:-1], rtol=1e-7, atol=1e-7, max_step=0.02)
    tilted = np.array(flight().window().attitude)
    tilted[first:-1] = (solved.y / np.linalg.norm(solved.y, axis=0)).T[:, [3, 0, 1, 2]]
    window = flight().window(attitude=tilted)
    error = np.abs(residuals(window, {})[:, ATTITUDE]).max()
    found = np.abs(residuals(window, {"ahrs_acceleration_error.k": k})[:, ATTITUDE]).max()
    assert error > 0.02
    assert found < share * error


def test_at_rest_the_ahrs_error_decays_at_its_gain() -> None:
    """Hovering level, the tilt error of a filter that starts 0 stays 0."""
    n = 60
    level, zero = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), np.zeros((n, 3))
    window = Window(0.0, DT, np.full((n, 4), PELICAN.hover_speed()), gyro=zero, attitude=level)
    start = np.zeros((1, 13))
    start[0, 0] = 1.0
    theta = vector(PELICAN, values_of(PELICAN, {"ahrs_acceleration_error.k": 3.0}))
    out, _ = Rollout(window, PELICAN).roll(Segments(50, 1, np.array([1])), theta[None], start)
    assert np.abs(out[0, 0, :, ATTITUDE, 0]).max() < 1e-12
