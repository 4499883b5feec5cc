"""The extended vehicle: the fitted model with its findings, as YAML that every other command reads."""

from __future__ import annotations

import math
from collections.abc import Sequence

from quadid.diagnose.model import Model
from quadid.model.layout import Layout
from quadid.parameters import Parameter, Status
from quadid.vehicle import Vehicle
from quadid.vehicle_parts import ParameterPrior


def extended_vehicle(vehicle: Vehicle, layout: Layout, model: Model, parameters: Sequence[Parameter]) -> str:
    """Returns the YAML of `vehicle` with `parameters`, their standard deviations, and the effects of `model`.

    A number that is not to be used is a guess, without standard deviation.
    """
    priors = {}
    for p in parameters:
        low, high = vehicle.parameters[p.name].limits
        priors[p.name] = ParameterPrior(
            initial=p.value, bounds=(min(low, p.value), max(high, p.value)),
            sigma=None if p.status is Status.UNRELIABLE else p.sigma,
        )  # fmt: skip
    effects = {k: dict(v) for k, v in vehicle.effects.items()}
    for cause in model.causes:
        effects[cause.effect] = {
            k: v for k, v in layout.read_effect(model.theta, cause.effect).items() if math.isfinite(v)
        }
    return vehicle.model_copy(update={"parameters": priors, "effects": effects}).to_yaml()
