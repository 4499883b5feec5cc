"""Errors of the estimates of a fit if a doubt about a log is right.

With believed (') and true numbers in b'S'/m' = bS/m (S: sum of the squared speeds), J' s dw/dt = b' tau' + gyroscopic
terms, and J dw/dt = b tau + the same ones (tau: torque over thrust or drag; s: gyro reading over true rate).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

Off = dict[str, float]
"""Natural logarithm of estimate over truth by parameter."""


def estimates_off(
    mass: float = 1.0,
    thrust: float = 1.0,
    torque: Sequence[float] = (1.0, 1.0, 1.0),
    spinning: float = 1.0,
    turning: Sequence[float] = (1.0, 1.0, 1.0),
) -> Off:
    """Natural logarithm of estimate over truth of the six parameters of a flat vehicle, J_zz = 2 J_xx = 2 J_yy.

    Args:
        mass: believed over true.
        thrust: true over believed sum of the squared speeds.
        torque: true over believed torque about x, y, z by a unit of thrust or drag.
        spinning: true over believed sum of the rotors' speeds with their spins.
        turning: read over true angular rate about x, y, z.
    """
    b = mass * thrust
    (x, y, z), (s_x, s_y, s_z) = torque, turning
    xx, yy = b / (x * s_x), b / (y * s_y)
    # In a turn roll and pitch show J_zz beside J_yy and J_xx (J_zz - J_yy goes as J_xx s_x / (s_y s_z)), yaw all three:
    # where these contradict each other, what moves it most; yaw shows d by J_zz.
    beside = 0.25 * (xx + yy + xx * s_x / (s_y * s_z) + yy * s_y / (s_x * s_z))
    zz = max(beside, xx, yy, key=lambda ratio: abs(math.log(ratio)))
    off = (b, zz * s_z * z, xx, yy, zz, math.sqrt(xx * yy) * spinning)
    return {name: math.log(ratio) for name, ratio in zip(NOMINAL_NAMES, off, strict=True)}


def rotors_off(vehicle: Vehicle, speeds: FloatArray, true: FloatArray, other: Vehicle | None = None) -> Off:
    """The same where rotors turn at `true` speeds and not at those read [rad/s], both (n, rotors), or stand elsewhere.

    Rotors turn a vehicle by changes of their squared speeds as their true arms; what the centre of gravity makes of all
    together is fitted along.

    Args:
        other: the vehicle with its rotors where they are.
    """
    squares, turned = np.mean(speeds**2, axis=0), np.mean(true**2, axis=0)
    placed = (other or vehicle).torque_arms
    torque = np.sum(placed**2, axis=0) / np.sum((squares / turned)[:, None] * placed * vehicle.torque_arms, axis=0)
    read, spinning = speeds @ vehicle.spins, true @ vehicle.spins
    share = float(read @ spinning) / max(float(read @ read), 1e-300)
    return estimates_off(thrust=float(turned.sum() / squares.sum()), torque=torque.tolist(), spinning=max(share, 1e-3))


def farthest(offs: Iterable[Mapping[str, float]]) -> Off:
    """Of several doubts, how far each parameter is off by that which moves it most."""
    out: Off = {}
    for name, step in (item for off in offs for item in off.items()):
        out[name] = max(out.get(name, 0.0), step, key=abs)
    return out
