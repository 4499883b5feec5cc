"""The extended vehicle: the fitted model with its findings, as YAML that every other command reads."""

from __future__ import annotations

import math

from quadid.diagnose.model import Model
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid.vehicle_parts import ParameterPrior


def extended_vehicle(vehicle: Vehicle, layout: Layout, model: Model) -> str:
    """Returns the YAML of `vehicle` with the parameters of `model`, their standard deviations, and its effects."""
    priors, sigma = {}, model.deviations
    for name in NOMINAL_NAMES:
        value = float(model.theta[layout.entry(name).index])
        low, high = vehicle.parameters[name].limits
        priors[name] = ParameterPrior(initial=value, bounds=(min(low, value), max(high, value)), sigma=sigma[name])
    effects = {k: dict(v) for k, v in vehicle.effects.items()}
    for cause in model.causes:
        effects[cause.effect] = {
            k: v for k, v in layout.read_effect(model.theta, cause.effect).items() if math.isfinite(v)
        }
    return vehicle.model_copy(update={"parameters": priors, "effects": effects}).to_yaml()
