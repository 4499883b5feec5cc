"""The vehicle that windows are fitted with: the vehicle file, extended by what a diagnosis of this flight found."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from quadid.effects import EFFECTS
from quadid.model.layout import LOSS, Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import GRAVITY, Vehicle
from quadid.vehicle_parts import ParameterPrior

FloatArray = NDArray[np.float64]

NOT_TAKEN_IN = ("gyro_scale", "rotor_spin_up", "battery_sag", "residual")
"""Effects that are not carried into later windows: a scale error of a sensor is no property of the vehicle, and the
others belong to the stretch of data that they were found on; so do effects with a time."""


def extended(vehicle: Vehicle, diagnosed: Vehicle) -> Vehicle:
    """The vehicle with the effects of a diagnosed one, and its parameters as first guesses.

    Bounds that the vehicle file gives stay; a bare guess moves with its default bounds.

    Args:
        vehicle: of the vehicle file.
        diagnosed: the extended vehicle of a diagnosis of it.
    """
    effects = {
        name: dict(values)
        for name, values in diagnosed.effects.items()
        if name in vehicle.effects or (name not in NOT_TAKEN_IN and not EFFECTS[name].timed)
    }
    parameters = {}
    for name in NOMINAL_NAMES:
        given, found = vehicle.parameters[name], diagnosed.parameters[name].initial
        if given.bounds is None:
            parameters[name] = ParameterPrior(initial=found)
        else:
            parameters[name] = given.model_copy(update={"initial": min(max(found, given.bounds[0]), given.bounds[1])})
    return vehicle.model_copy(update={"parameters": parameters, "effects": effects})


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
        hover = weight / max(float(self._share.sum()), 1e-9)
        speed = self._dead_speed + math.sqrt(max(hover - self._offset, 1e-9) / self._b)
        return hover / (self._b * speed**2)


def secant_share(vehicle: Vehicle, model: Vehicle, layout: Layout, theta: FloatArray) -> float:
    """`ThrustModel.secant` where the model has a thrust curve that the vehicle file does not know, else 1."""
    if "thrust_curve" in vehicle.effects or "thrust_curve" not in model.effects:
        return 1.0
    return ThrustModel(layout, theta).secant(vehicle.mass * GRAVITY)
