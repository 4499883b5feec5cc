"""A model-based controller on the flown truth: LQR about a flat reference, feed-forward from given parameters.

    a   = a_ref - K (integral e, e, e')                      position: LQR of a triple integrator, per axis
    F   = m (a - g) + rotor drag at v_ref                    attitude follows from F and the yaw reference
    tau = J (alpha_ref - K (e_R, e_omega)) + nu x J nu - J_r Omega_r (q, -p, 0)
    u   = omega_d (1 + tau_lag s) / (1 + tau_lag s / 3)      omega_d from F, tau through b, d and the rotor positions

The weights are the same for all; what differs are mass, b, d, inertias and, where known, lag and drag.  Mellinger and
Kumar, doi:10.1109/ICRA.2011.5980409; Lee, Leok and McClamroch, doi:10.1109/CDC.2010.5717652.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_continuous_are

from quadid.flight.airframe import PUSHES, STATES, Air, Body, Oddity, derivative, orthonormalise, rotor_wrench
from quadid.flight.jit import kernel
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY

DT, EVERY = 1e-3, 4
"""Step of the truth [s], and steps between two controls."""
CONTROL = DT * EVERY
EDGE = 10
"""Samples at either end of a path that its derivatives spoil."""
POSITION_WEIGHTS, ATTITUDE_WEIGHTS = (1.0, 20.0, 8.0), (100.0**2, 0.0)
"""LQR weights of (integral, error, rate of error) and (angle, rate); one on the input."""
LEAD = 3.0
"""The lag is made this many times shorter, no more: noise grows with it."""
NOISE = np.array([0.005] * 3 + [0.02] * 3 + [0.003] * 3 + [0.02] * 3)
"""One sigma of position [m], velocity [m/s], attitude [rad], rate [rad/s] as the controller sees them."""


class Known(NamedTuple):
    """What the controller believes: SI; lag [s] and drag [1/s] are 0 where it knows of none."""

    mass: float
    b: float
    d: float
    J: FloatArray
    J_r: float
    lag: float
    drag: FloatArray


class Reference(NamedTuple):
    """Flat reference at the control instants: position, velocity, acceleration (n, 3), yaw (n,), rates (n, 3)."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    yaw: FloatArray
    rate: FloatArray
    rate_dot: FloatArray


def gains(weights: tuple[float, ...]) -> FloatArray:
    """LQR gains of a chain of integrators as long as `weights`, unit weight on the input."""
    n = len(weights)
    a, b = np.eye(n, k=1), np.zeros((n, 1))
    b[-1] = 1.0
    p = solve_continuous_are(a, b, np.diag(weights), np.eye(1))
    return np.asarray((b.T @ p)[0])


def reference(position: FloatArray, yaw: FloatArray) -> Reference:
    """Derives velocity, acceleration, rates of a smooth path (n, 3) [m] and yaw (n,) [rad]; `EDGE` is cut off."""
    velocity = np.asarray(np.gradient(position, CONTROL, axis=0))
    acceleration = np.asarray(np.gradient(velocity, CONTROL, axis=0))
    down = np.array([0.0, 0.0, GRAVITY])
    frames = np.array([desired_frame(a - down, psi) for a, psi in zip(acceleration, yaw, strict=True)])
    turn = np.einsum("nji,njk->nik", frames[:-1], frames[1:])
    twice = [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]]
    rate = np.column_stack(twice)
    rate = np.vstack([rate, rate[-1:]]) / (2.0 * CONTROL)
    whole = (position, velocity, acceleration, yaw, rate, np.gradient(rate, CONTROL, axis=0))
    return Reference(*(np.ascontiguousarray(part[EDGE:-EDGE]) for part in whole))


@kernel
def desired_frame(force: FloatArray, yaw: float) -> FloatArray:
    """Attitude (3, 3), columns forward, right, down, whose thrust (along -z) points along `force` (3,)."""
    b3 = -force / np.sqrt(np.sum(force * force))
    c, s = np.cos(yaw), np.sin(yaw)
    b2 = np.array([-b3[2] * s, b3[2] * c, b3[0] * s - b3[1] * c])
    b2 /= np.sqrt(np.sum(b2 * b2))
    b1 = np.array([b2[1] * b3[2] - b2[2] * b3[1], b2[2] * b3[0] - b2[0] * b3[2], b2[0] * b3[1] - b2[1] * b3[0]])
    return np.column_stack((b1, b2, b3))


