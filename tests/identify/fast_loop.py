"""A small quadcopter under a controller that is faster than its log: rotation only, written for these tests alone."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from quadid.data.window import Window
from quadid.vehicle import Vehicle

STEP, EVERY = 1e-3, 20
"""Step of the simulation [s], and steps of a sample of the log."""


def fly_fast(
    vehicle: Vehicle,
    seconds: float,
    seed: int,
    kp: float,
    kd: float,
    act_every: int = 1,
    lag: float = 0.0,
    noise: float = 1.0,
) -> Window:
    """Flies random attitude steps and logs at 50 Hz: gyro and attitude at instants, means of force and speeds.

    Args:
        vehicle: with its nominal parameters as truth.
        kp: feedback of the angle [1/s^2].
        kd: feedback of the rate [1/s].
        act_every: steps between two actions of the controller; `EVERY`: commands are held like the log.
        lag: time constant of the rotors behind the commands [s].
        noise: factor on the sensors' noise.
    """
    n, rng = round(seconds / STEP / EVERY), np.random.default_rng(seed)
    b, d, jx, jy, jz, jr = vehicle.initial.tolist()
    x, y = vehicle.rotor_positions[:, :2].T
    spin = vehicle.spins
    mix = np.linalg.inv(np.array([b * np.ones(4), -b * y, b * x, d * spin]))
    wanted = np.repeat(rng.uniform(-1.0, 1.0, (n // 35 + 1, 3)), 35, axis=0)[:n] * [0.35, 0.35, 1.0]
    weight = 9.80665 * vehicle.mass
    angle, rate = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    command = np.full(4, math.sqrt(weight / 4.0 / b))
    speed, logged, states, lift = command.copy(), np.empty((n, 4)), np.empty((n, 6)), np.empty(n * EVERY)
    for k in range(n):
        states[k] = [*rate, *angle]
        total = np.zeros(4)
        for i in range(EVERY):
            if (k * EVERY + i) % act_every == 0:
                pull = [kp * (wanted[k, a] - angle[a]) - kd * rate[a] for a in range(2)]
                torque = [weight, jx * pull[0], jy * pull[1], 4.0 * jz * (wanted[k, 2] - rate[2])]
                command = np.sqrt(np.maximum(mix @ torque, 1e3))
            total += command
            before = speed
            speed = command if lag == 0.0 else command + (speed - command) * math.exp(-STEP / lag)
            square = 0.5 * (before**2 + speed**2) if lag > 0.0 else speed**2
            moment = (-b * (y @ square), b * (x @ square), d * (spin @ square), jr * float(spin @ speed))
            lift[k * EVERY + i] = -b * square.sum() / vehicle.mass
            angle, rate = _step(angle, rate, moment, (jx, jy, jz))
        logged[k] = total / EVERY
    states += rng.standard_normal(states.shape) * noise * np.repeat([0.006, 0.0012], 3)
    attitude = Rotation.from_euler("ZYX", states[:, :2:-1]).as_quat()[:, [3, 0, 1, 2]]
    force = 0.1 * noise * rng.standard_normal((n, 3))
    force[1:, 2] += lift[EVERY // 2 : -(EVERY // 2)].reshape(-1, EVERY).mean(axis=1)
    force[0, 2] += lift[0]
    return Window(0.0, STEP * EVERY, logged, gyro=states[:, :3], attitude=attitude, accel=force)


def _step(
    angle: list[float], rate: list[float], moment: tuple[float, ...], inertia: tuple[float, float, float]
) -> tuple[list[float], list[float]]:
    """One step by the midpoint rule."""
    turn, spin_up = _slopes(angle, rate, moment, inertia)
    half = 0.5 * STEP
    middle = [a + half * t for a, t in zip(angle, turn, strict=True)]
    turn, spin_up = _slopes(middle, [w + half * t for w, t in zip(rate, spin_up, strict=True)], moment, inertia)
    return (
        [a + STEP * t for a, t in zip(angle, turn, strict=True)],
        [w + STEP * t for w, t in zip(rate, spin_up, strict=True)],
    )


def _slopes(
    angle: list[float], rate: list[float], moment: tuple[float, ...], inertia: tuple[float, float, float]
) -> tuple[list[float], list[float]]:
    (phi, theta, _), (p, q, r), (jx, jy, jz), (mx, my, mz, h) = angle, rate, inertia, moment
    turning = q * math.sin(phi) + r * math.cos(phi)
    turn = [p + math.tan(theta) * turning, q * math.cos(phi) - r * math.sin(phi), turning / math.cos(theta)]
    return turn, [
        (mx + (jy - jz) * q * r + h * q) / jx,
        (my + (jz - jx) * p * r - h * p) / jy,
        (mz + (jx - jy) * p * q) / jz,
    ]
