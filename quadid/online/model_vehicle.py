"""Thrust by a full parameter vector, and the vehicle whose guesses a first fit has moved."""

from __future__ import annotations

import math

import numpy as np

from quadid.model.layout import LOSS, Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.vehicle_parts import ParameterPrior


def moved(vehicle: Vehicle, theta: FloatArray) -> Vehicle:
    """The vehicle with the nominal six of `theta` as first guesses.

    Bounds that the vehicle file gives stay; a bare guess moves with its default bounds.
    """
    parameters = {}
    for name, found in zip(NOMINAL_NAMES, theta[: len(NOMINAL_NAMES)].tolist(), strict=True):
        given = vehicle.parameters[name]
        if given.bounds is None:
            parameters[name] = ParameterPrior(initial=found)
        else:
            parameters[name] = given.model_copy(update={"initial": min(max(found, given.bounds[0]), given.bounds[1])})
    return vehicle.model_copy(update={"parameters": parameters})


class ThrustModel:
    """Thrust of the rotors by a full parameter vector: thrust curve and weak rotors included, inflow left out."""

    def __init__(self, layout: Layout, theta: FloatArray) -> None:
        """Thrust by `theta`, shape (layout.size,)."""
        curve = layout.read_effect(theta, "thrust_curve")
        self._b, self._dead_speed = float(theta[0]), curve["dead_speed"]
        self._offset = curve.get("offset", 0.0)
        self._share = 1.0 - theta[LOSS : LOSS + layout.rotors]

    def total(self, rotor_speed: FloatArray) -> FloatArray:
        """Sum over the rotors [N], shape (n,), of speeds [rad/s], shape (n, rotors)."""
        thrust = self._b * np.maximum(rotor_speed - self._dead_speed, 0.0) ** 2 + self._offset
        return np.asarray(np.where(rotor_speed > 0.0, thrust, 0.0) @ self._share)

    def secant(self, weight: float) -> float:
        """Share of `b` that a model without the curve has: exact where the rotors carry `weight` [N]."""
        each = self._each(weight)
        hover = self._dead_speed + math.sqrt(max(each - self._offset, 1e-9) / self._b)
        return each / (self._b * hover**2)

    def tangent(self, secant: float, weight: float) -> float:
        """The `b` of this curve whose b at hover is `secant` [N s^2/rad^2]."""
        each = self._each(weight)
        beyond = max(math.sqrt(each / secant) - self._dead_speed, 1e-9)
        return max(each - self._offset, 1e-9) / beyond**2

    def _each(self, weight: float) -> float:
        return weight / max(float(self._share.sum()), 1e-9)
