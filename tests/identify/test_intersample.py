"""Effect of held commands within their samples: seen where a controller is faster than the log, and nowhere else."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from quadid.data.intersample import find_feedback, follow_feedback
from quadid.data.window import Window
from quadid.errors import WindowError
from quadid.flight import fly
from quadid.flight.pilot import default_gains
from quadid.identification.fit import Fit, FitOptions, fit
from quadid.identification.result import mse_score
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout, Segments
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Stabiliser, Vehicle
from tests.identify.fast_loop import EVERY, fly_fast

PELICAN = Vehicle.shipped("pelican")
KP, KD = 70.0, 14.0


@pytest.fixture(scope="module")
def fast() -> Window:
    """Two minutes under a controller at 1 kHz."""
    return fly_fast(PELICAN, 120.0, 3, KP, KD)


def test_the_inner_loop_is_read_off_a_flight(fast: Window) -> None:
    found = find_feedback([fast])
    assert found is not None
    assert abs(found.proportional - KP) < 3.0 * found.sigma[0]
    assert abs(found.derivative - KD) < 3.0 * found.sigma[1]
    assert found.sigma[0] < 0.4 * KP
    assert found.sigma[1] < 0.4 * KD


@pytest.mark.parametrize("scale", [(0.0, -0.012), (0.033, -0.007), (-0.03, -0.03)])
def test_a_wrong_scale_of_the_gyro_is_not_taken_for_feedback_of_the_angle(
    fast: Window, scale: tuple[float, float]
) -> None:
    assert fast.gyro is not None
    found = find_feedback([replace(fast, gyro=fast.gyro * [1.0 + scale[0], 1.0 + scale[1], 1.0])])
    assert found is not None
    assert abs(found.proportional - KP) < 3.0 * found.sigma[0]
    assert abs(found.proportional - KP) < KP
    assert abs(found.derivative - KD) < 3.0 * found.sigma[1]


def test_a_wrong_scale_of_the_gyro_alone_is_no_feedback() -> None:
    held = fly_fast(PELICAN, 60.0, 0, KP, KD, act_every=EVERY)
    assert held.gyro is not None
    for scale in ([0.97, 1.0, 1.0], [0.97, 0.97, 1.0]):
        assert find_feedback([replace(held, gyro=held.gyro * scale)]) is None


def test_two_windows_of_a_flight_tell_what_one_does(fast: Window) -> None:
    half = len(fast) // 2
    whole, parts = find_feedback([fast]), find_feedback([fast.slice(0, half), fast.slice(half, len(fast))])
    assert whole is not None
    assert parts is not None
    assert abs(parts.derivative - whole.derivative) < whole.sigma[1]


@pytest.mark.parametrize("seed", range(3))
def test_commands_held_like_the_log_stay_as_they_are(seed: int) -> None:
    flown = fly_fast(PELICAN, 60.0, seed, KP, KD, act_every=EVERY)
    (followed,), said = follow_feedback([flown], PELICAN)
    assert not said
    assert followed is flown


def test_rotors_that_lag_behind_hide_the_feedback() -> None:
    assert find_feedback([fly_fast(PELICAN, 60.0, 1, 40.0, 8.0, lag=0.024)]) is None


def test_readings_of_speeds_too_little_flight_or_a_stuck_gyro_show_nothing(fast: Window) -> None:
    assert find_feedback([]) is None
    assert find_feedback([replace(fast, sampling="instant")]) is None
    assert find_feedback([fast.slice(0, 900)]) is None
    assert find_feedback([replace(fast, gyro=np.zeros((len(fast), 3)))]) is None
    assert find_feedback([replace(fast, gyro=None)]) is None


def test_rows_without_gyro_hold_their_speed(fast: Window) -> None:
    gyro = np.array(fast.gyro)
    gyro[100] = np.nan
    (followed,), said = follow_feedback([replace(fast, gyro=gyro)], PELICAN)
    assert "acted faster than this log" in said
    assert followed.rotor_slope is not None
    assert np.isfinite(followed.rotor_slope).all()
    assert not followed.rotor_slope[99:101].any()
    assert followed.rotor_slope[101].any()


def test_speeds_that_follow_leave_nothing_but_noise() -> None:
    quiet = fly_fast(PELICAN, 60.0, 5, KP, KD, noise=0.1)
    (followed,), _ = follow_feedback([quiet], PELICAN)
    flat, sloped = (_error(fit([w], PELICAN, FitOptions(iterations=0)), w) for w in (quiet, followed))
    assert flat > 1.5
    assert sloped < 1.1


def _error(found: Fit, window: Window) -> float:
    """Mean square of roll, pitch and yaw over what the sensors' noise makes it."""
    channels = mse_score([window], PELICAN, found.theta).channels
    return float(np.mean([c.rmse**2 for c in channels[3:6]]) / (0.1 * 0.0012) ** 2)


