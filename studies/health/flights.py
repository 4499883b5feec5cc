"""Seconds of healthy and damaged hover, by the balance of forces and moments, for flights of hours in moments.

From flight to flight every rotor's thrust differs (propellers, motors), the battery sits elsewhere and weighs
differently; within a flight the battery empties, gusts come and go.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadid.vehicle import Vehicle

FloatArray = NDArray[np.float64]
G = 9.80665


class Variation(NamedTuple):
    """Healthy variation, 1 sigma: between flights of each rotor's thrust, the CG [m] and the load; within a flight of
    each rotor's command from second to second (with a memory of `memory` seconds) and sag of all over an hour."""

    rotor: float = 0.01
    shift: float = 0.001
    load: float = 0.01
    second: float = 0.004
    memory: float = 3.0
    sag: float = 0.15


def hover_seconds(
    vehicle: Vehicle, seconds: int, rng: np.random.Generator, variation: Variation | None = None,
    losses: FloatArray | None = None, onset: int = 0,
) -> Iterator[tuple[FloatArray, float]]:  # fmt: skip
    """Mean squared rotor speeds and specific force of each second of a hover.

    Args:
        vehicle: whose b and d are taken for true.
        seconds: how many.
        rng: of everything.
        variation: healthy variation.
        losses: of each rotor, thrust and drag torque alike, from `onset` [s] on.
    """
    how = Variation() if variation is None else variation
    n = len(vehicle.rotors)
    b, d = vehicle.parameters["b"].initial, vehicle.parameters["d"].initial
    own = 1.0 + how.rotor * rng.normal(size=n)
    weight = vehicle.mass * G * (1.0 + how.load * rng.normal())
    x, y = how.shift * rng.normal(size=2)
    arms = vehicle.rotor_positions
    demand = np.array([weight, weight * y, weight * x, 0.0])
    wander = how.second * rng.normal(size=n)
    keep = float(np.exp(-1.0 / how.memory))
    for k in range(seconds):
        left = own * (1.0 - (losses if losses is not None and k >= onset else np.zeros(n)))
        left = left * (1.0 - how.sag * k / 3600.0)
        rows = np.stack([b * left, b * left * arms[:, 1], b * left * arms[:, 0], d * left * vehicle.spins])
        level = np.linalg.lstsq(rows, demand, rcond=None)[0]
        wander = keep * wander + how.second * np.sqrt(1.0 - keep**2) * rng.normal(size=n)
        yield level * (1.0 + wander), G * (1.0 + 0.002 * float(rng.normal()))
