"""Hover by the balance of forces and moments, by equations of its own: what each rotor must turn, given what is wrong.

From flight to flight every rotor's thrust differs (propellers, motors), the battery sits elsewhere and weighs
differently; within a flight the battery empties, gusts come and go.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from quadid.data.window import Block, Channel, Recording
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

G = 9.80665


class Wrong(NamedTuple):
    """Damage: loss of thrust and of drag torque by rotor (from 1), added mass [kg] and where [m], a shift of the
    CG without mass [m], effort."""

    loss: Mapping[int, float] = {}
    drag_loss: Mapping[int, float] = {}
    mass: float = 0.0
    place: tuple[float, float] = (0.0, 0.0)
    shift: tuple[float, float] = (0.0, 0.0)
    effort: float = 0.0


class Variation(NamedTuple):
    """Healthy variation, 1 sigma: between flights of each rotor's thrust, the CG [m] and the load; within a flight of
    each rotor's command from second to second (with a memory of `memory` seconds) and sag of all over an hour."""

    rotor: float = 0.01
    shift: float = 0.001
    load: float = 0.01
    second: float = 0.004
    memory: float = 3.0
    sag: float = 0.15


def squared_speeds(
    vehicle: Vehicle, wrong: Wrong, imbalance: FloatArray, load: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)
) -> FloatArray:
    """Squares of the rotor speeds that balance weight and moments, shape (rotors,).

    Args:
        imbalance: relative thrust and drag torque of each healthy rotor beyond the mean, shape (rotors,).
        load: mass beyond the vehicle's, relative.
        shift: of the healthy CG [m].
    """
    rotors = range(1, len(vehicle.rotors) + 1)
    b, d = vehicle.parameters["b"].initial, vehicle.parameters["d"].initial
    thrust = b * (1.0 + imbalance) * (1.0 - np.array([wrong.loss.get(j, 0.0) for j in rotors]))
    drag = d * (1.0 + imbalance) * (1.0 - np.array([wrong.drag_loss.get(j, 0.0) for j in rotors]))
    x, y = vehicle.rotor_positions[:, 0], vehicle.rotor_positions[:, 1]
    weight, added = vehicle.mass * G * (1.0 + load), wrong.mass * G
    moved = np.array(shift) + wrong.shift
    # Forces up, moments about the centre: those of thrust balance those of the weights.
    moments = weight * moved + added * np.array(wrong.place)
    demands = np.array([weight + added, moments[1], moments[0], 0.0])
    rows = np.stack([thrust, thrust * y, thrust * x, drag * vehicle.spins])
    return np.asarray(np.linalg.lstsq(rows, demands, rcond=None)[0] * (1.0 + wrong.effort))


def hover_seconds(
    vehicle: Vehicle,
    seconds: int,
    rng: np.random.Generator,
    variation: Variation | None = None,
    wrong: Wrong | None = None,
    onset: int = 0,
) -> Iterator[tuple[FloatArray, float]]:
    """Mean squared rotor speeds and specific force of each second of a hover.

    Args:
        wrong: what is wrong from `onset` [s] on.
    """
    how, n = Variation() if variation is None else variation, len(vehicle.rotors)
    own, load = how.rotor * rng.normal(size=n), how.load * float(rng.normal())
    x, y = how.shift * rng.normal(size=2)
    before, after = (
        squared_speeds(vehicle, state, own, load, (float(x), float(y))) for state in (Wrong(), wrong or Wrong())
    )
    t = np.arange(seconds)
    level = np.where(t[:, None] >= onset, after, before) / (1.0 - how.sag * t[:, None] / 3600.0)
    keep = float(np.exp(-1.0 / how.memory))
    driven = how.second * np.sqrt(1.0 - keep**2) * rng.normal(size=(seconds, n))
    wander = lfilter([1.0], [1.0, -keep], driven, axis=0, zi=keep * how.second * rng.normal(size=(1, n)))[0]
    force = G * (1.0 + 0.002 * rng.normal(size=seconds))
    yield from zip(level * (1.0 + wander), force.tolist(), strict=True)


def hover_blocks(
    vehicle: Vehicle,
    begin: float,
    seconds: int,
    rng: np.random.Generator,
    wrong: Wrong | None = None,
    onset: int = 0,
    rate: int = 50,
) -> Iterator[Block]:
    """Messages of a hover from `begin` [s] on, a block a second, with 6 s on the ground before and after."""
    ground = [(np.full(len(vehicle.rotors), 100.0), G)] * 6
    for k, (load, force) in enumerate([*ground, *hover_seconds(vehicle, seconds, rng, None, wrong, onset), *ground]):
        speed = np.sqrt(load) * (1.0 + 0.002 * rng.normal(size=(rate, len(load))))
        accel = np.array([0.0, 0.0, -force]) + 0.05 * rng.normal(size=(rate, 3))
        attitude = np.column_stack([np.ones(rate), 1e-3 * rng.normal(size=(rate, 3))])
        columns = ("rotor_speed", speed), ("gyro", 0.01 * rng.normal(size=(rate, 3))), ("accel", accel)
        yield Block(begin + k + np.arange(rate) / rate, (*columns, ("attitude", attitude)))


def hover(
    vehicle: Vehicle, wrong: Wrong | None = None, seed: int = 0, spread: float = 0.01, seconds: float = 20.0
) -> Recording:
    """A log of a hover at 50 Hz: rotors and accelerometer, on the ground for 2 s before and after.

    Args:
        seed: of noise and of what differs from flight to flight.
        spread: standard deviation of each rotor's thrust from flight to flight, relative.
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
