"""The extended vehicle: the fitted model with its findings, as YAML that every other command reads."""

from __future__ import annotations

import math

from quadid.diagnose.models import Model
from quadid.identify.shooting import Shooting
from quadid.identify.uncertainty import uncertainty
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import ParameterPrior, Vehicle


def extended_vehicle(vehicle: Vehicle, shooting: Shooting, model: Model) -> str:
    """Returns the YAML of `vehicle` with fitted parameters (with sigma) and the effects of `model`."""
    unc = uncertainty(model.lin, model.free, model.prior, model.theta)
    sigma = dict(zip(model.free.names, unc.sigma * model.free.jacobian(model.theta), strict=True))
    priors = {}
    for name in NOMINAL_NAMES:
        value = float(model.theta[shooting.layout.entry(name).index])
        low, high = vehicle.parameters[name].limits
        priors[name] = ParameterPrior(
            initial=value, bounds=(min(low, value), max(high, value)), sigma=float(sigma[name])
        )
    effects = {k: dict(v) for k, v in vehicle.effects.items()}
    for cause in model.causes:
        effects[cause.effect] = {
            k: v for k, v in shooting.layout.read_effect(model.theta, cause.effect).items() if math.isfinite(v)
        }
    return vehicle.model_copy(update={"parameters": priors, "effects": effects}).to_yaml()
