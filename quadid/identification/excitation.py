"""Excitation: which parameters a window can reveal, before anything is fitted, and which movements reveal them best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.chi_square import Z95
from quadid.data.window import Window
from quadid.errors import ParameterError
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

# --- Excitation: which parameters a window can reveal, from the Fisher information, before anything is fitted


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
    windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray | None = None, noise: NoiseModel | None = None
) -> Excitation:
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


# --- Which movements to fly: blocks of a manoeuvre chosen so that the parameters' joint interval shrinks most
#
# D-optimal design: the determinant of the Fisher information is maximised by adding the best block again and again and
# then exchanging blocks while that helps.  Wynn, Ann. Math. Statist. 41 (1970) 1655; Fedorov, *Theory of Optimal
# Experiments* (1972).


def d_optimal(information: FloatArray, known: FloatArray, blocks: int) -> list[int]:
    """Chooses blocks, with repetition, whose summed information has the largest determinant.

    Args:
        information: Fisher information of the scaled parameters that each candidate brings, shape (candidates, P, P).
        known: information there already is, prior included; positive definite, shape (P, P).
        blocks: how many to choose.

    Returns:
        Indices of the chosen candidates, best first.

    Raises:
        ParameterError: nothing to choose from, or no block to choose.
    """
    if len(information) == 0 or blocks < 1:
        raise ParameterError(f"{blocks} blocks out of {len(information)} candidates", "at least one of each")
    chosen: list[int] = []
    total = known.copy()
    for _ in range(blocks):
        best = int(np.argmax(np.linalg.slogdet(total + information)[1]))
        chosen.append(best)
        total = total + information[best]
    for _ in range(10):
        before = list(chosen)
        for place, index in enumerate(chosen):
            rest = total - information[index]
            best = int(np.argmax(np.linalg.slogdet(rest + information)[1]))
            chosen[place], total = best, rest + information[best]
        if chosen == before:
            break
    return chosen


def halfwidths(information: FloatArray) -> FloatArray:
    """Relative 95 % half-width of each log parameter, all others unknown too, shape (P,): exp(1.96 sigma) - 1."""
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    return np.asarray(np.expm1(np.minimum(Z95 * sigma, 50.0)))
