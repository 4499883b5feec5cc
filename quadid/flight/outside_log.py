"""Outside effects that act on the log: sensors and logging software."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

from quadid.flight import sensors
from quadid.flight.loop import OnBoard, Plan, Track
from quadid.rotation import continuous_sign
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY


@dataclass
class LogRows:
    """A log about to be written, noise included.

    Attributes:
        gyro, accel, attitude: rows of the log; replaced by effects.
        steps: step numbers at which the rows were measured.
        track, plan, on_board: where they come from.
        thrust: sum of squared commanded rotor speeds over hover's, shape (rows,).
    """

    gyro: FloatArray
    accel: FloatArray
    attitude: FloatArray
    steps: FloatArray
    track: Track
    plan: Plan
    on_board: OnBoard
    thrust: FloatArray

    @property
    def t(self) -> FloatArray:
        """Times of the rows [s]."""
        return self.plan.dt * (self.steps - self.plan.first_log)


Values = Mapping[str, float]
Distort = Callable[[LogRows, Values, np.random.Generator], None]


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def vibration_rectification(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Accelerometer offset that grows with the fourth power of rotor speed, in a random direction."""
    rows.accel = rows.accel + v["shift"] * np.outer(rows.thrust**2, _direction(rng))


def gyro_g_sensitivity(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Gyro offset proportional to specific force, through a random matrix of unit spectral norm."""
    matrix = rng.standard_normal((3, 3))
    rows.gyro = rows.gyro + rows.accel @ (v["gain"] * matrix / np.linalg.norm(matrix, 2)).T


def gyro_warm_up(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Gyro offset that settles exponentially."""
    rows.gyro = rows.gyro + v["shift"] * np.outer(1.0 - np.exp(-rows.t / v["time"]), _direction(rng))


def gyro_clipping(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Saturates every gyro axis."""
    rows.gyro = np.clip(rows.gyro, -v["limit"], v["limit"])


def accel_clipping(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Saturates every accelerometer axis."""
    rows.accel = np.clip(rows.accel, -v["limit"] * GRAVITY, v["limit"] * GRAVITY)


def _reread(rows: LogRows, track: Track, steps: FloatArray) -> None:
    """Replaces what the IMU measured by what it would have measured on `track` at `steps`; the noise stays."""
    for name, read in (("gyro", sensors.read_gyro), ("accel", sensors.read_accel)):
        was = read(rows.track, rows.plan, rows.on_board, np.inf, rows.steps)
        setattr(rows, name, getattr(rows, name) + read(track, rows.plan, rows.on_board, np.inf, steps) - was)


def _resonance(signal: FloatArray, speed: float, damping: float, dt: float) -> FloatArray:
    """Passes a signal through a unit-gain second-order resonance of natural frequency `speed` [rad/s]."""
    top, bottom, _ = cont2discrete(
        (np.array([speed**2]), np.array([1.0, 2.0 * damping * speed, speed**2])), dt, method="foh"
    )
    return np.asarray(lfilter(np.ravel(top), bottom, signal - signal[0], axis=0) + signal[0])


def loose_imu(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Gyro and accelerometer ride on a lightly damped mount."""
    speed, dt = 2.0 * np.pi * v["frequency"], rows.plan.dt
    gyro = _resonance(rows.track.gyro, speed, v["damping"], dt)
    force = _resonance(np.diff(rows.track.accel, axis=0), speed, v["damping"], dt)
    track = rows.track._replace(gyro=gyro, accel=np.vstack([np.zeros(3), np.cumsum(force, axis=0)]))
    _reread(rows, track, rows.steps)


def compass_throttle(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Heading error proportional to the departure of thrust from hover."""
    half = 0.5 * v["gain"] * (rows.thrust - 1.0)
    turn = np.column_stack([np.cos(half), np.zeros_like(half), np.zeros_like(half), np.sin(half)])
    rows.attitude = sensors.quaternion_multiply(turn, rows.attitude)


def attitude_steps(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Rounds roll, pitch and yaw to multiples of a coarse step."""
    w, x, y, z = rows.attitude.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    angles = np.rint(np.column_stack([roll, pitch, yaw]) / v["step"]) * v["step"]
    zero = np.zeros(len(angles))
    parts = [sensors.quaternion_exp(np.column_stack(c)) for c in (
        (angles[:, 0], zero, zero), (zero, angles[:, 1], zero), (zero, zero, angles[:, 2]))]  # fmt: skip
    turned = sensors.quaternion_multiply(sensors.quaternion_multiply(parts[2], parts[1]), parts[0])
    rows.attitude = continuous_sign(turned)


def clock_jitter(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Measures gyro, accelerometer and attitude at instants scattered about the stamped ones."""
    steps = rows.steps + np.clip(rng.normal(0.0, v["sigma"], len(rows.steps)), -0.01, 0.01) / rows.plan.dt
    before, after = sensors.attitude_at(rows.track, rows.steps), sensors.attitude_at(rows.track, steps)
    step = sensors.quaternion_multiply(before * np.array([1.0, -1.0, -1.0, -1.0]), after)
    rows.attitude = continuous_sign(sensors.quaternion_multiply(rows.attitude, step))
    _reread(rows, rows.track, steps)


def repeated_rows(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Repeats the sensor row before at random rows."""
    fresh = rng.random(len(rows.steps)) >= min(v["probability"], 0.9)
    fresh[0] = True
    source = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))
    rows.gyro, rows.accel, rows.attitude = rows.gyro[source], rows.accel[source], rows.attitude[source]


def gyro_spikes(rows: LogRows, v: Values, rng: np.random.Generator) -> None:
    """Adds a large error of random direction to single gyro rows."""
    hit = rng.random(len(rows.steps)) < v["probability"]
    gyro = rows.gyro.copy()
    gyro[hit] += v["size"] * rng.choice([-1.0, 1.0], (int(hit.sum()), 3)) * rng.uniform(0.5, 1.0, (int(hit.sum()), 3))
    rows.gyro = gyro
