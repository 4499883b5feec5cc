"""Output error as MATLAB's `nlgreyest` does it, on scipy: one simulation of the whole flight, least squares.

Rates are simulated from an estimated initial rate, held rotor speeds driving the rigid body; the specific force along z
follows from thrust.  Residuals are divided by the sensors' noise; intervals come from the Jacobian.  The equations are
written out here, so that nothing of ours is used.  The attitude is not an output: its drift over a flight would rule.
"""

import time

import numpy as np
from scipy.optimize import least_squares

from quadid.data.window import Window
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.peers.mujoco_sysid import NOISE, Answer

FACTOR = 4.0
"""Bounds, as factors of the guess."""
NUDGE = 1e-5
"""Step of the Jacobian's differences."""


def outputs(window: Window, vehicle: Vehicle, many: FloatArray) -> FloatArray:
    """Rates and specific force along z of a flight for several vectors at once, shape (vectors, samples, 4).

    Args:
        many: logarithms of the parameters, then the initial rate [rad/s], shape (vectors, 9).
    """
    b, d, j_xx, j_yy, j_zz, j_r = np.exp(many[:, :6].T)
    square, (x, y, _) = window.rotor_speed**2, vehicle.rotor_positions.T
    roll, pitch, yaw, total = -square @ y, square @ x, square @ vehicle.spins, window.rotor_speed @ vehicle.spins
    out, rate, dt = np.empty((len(many), len(window), 4)), many[:, 6:].copy(), window.dt
    out[:, :, 3] = -b[:, None] * square.sum(axis=1) / vehicle.mass

    def turning(w: FloatArray, k: int) -> FloatArray:
        p, q, r = w.T
        return np.column_stack(
            [
                ((j_yy - j_zz) * q * r + b * roll[k] + j_r * total[k] * q) / j_xx,
                ((j_zz - j_xx) * p * r + b * pitch[k] - j_r * total[k] * p) / j_yy,
                ((j_xx - j_yy) * p * q + d * yaw[k]) / j_zz,
            ]
        )

    for k in range(len(window)):
        out[:, k, :3] = rate
        first = turning(rate, k)
        middle = turning(rate + 0.5 * dt * first, k)
        again = turning(rate + 0.5 * dt * middle, k)
        last = turning(rate + dt * again, k)
        rate = rate + dt / 6.0 * (first + 2.0 * middle + 2.0 * again + last)
    return out


def identify(window: Window, vehicle: Vehicle, noise: tuple[float, float, float] = NOISE) -> Answer:
    """Estimates the nominal parameters (their logarithms) of one flight.

    Args:
        noise: standard deviations of gyro [rad/s] and accelerometer [m/s^2]; the third is not used.
    """
    begin = time.process_time()
    assert window.gyro is not None
    assert window.accel is not None
    measured = np.column_stack([window.gyro, window.accel[:, 2]])
    sigma = np.array([noise[0]] * 3 + [noise[1]])

    def residuals(many: FloatArray) -> FloatArray:
        return ((outputs(window, vehicle, many) - measured) / sigma).reshape(len(many), -1)

    def slope(x: FloatArray) -> FloatArray:
        steps = NUDGE * np.eye(len(x))
        return ((residuals(x + steps) - residuals(x - steps)) / (2.0 * NUDGE)).T

    logs = np.log([vehicle.parameters[name].initial for name in NOMINAL_NAMES])
    start = np.concatenate([logs, window.gyro[0]])
    reach = np.concatenate([np.full(len(logs), np.log(FACTOR)), np.full(3, 10.0)])
    found = least_squares(
        lambda x: residuals(x[None])[0], start, slope, bounds=(start - reach, start + reach), x_scale="jac"
    )
    left = 2.0 * found.cost / (len(found.fun) - len(found.x))
    covariance = left * np.linalg.pinv(found.jac.T @ found.jac)
    half = 1.96 * np.sqrt(np.diag(covariance))
    return Answer(found.x[: len(logs)], half[: len(logs)], time.process_time() - begin)