@kernel
def track(
    ref: Reference, known: Known, k_p: FloatArray, k_a: FloatArray, unmix: FloatArray, noise: FloatArray, tau: float,
    limit: float, efficiency: FloatArray, body: Body, air: Air, odd: Oddity,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Flies the reference; kept whole, since it reads like the block diagram.

    Args:
        ref: reference. known: what the controller believes.
        k_p, k_a: gains of position (3,) and attitude (2,).
        unmix: thrust and torque to squared speeds, as believed, shape (rotors, 4).
        noise: (n, 12). tau: true lag of the rotors [s]. limit: largest rotor speed [rad/s].
        efficiency, body, air, odd: the truth.

    Returns:
        Position (n, 3) [m] and rotor commands (n, rotors) [rad/s]; NaN after a loss of control.
    """
    n, rotors = ref.position.shape[0], unmix.shape[0]
    path, commands = np.full((n, 3), np.nan), np.full((n, rotors), np.nan)
    y, dy, wrench, push = np.zeros(STATES), np.zeros(STATES), np.zeros(7), np.zeros(PUSHES)
    y[0:3], y[3:6] = ref.position[0], ref.velocity[0]
    y[6:15] = desired_frame(ref.acceleration[0] - np.array([0.0, 0.0, GRAVITY]), ref.yaw[0]).copy().reshape(9)
    y[15:18] = ref.rate[0]
    hover = np.sqrt(body.mass * GRAVITY / (body.b * rotors))
    omega, wanted, slow, u = np.full(rotors, hover), np.full(rotors, hover), np.full(rotors, hover), np.zeros(rotors)
    soft = np.exp(-CONTROL * LEAD / known.lag) if known.lag > 0.0 else 0.0
    integral, stages = np.zeros(3), np.zeros((4, STATES))
    keep = np.exp(-DT / tau) if tau > 0.0 else 0.0
    for k in range(n):
        seen = noise[k]
        position, velocity, nu = y[0:3] + seen[0:3], y[3:6] + seen[3:6], y[15:18] + seen[9:12]
        frame = y[6:15].copy().reshape(3, 3)
        tilt = np.array([[1.0, -seen[8], seen[7]], [seen[8], 1.0, -seen[6]], [-seen[7], seen[6], 1.0]])
        frame = frame @ tilt
        error = position - ref.position[k]
        integral += error * CONTROL
        a = ref.acceleration[k] - k_p[0] * integral - k_p[1] * error - k_p[2] * (velocity - ref.velocity[k])
        force = known.mass * (a - np.array([0.0, 0.0, GRAVITY]))
        through = frame.T @ ref.velocity[k]
        for axis in range(2):
            force += known.mass * known.drag[axis] * through[axis] * frame[:, axis]
        goal = desired_frame(force, ref.yaw[k])
        turn = goal.T @ frame
        miss = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        alpha = ref.rate_dot[k] - k_a[0] * miss - k_a[1] * (nu - ref.rate[k])
        momentum = known.J * nu
        spin = np.sum(body.spins * wanted)
        torque = known.J * alpha + np.array([
            nu[1] * momentum[2] - nu[2] * momentum[1] - known.J_r * spin * nu[1],
            nu[2] * momentum[0] - nu[0] * momentum[2] + known.J_r * spin * nu[0],
            nu[0] * momentum[1] - nu[1] * momentum[0],
        ])  # fmt: skip
        thrust = -np.sum(force * frame[:, 2])
        for i in range(rotors):
            square = unmix[i, 0] * thrust + unmix[i, 1] * torque[0] + unmix[i, 2] * torque[1] + unmix[i, 3] * torque[2]
            wanted[i] = min(np.sqrt(max(square, (0.2 * hover) ** 2)), limit)
            slow[i] = wanted[i] + soft * (slow[i] - wanted[i])
            u[i] = (
                min(max(slow[i] + LEAD * (wanted[i] - slow[i]), 0.2 * hover), limit) if known.lag > 0.0 else wanted[i]
            )
        path[k], commands[k] = y[0:3], u
        if not np.isfinite(y[0]) or np.abs(error).max() > 20.0:
            path[k] = np.nan
            break
        for _ in range(EVERY):
            for i in range(rotors):
                omega[i] = u[i] + keep * (omega[i] - u[i])
            rotor_wrench(omega, efficiency, 0, body, wrench)
            for stage in range(4):
                dy[:] = 0.0
                reach = (0.0, 0.5, 0.5, 1.0)[stage] * DT
                at = y + reach * stages[stage - 1] if stage > 0 else y
                derivative(at, omega, wrench, 1.0, 1.0, 0, push, body, air, odd, dy)
                stages[stage] = dy
            y += DT / 6.0 * (stages[0] + 2.0 * stages[1] + 2.0 * stages[2] + stages[3])
            orthonormalise(y, 6)
    return path, commands
