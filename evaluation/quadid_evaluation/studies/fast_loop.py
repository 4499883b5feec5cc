"""A quadcopter under a stabiliser faster than its log, with random moments, of its study alone.

Rotation only, at hover thrust.  The stabiliser reads a noisy gyro and an attitude estimator fed by the same gyro; the
log holds every tenth gyro reading and attitude, the mean of force and commands since, and noise on the speeds.
"""

import numba as nb
import numpy as np
from scipy.signal import lfilter

from quadid.data.window import Window
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

STEP = 0.002
"""Step of simulation and stabiliser [s]: 500 Hz."""
KP, KD, KYAW = 60.0, 13.0, 4.0
"""Feedback of angle [1/s^2], rate [1/s], yaw rate [1/s]."""
AHRS = 0.3
"""Pull of the attitude estimator towards a noisy level [1/s]."""


@nb.njit(cache=True)
def _fly(n, every, p, mix, arms, spin, hover, wanted, gyro_noise, level_noise, moment):  # type: ignore[no-untyped-def]
    b, d, jx, jy, jz, jr = p
    q, ahrs = np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
    rate, out = np.zeros(3), np.zeros((n // every, 11))
    J, asked, speed = np.array([jx, jy, jz]), np.zeros(4), np.full(4, hover)
    for k in range(n):
        gyro = rate + gyro_noise[k]
        if k % every == 0:
            out[k // every, :3], out[k // every, 3:7] = gyro, ahrs
        lean = ahrs[1:3] * 2.0 * np.sign(ahrs[0])
        asked[0] = 4.0 * b * hover**2
        asked[1] = jx * (KP * (wanted[k, 0] - lean[0]) - KD * gyro[0])
        asked[2] = jy * (KP * (wanted[k, 1] - lean[1]) - KD * gyro[1])
        asked[3] = jz * KYAW * (wanted[k, 2] - gyro[2])
        speed = np.sqrt(np.maximum(mix @ asked, 0.04 * hover**2))
        out[k // every, 7:11] += speed / every
        square = speed**2
        torque = np.array(
            [-b * np.sum(arms[:, 1] * square), b * np.sum(arms[:, 0] * square), d * np.sum(spin * square)]
        )
        total = jr * np.sum(spin * speed)
        first = _turn(rate, torque, total, J) + moment[k]
        middle = rate + 0.5 * STEP * first
        rate = rate + STEP * (_turn(middle, torque, total, J) + moment[k])
        q = _rotated(q, middle * STEP)
        # The estimator turns by the gyro, and a little towards a level that is noisy.
        error = _between(ahrs, q) + level_noise[k]
        ahrs = _rotated(ahrs, (gyro + AHRS * error) * STEP)
    return out


@nb.njit(cache=True)
def _turn(w, torque, total, J):  # type: ignore[no-untyped-def]
    gyroscopic = np.array([total * w[1], -total * w[0], 0.0])
    coupled = np.array([(J[1] - J[2]) * w[1] * w[2], (J[2] - J[0]) * w[0] * w[2], (J[0] - J[1]) * w[0] * w[1]])
    return (torque + gyroscopic + coupled) / J


@nb.njit(cache=True)
def _product(a, b):  # type: ignore[no-untyped-def]
    return np.array(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


@nb.njit(cache=True)
def _rotated(q, turn):  # type: ignore[no-untyped-def]
    out = _product(q, np.array([1.0, 0.5 * turn[0], 0.5 * turn[1], 0.5 * turn[2]]))
    return out / np.sqrt(np.sum(out**2))


@nb.njit(cache=True)
def _between(a, b):  # type: ignore[no-untyped-def]
    c = _product(np.array([a[0], -a[1], -a[2], -a[3]]), b)
    return 2.0 * np.sign(c[0]) * c[1:]


def gauss_markov(rng: np.random.Generator, n: int, sigma: FloatArray, time: float, step: float = STEP) -> FloatArray:
    """A Gauss-Markov process that begins as it goes on, (n, axes): of deviations `sigma`, correlated for `time` [s]."""
    keep, first = np.exp(-step / time), rng.standard_normal(len(sigma))
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal((n, len(sigma)))
    drive[0] = first
    return np.asarray(sigma * lfilter([1.0], [1.0, -keep], drive, axis=0))


def fly(
    vehicle: Vehicle,
    seconds: float,
    seed: int,
    every: int = 10,
    share: float = 0.2,
    time: float = 0.3,
    gyro: float = 0.01,
    speed: float = 0.005,
) -> Window:
    """One flight with the guess of the vehicle file as truth.

    Args:
        seed: of references, moments and noise.
        every: steps of 2 ms a row of the log.
        share: random moments, as a share of the control moment.
        time: their correlation time [s].
        gyro: noise of each reading at 500 Hz [rad/s].
        speed: noise of a logged speed, as a share of hover.
    """
    n, rng = round(seconds / STEP / every) * every, np.random.default_rng(seed)
    p = vehicle.initial
    x, y = vehicle.rotor_positions[:, :2].T
    hover = vehicle.hover_speed()
    mix = np.linalg.inv(np.array([p[0] * np.ones(4), -p[0] * y, p[0] * x, p[1] * vehicle.spins]))
    hold = round(0.4 / STEP)
    wanted = np.repeat(rng.uniform(-1.0, 1.0, (n // hold + 1, 3)), hold, axis=0)[:n] * [0.3, 0.3, 0.8]
    moment = gauss_markov(rng, n, share * np.array([7.0, 7.0, 0.8]), time)
    level = gauss_markov(rng, n, np.full(3, 0.02), 0.5)
    noise = gyro * rng.standard_normal((n, 3))
    out = _fly(n, every, p, mix, vehicle.rotor_positions, vehicle.spins, hover, wanted, noise, level, moment)
    rows = len(out)
    force = 0.15 * rng.standard_normal((rows, 3)) - [0.0, 0.0, GRAVITY]
    logged = out[:, 7:] + speed * hover * rng.standard_normal((rows, 4))
    return Window(0.0, every * STEP, logged, gyro=out[:, :3], attitude=out[:, 3:7], accel=force)
