"""Output error as MATLAB's `nlgreyest` does it, on scipy: one simulation of the whole flight, least squares.

Rates are simulated from an estimated initial rate, held rotor speeds driving the rigid body; the specific force along z
follows from thrust.  Residuals are divided by the sensors' noise; intervals come from the Jacobian.  The equations are
written out here, so that nothing of ours is used.  The attitude is not an output: its drift over a flight would rule.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

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


@dataclass(frozen=True)
class _Inputs:
    """Of one flight, a row a sample: b-, d- and J_r-free inputs, measured rates and specific force along z."""

    dt: float
    mass: float
    square: FloatArray
    roll: FloatArray
    pitch: FloatArray
    yaw: FloatArray
    total: FloatArray
    gyro: FloatArray
    force: FloatArray

    @classmethod
    def of(cls, window: Window, vehicle: Vehicle) -> _Inputs:
        assert window.gyro is not None
        assert window.accel is not None
        speed, spins = window.rotor_speed, np.array([rotor.spin for rotor in vehicle.rotors])
        x, y, _ = vehicle.rotor_positions.T
        squares = speed**2
        return cls(
            window.dt,
            vehicle.mass,
            squares.sum(axis=1),
            -squares @ y,
            squares @ x,
            squares @ spins,
            speed @ spins,
            window.gyro,
            window.accel[:, 2],
        )

    def outputs(self, many: FloatArray) -> FloatArray:
        """Rates and specific force for several parameter vectors at once, shape (vectors, samples, 4)."""
        b, d, j_xx, j_yy, j_zz, j_r = np.exp(many[:, :6].T)
        rate = many[:, 6:].copy()
        out = np.empty((len(many), len(self.gyro), 4))
        out[:, :, 3] = -b[:, None] * self.square / self.mass

        def turning(w: FloatArray, k: int) -> FloatArray:
            p, q, r = w.T
            return np.column_stack(
                [
                    ((j_yy - j_zz) * q * r + b * self.roll[k] + j_r * self.total[k] * q) / j_xx,
                    ((j_zz - j_xx) * p * r + b * self.pitch[k] - j_r * self.total[k] * p) / j_yy,
                    ((j_xx - j_yy) * p * q + d * self.yaw[k]) / j_zz,
                ]
            )

        for k in range(len(self.gyro)):
            out[:, k, :3] = rate
            first = turning(rate, k)
            middle = turning(rate + 0.5 * self.dt * first, k)
            again = turning(rate + 0.5 * self.dt * middle, k)
            last = turning(rate + self.dt * again, k)
            rate = rate + self.dt / 6.0 * (first + 2.0 * middle + 2.0 * again + last)
        return out


def identify(window: Window, vehicle: Vehicle, noise: tuple[float, float, float] = NOISE) -> Answer:
    """Estimates the nominal parameters (their logarithms) of one flight.

    Args:
        noise: standard deviations of gyro [rad/s] and accelerometer [m/s^2]; the third is not used.
    """
    begin = time.process_time()
    inputs = _Inputs.of(window, vehicle)
    measured = np.column_stack([inputs.gyro, inputs.force])
    sigma = np.array([noise[0]] * 3 + [noise[1]])

    def residuals(many: FloatArray) -> FloatArray:
        return ((inputs.outputs(many) - measured) / sigma).reshape(len(many), -1)

    def slope(x: FloatArray) -> FloatArray:
        steps = NUDGE * np.eye(len(x))
        return ((residuals(x + steps) - residuals(x - steps)) / (2.0 * NUDGE)).T

    logs = np.log([vehicle.parameters[name].initial for name in NOMINAL_NAMES])
    start = np.concatenate([logs, inputs.gyro[0]])
    reach = np.concatenate([np.full(len(logs), np.log(FACTOR)), np.full(3, 10.0)])
    found = least_squares(
        lambda x: residuals(x[None])[0], start, slope, bounds=(start - reach, start + reach), x_scale="jac"
    )
    left = 2.0 * found.cost / (len(found.fun) - len(found.x))
    covariance = left * np.linalg.pinv(found.jac.T @ found.jac)
    half = 1.96 * np.sqrt(np.diag(covariance))
    return Answer(found.x[: len(logs)], half[: len(logs)], time.process_time() - begin)
