"""Hovering vehicles in balance, by equations of their own: what each rotor must turn, given what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadid.vehicle import Vehicle
from quadid.window import Channel, Recording

FloatArray = NDArray[np.float64]
G = 9.80665


class Wrong(NamedTuple):
    """What is wrong: loss of thrust and of drag torque by rotor (from 1), added mass [kg] and where [m], effort."""

    loss: Mapping[int, float] = {}
    drag_loss: Mapping[int, float] = {}
    mass: float = 0.0
    place: tuple[float, float] = (0.0, 0.0)
    effort: float = 0.0


def squared_speeds(vehicle: Vehicle, wrong: Wrong, imbalance: FloatArray) -> FloatArray:
    """Squares of the rotor speeds that balance weight and moments, shape (rotors,).

    Args:
        vehicle: whose b and d are taken for true.
        wrong: what is wrong.
        imbalance: relative thrust of each healthy rotor beyond the mean, shape (rotors,).
    """
    n = len(vehicle.rotors)
    b, d = vehicle.parameters["b"].initial, vehicle.parameters["d"].initial
    thrust = b * (1.0 + imbalance) * (1.0 - np.array([wrong.loss.get(j + 1, 0.0) for j in range(n)]))
    drag = d * (1.0 + imbalance) * (1.0 - np.array([wrong.drag_loss.get(j + 1, 0.0) for j in range(n)]))
    x, y = vehicle.rotor_positions[:, 0], vehicle.rotor_positions[:, 1]
    weight, added = vehicle.mass * G, wrong.mass * G
    # Forces up, moments about the centre: those of thrust balance those of the added weight.
    demands = np.array([weight + added, added * wrong.place[1], added * wrong.place[0], 0.0])
    rows = np.stack([thrust, thrust * y, thrust * x, drag * vehicle.spins])
    return np.asarray(np.linalg.lstsq(rows, demands, rcond=None)[0] * (1.0 + wrong.effort))


def hover(
    vehicle: Vehicle, wrong: Wrong | None = None, seed: int = 0, spread: float = 0.01, seconds: float = 20.0
) -> Recording:
    """A log of a hover at 50 Hz: rotors and accelerometer, on the ground for 2 s before and after.

    Args:
        vehicle: what hovers.
        wrong: what is wrong with it.
        seed: of noise and of what differs from flight to flight.
        spread: standard deviation of each rotor's thrust from flight to flight, relative.
        seconds: in the air.
    """
    rng = np.random.default_rng(seed)
    own = np.random.default_rng(99).normal(0.0, 0.03, len(vehicle.rotors))  # this vehicle's rotors differ for good
    wrong = Wrong() if wrong is None else wrong
    level = squared_speeds(vehicle, wrong, own + spread * rng.normal(size=len(own))) * (1.0 + 0.01 * rng.normal())
    t = np.arange(0.0, seconds + 4.0, 0.02)
    flying = (t >= 2.0) & (t < seconds + 2.0)
    wobble = 1.0 + 0.02 * rng.normal(size=(len(t), len(own)))
    speed = np.sqrt(np.maximum(np.where(flying[:, None], level * wobble, 0.0), 0.0))
    accel = np.tile([0.0, 0.0, -G], (len(t), 1)) + 0.2 * rng.normal(size=(len(t), 3))
    channels = {
        "rotor_speed": Channel("rotor_speed", t, speed, "simulated"),
        "accel": Channel("accel", t, accel, "simulated"),
    }
    return Recording(f"hover_{seed}", "simulated", channels)