def test_behind_a_lag_the_stabiliser_of_the_vehicle_file_tells_it() -> None:
    flown = fly(PELICAN, seconds=120.0, seed=7, command_rate=1000.0, effects={"motor_lag": {"tau": 0.035}})
    known = _with_stabiliser(flown.gains, 1000.0)
    (followed,), said = follow_feedback([flown.window], known)
    assert "the vehicle file's stabiliser runs at 1000 Hz" in said
    flat, sloped = (_deviations(w, flown.truth.parameters.as_dict()) for w in (flown.window, followed))
    assert np.sqrt(np.mean(flat[2:4] ** 2)) > 2.0, "J_xx and J_yy"
    assert np.sqrt(np.mean(sloped**2)) < 1.3


def test_a_stabiliser_as_fast_as_the_log_holds_its_commands(fast: Window) -> None:
    gains = default_gains(PELICAN)
    for rate in (50.0, None):
        known = _with_stabiliser(gains, rate)
        (followed,), said = follow_feedback([replace(fast, gyro=np.zeros((len(fast), 3)))], known)
        assert not said
        assert followed.rotor_slope is None


def _with_stabiliser(gains: Mapping[str, float], rate: float | None) -> Vehicle:
    return PELICAN.model_copy(update={"stabiliser": Stabiliser(gains=dict(gains), rate=rate)})


def _deviations(window: Window, truth: Mapping[str, float]) -> FloatArray:
    """Errors of the six and of the motor lag, in standard deviations that noise alone makes."""
    found = fit([window], PELICAN, FitOptions(iterations=0), names=[*NOMINAL_NAMES, "motor_lag.tau"])
    wider = found.uncertainty.sigma / found.uncertainty.from_noise
    six = (np.log(found.theta[:6]) - np.log([truth[n] for n in NOMINAL_NAMES])) / found.uncertainty.from_noise[:6]
    lag = found.parameters["motor_lag.tau"]
    return np.append(six, (lag.value - 0.035) / lag.sigma * wider[6])


@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (0.0, 0.03), (0.027, 0.0), (0.0052, 0.02)])
def test_a_slope_does_what_finer_rows_do(delay: float, lag: float) -> None:
    parts, n, dt = 16, 60, 0.02
    rng = np.random.default_rng(2)
    rows = 500.0 + 40.0 * rng.standard_normal((n, 4))
    slope = 1500.0 * rng.standard_normal((n, 4))
    rows[:3], slope[:3] = 500.0, 0.0
    theta = Layout(PELICAN).initial(PELICAN)
    theta[Layout(PELICAN).entry("command_delay.delay").index] = delay
    theta[Layout(PELICAN).entry("motor_lag.tau").index] = lag

    offsets = dt * ((np.arange(parts) + 0.5) / parts - 0.5)[:, None]
    flat_fine = np.repeat(rows, parts, axis=0)
    sloped_fine = flat_fine + np.repeat(slope, parts, axis=0) * np.tile(offsets, (n, 1))
    coarse = _roll(replace(_still(rows, dt), rotor_slope=slope), theta) - _roll(_still(rows, dt), theta)
    fine = _roll(_still(sloped_fine, dt / parts), theta) - _roll(_still(flat_fine, dt / parts), theta)
    expected = fine[parts - 1 :: parts][: len(coarse), :6]
    assert np.abs(coarse[:, :6] - expected).max() < 0.02 * np.abs(expected).max()


def _still(rows: FloatArray, dt: float) -> Window:
    n = len(rows)
    return Window(0.0, dt, rows, np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), np.zeros((n, 3)))


def _roll(window: Window, theta: FloatArray) -> FloatArray:
    """States against measurements of rest, one row a sample."""
    start = np.zeros((1, 13))
    start[0, 0] = 1.0
    length = len(window) - 2
    out, _ = Rollout(window, PELICAN).roll(Segments(length, 1, np.array([1])), theta[None], start)
    return np.asarray(out[0, 0, :, :, 0])


def test_a_slope_goes_with_held_speeds_only_and_is_cut_with_them() -> None:
    rows = np.full((5, 4), 500.0)
    window = Window(0.0, 0.02, rows, rotor_slope=np.arange(20.0).reshape(5, 4))
    cut = window.slice(2, 4).rotor_slope
    assert cut is not None
    np.testing.assert_array_equal(cut, np.arange(8.0, 16.0).reshape(2, 4))
    with pytest.raises(WindowError, match="rotor_slope with sampling 'instant'"):
        replace(window, sampling="instant")
    with pytest.raises(WindowError, match="rotor_slope"):
        replace(window, rotor_slope=np.full((5, 4), np.nan))
    with pytest.raises(WindowError, match="rotor_slope"):
        replace(window, rotor_slope=np.zeros((4, 4)))
