"""Measured and logged signals: noise, vibration, telemetry filters, sampling at the log rate.

Gyro, attitude, velocity and position are instants at t; acceleration is the mean over one sample centred on t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, cont2discrete, lfilter, lfiltic

from quadid.flight.loop import OnBoard, Plan, Track
from quadid.types import FloatArray


@dataclass(frozen=True)
class SensorNoise:
    """One-sigma noise of MEMS sensors on a small multirotor.

    Attributes:
        gyro: white, a sample [rad/s].
        accel: white, on the mean over a 20 ms sample [m/s^2].
        attitude: white [rad] per axis.
        attitude_slow: slowly coloured [rad] per axis, correlation time `attitude_time` [s] (first-order Gauss-Markov).
        gyro_shake, accel_shake: rms of vibration at rotor frequency in hover [rad/s], [m/s^2], before sampling.
        velocity [m/s], position [m], battery [V]: white.
    """

    gyro: float = 0.02
    accel: float = 0.2
    attitude: float = 0.003
    attitude_slow: float = 0.004
    attitude_time: float = 1.0
    gyro_shake: float = 0.005
    accel_shake: float = 0.5
    velocity: float = 0.05
    position: float = 0.02
    battery: float = 0.02

    def scaled(self, factor: float) -> SensorNoise:
        """Returns the same noise `factor` times as large."""
        return SensorNoise(
            **{name: value if name == "attitude_time" else value * factor for name, value in vars(self).items()}
        )


def coloured(rng: np.random.Generator, n: int, sigma: float, time: float, dt: float) -> FloatArray:
    """First-order Gauss-Markov noise, stationary from the first sample; shape (n, 3)."""
    pole = float(np.exp(-dt / time))
    drive = rng.standard_normal((n, 3))
    drive[1:] *= np.sqrt(1.0 - pole**2)
    return np.asarray(sigma * lfilter([1.0], [1.0, -pole], drive, axis=0))


def butterworth(signal: FloatArray, cutoff: float, dt: float) -> FloatArray:
    """Second-order Butterworth low-pass of a continuous signal known at steps of dt, linear in between (exact).

    Args:
        signal: shape (n, k); assumed constant at its first value before.
        cutoff: [Hz].
        dt: step [s].
    """
    numerator, denominator = butter(2, 2.0 * np.pi * cutoff, analog=True)
    matrix, bottom, _ = cont2discrete((numerator, denominator), dt, method="foh")
    top = np.ravel(matrix)
    columns = []
    for column in signal.T:
        start = lfiltic(top, bottom, np.full(2, column[0]), np.full(2, column[0]))
        columns.append(lfilter(top, bottom, column, zi=start)[0])
    return np.column_stack(columns)


def attitude_at(track: Track, steps: FloatArray) -> FloatArray:
    """AHRS attitude at fractional step numbers, normalised linear interpolation; shape (n, 4)."""
    steps = np.clip(steps, 0.0, len(track.attitude) - 1.0)
    low = np.minimum(np.floor(steps).astype(np.int64), len(track.attitude) - 2)
    part = (steps - low)[:, None]
    a, b = track.attitude[low], track.attitude[low + 1]
    b = np.where(np.einsum("ij,ij->i", a, b)[:, None] < 0.0, -b, b)
    q = a if not part.any() else (1.0 - part) * a + part * b
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def rows_at(values: FloatArray, steps: FloatArray) -> FloatArray:
    """Rows of `values` at fractional step numbers, linear in between."""
    steps = np.clip(steps, 0.0, len(values) - 1.0)
    low = np.minimum(np.floor(steps).astype(np.int64), len(values) - 2)
    part = (steps - low)[:, None]
    return values[low] if not part.any() else (1.0 - part) * values[low] + part * values[low + 1]


def log_steps(plan: Plan) -> FloatArray:
    """Step numbers of the log rows, as floats."""
    return plan.first_log + plan.log_every * np.arange(plan.rows, dtype=np.float64)


def read_gyro(track: Track, plan: Plan, on_board: OnBoard, cutoff: float, steps: FloatArray) -> FloatArray:
    """Gyro without white noise at the given steps, shape (rows, 3) [rad/s]."""
    rates = butterworth(track.gyro, cutoff, plan.dt) if np.isfinite(cutoff) else track.gyro
    return np.asarray(rows_at(rates, steps) @ on_board.gyro_matrix.T + on_board.gyro_bias)


def read_accel(track: Track, plan: Plan, on_board: OnBoard, cutoff: float, steps: FloatArray) -> FloatArray:
    """Accelerometer without white noise: mean over one sample centred on the given steps, shape (rows, 3) [m/s^2]."""
    running = track.accel
    if np.isfinite(cutoff):
        filtered = butterworth(np.diff(running, axis=0), cutoff, plan.dt)
        running = np.vstack([np.zeros(3), np.cumsum(filtered, axis=0)])
    half = 0.5 * plan.log_every
    mean = (rows_at(running, steps + half) - rows_at(running, steps - half)) / (plan.log_every * plan.dt)
    return np.asarray(mean @ on_board.accel_matrix.T + on_board.accel_bias)
