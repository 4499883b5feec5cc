"""Excitation: which parameters a window can reveal, from the Fisher information, before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.identification.noise_model import NoiseModel
from quadid.identification.shooting import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

SECONDS = 1.0
"""Length of the segments [s]."""


@dataclass(frozen=True)
class Excitation:
    """Cramer-Rao bounds from a window.

    Attributes:
        names: parameters.
        bound: smallest reachable relative standard deviation of each (absolute, in typical sizes, for effects),
            all others unknown too; infinite without information.
        alone: the same if all other parameters were known.
        information: Fisher information of the scaled parameters (P, P).
    """

    names: tuple[str, ...]
    bound: FloatArray
    alone: FloatArray
    information: FloatArray


def bounds_of(information: FloatArray) -> FloatArray:
    """Square roots of the diagonal of the inverse; infinite in directions without information."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    lost = values < 1e-10
    weight = vectors**2 @ np.where(lost, 0.0, 1.0 / np.maximum(values, 1e-300))
    hopeless = (vectors**2 @ lost.astype(np.float64)) > 1e-6
    return np.asarray(np.where(hopeless, np.inf, np.sqrt(weight) / scale))


def excitation(
    windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray | None = None, noise: NoiseModel | None = None,
) -> Excitation:  # fmt: skip
    """Computes the bounds for `windows` at `theta` (default: the vehicle's initial guess).

    Args:
        windows: data; only inputs and measured states matter.
        vehicle: the vehicle.
        theta: full parameter vector.
        noise: sensor noise; typical MEMS noise by default.
    """
    shooting = Shooting.cut(windows, vehicle, SECONDS, noise)
    free = shooting.free(NOMINAL_NAMES)
    point = shooting.layout.initial(vehicle) if theta is None else theta
    information = shooting.linearise(point, free).information
    diagonal = np.maximum(np.diag(information), 0.0)
    with np.errstate(divide="ignore"):
        alone = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), np.inf)
    return Excitation(free.names, bounds_of(information), alone, information)
