"""Every second row of a flight: what it holds, and what it says of inputs that run on within a row."""

from dataclasses import replace

import numpy as np
import pytest

from quadid.data.window import Window
from quadid.flight import draw_truth, fly
from quadid.identification.fit import Fit, FitOptions, fit
from quadid.identification.uncertainty import coarse
from quadid.parameters import NOMINAL_NAMES, Status
from quadid.types import FloatArray
from tests.identify.flights import PELICAN, guessed, values_of

LATE = {"command_delay": {"delay": 0.027}}
"""Behind a delay nothing in the motion tells what the commands did within their samples."""


def test_instants_are_every_second_row_and_forces_means_over_the_longer_ones() -> None:
    t = 0.02 * np.arange(101)
    wave = np.column_stack([np.sin(3.0 * t), np.cos(2.0 * t), t])
    window = Window(1.0, 0.02, np.full((101, 4), 400.0), gyro=wave, accel=wave)
    half = coarse(window)
    np.testing.assert_array_equal(half.t, window.t[:100:2])
    np.testing.assert_array_equal(half.gyro, wave[:100:2])
    np.testing.assert_allclose(half.accel[1:], 0.25 * wave[1:98:2] + 0.5 * wave[2:99:2] + 0.25 * wave[3:100:2])  # type: ignore[index]


def test_readings_keep_their_slow_part_and_lose_what_turns_too_fast_for_every_second_one() -> None:
    """It would come back as slow motion: 20 Hz of readings at 50 Hz as 5 Hz of those at 25 Hz."""
    t = 0.02 * np.arange(200)
    slow, fast = 20.0 * np.sin(6.0 * t), 20.0 * np.sin(2.0 * np.pi * 20.0 * t)
    for extra, left in ((0.0 * t, slow), (fast, slow)):
        speed, rate = (400.0 + slow + extra)[:, None] * np.ones(4), 0.01 * (slow + extra)[:, None] * np.ones(3)
        half = coarse(Window(0.0, 0.02, speed, gyro=rate, sampling="instant"))
        assert half.gyro is not None
        np.testing.assert_allclose(half.gyro[5:-5, 0], 0.01 * left[10:-10:2], atol=2e-3)
        np.testing.assert_allclose(half.rotor_speed[5:-5, 0], 400.0 + left[10:-10:2], atol=0.6)


def test_held_speeds_keep_their_thrust_and_a_straight_line_its_slope() -> None:
    jump = np.repeat([[400.0], [500.0]], 4, axis=1)
    half = coarse(Window(0.0, 0.02, np.tile(jump, (10, 1)), gyro=np.zeros((20, 3))))
    np.testing.assert_allclose(half.rotor_speed**2, np.full((10, 4), 0.5 * (400.0**2 + 500.0**2)))
    assert half.rotor_slope is None
    ramp = 400.0 + 30.0 * 0.02 * (np.arange(20.0)[:, None] + 0.5) * np.ones(4)
    line = Window(0.0, 0.02, ramp, gyro=np.zeros((20, 3)), rotor_slope=np.full((20, 4), 30.0))
    np.testing.assert_allclose(coarse(line).rotor_slope, np.full((10, 4), 30.0))  # type: ignore[arg-type]


@pytest.mark.parametrize("first", [0, 1])
def test_channels_at_half_the_rate_of_the_rows_stay_wherever_they_lie(first: int) -> None:
    """A motion at constant velocity and rate about z."""
    t = 0.02 * np.arange(100)
    line, angle = np.column_stack([3.0 * t, -t, 1.0 + t]), 0.5 * 6.0 * t
    turn = np.column_stack([np.cos(angle), 0.0 * t, 0.0 * t, np.sin(angle)])
    slow = {"velocity": line, "position": line, "accel": line, "attitude": turn}
    seen = {name: np.where((np.arange(100) % 2 == first)[:, None], values, np.nan) for name, values in slow.items()}
    half = coarse(Window(0.0, 0.02, np.full((100, 4), 400.0), gyro=np.zeros((100, 3)), **seen))  # type: ignore[arg-type]
    for name, values in slow.items():
        np.testing.assert_allclose(getattr(half, name)[1:], values[2::2], atol=1e-12, err_msg=name)


def test_a_velocity_in_the_odd_rows_alone_is_compared_too() -> None:
    """25 Hz on a grid of 50 Hz: every second row had no velocity, and other parameters."""
    window = fly(PELICAN, seconds=30.0, seed=5, extras=("velocity",)).window
    assert window.velocity is not None
    odd = np.where((np.arange(len(window)) % 2 == 1)[:, None], window.velocity, np.nan)
    found = fit([replace(window, velocity=odd)], PELICAN, FitOptions(iterations=0))
    assert all(p.status is Status.IDENTIFIED for p in list(found.parameters)[:5])


@pytest.fixture(scope="module")
def behind_a_delay() -> list[tuple[Fit, FloatArray]]:
    """Fits of the nominal parameters and the delay to flights whose stabiliser acts at 1 kHz, and the truth."""
    out = []
    for seed in (31, 32, 33):
        truth = draw_truth(PELICAN, seed)
        window = fly(PELICAN, truth, 120.0, seed, effects=LATE, command_rate=1000.0).window
        names = [*NOMINAL_NAMES, "command_delay.delay"]
        found = fit([replace(window, rotor_slope=None)], guessed(truth, seed), FitOptions(iterations=0), names=names)
        out.append((found, values_of(truth)))
    return out


def test_intervals_hold_what_commands_do_within_their_samples(behind_a_delay: list[tuple[Fit, FloatArray]]) -> None:
    """Noise alone explains less than half of the errors of J_xx and J_yy."""
    away = np.array([np.log(f.theta[2:4] / truth[2:4]) for f, truth in behind_a_delay])
    wide = np.array([f.uncertainty.sigma[2:4] for f, _ in behind_a_delay])
    narrow = np.array([f.uncertainty.from_noise[2:4] for f, _ in behind_a_delay])
    assert np.sqrt(np.mean((away / narrow) ** 2)) > 3.0
    assert np.sqrt(np.mean((away / wide) ** 2)) < 1.4
    assert np.all(wide < 0.005)


def test_all_but_the_inertia_of_rotors_stay_identified(behind_a_delay: list[tuple[Fit, FloatArray]]) -> None:
    """A lag, fitted along, hides what a rotor's acceleration does."""
    assert {p.status for f, _ in behind_a_delay for p in list(f.parameters)[:5]} == {Status.IDENTIFIED}
