"""The vehicle whose guesses a first fit has moved."""

from __future__ import annotations

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
