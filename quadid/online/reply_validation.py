"""Whether an answer can be one to its request: a fit may come from another machine, and is taken in by arithmetic.

Shapes, finite numbers and the time it stands for are those that the request implies; what is left to believe is the
estimate itself, which the gate judges.
"""

from __future__ import annotations

import numpy as np

from quadid.identification.noise import SHAPE_POINTS, NoiseModel
from quadid.model.layout import Layout
from quadid.online.fusion import WindowEstimate
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

ROOM = 2.0
"""An estimate may lie so far outside the bounds, log scale: b at hover is not the b that was bounded."""
SIX = len(NOMINAL_NAMES)


def is_noise(noise: NoiseModel, channels: int) -> bool:
    """A noise model of so many channels."""
    shape = noise.white.shape
    if len(shape) != 1 or shape[0] != channels or noise.slow.shape != shape or not noise.slow_time > 0.0:
        return False
    return noise.shape is None or noise.shape.shape == (*shape, SHAPE_POINTS)


def is_vector(theta: FloatArray, asked: FloatArray, no_numbers: bool) -> bool:
    """Finite and possible, but where the estimate is told to be no numbers: then nothing of it is taken in."""
    possible = bool(np.isfinite(theta).all() and np.all(theta[:SIX] > 0.0))
    return theta.shape == asked.shape and (possible or no_numbers)


def is_estimate(estimate: WindowEstimate, vehicle: Vehicle, start: float, stop: float) -> bool:
    """An estimate of this vehicle from this time [s]; one that is no numbers is told as such later."""
    shapes = (estimate.z.shape, estimate.score.shape, estimate.information.shape)
    if shapes != ((SIX,), (SIX,), (SIX, SIX)) or (estimate.start, estimate.stop) != (start, stop):
        return False
    if estimate.left_out.shape != (2, len(vehicle.rotors)) or np.any(estimate.left_out[1] <= 0.0):
        return False
    if not estimate.finite:
        return True
    entries = [Layout(vehicle).entry(name) for name in NOMINAL_NAMES]
    low, high = (np.log([getattr(e, side) for e in entries]) for side in ("lower", "upper"))
    if np.any(estimate.z < low - ROOM) or np.any(estimate.z > high + ROOM):
        return False
    values = np.linalg.eigvalsh(0.5 * (estimate.information + estimate.information.T))
    return bool(values[0] >= -1e-9 * max(values[-1], 1.0))
