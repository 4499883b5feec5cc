"""The extended vehicle: the fitted model with its findings, as YAML that every other command reads."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.hypotheses import Candidate
from quadid.diagnose.model import Model
from quadid.identify.covariance import uncertainty
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import ParameterPrior, Vehicle


@dataclass(frozen=True)
class Fitted:
    """What goes into the file.

    Attributes:
        theta: full vector.
        sigma: standard deviation of fitted entries, in their own unit; those left out have none that means anything.
        causes: whose effects it holds.
    """

    theta: NDArray[np.float64]
    sigma: dict[str, float]
    causes: tuple[Candidate, ...]

    @classmethod
    def of(cls, model: Model) -> Fitted:
        """The parameters of a model, with the deviations that its data tell."""
        sigma = uncertainty(model.lin, model.free, model.prior, model.theta).sigma * model.free.jacobian(model.theta)
        return cls(model.theta, dict(zip(model.free.names, sigma.tolist(), strict=True)), model.causes)


def extended_vehicle(vehicle: Vehicle, layout: Layout, fitted: Fitted) -> str:
    """Returns the YAML of `vehicle` with fitted parameters, their sigma where it is known, and effects."""
    priors = {}
    for name in NOMINAL_NAMES:
        value = float(fitted.theta[layout.entry(name).index])
        low, high = vehicle.parameters[name].limits
        priors[name] = ParameterPrior(
            initial=value, bounds=(min(low, value), max(high, value)), sigma=fitted.sigma.get(name)
        )
    effects = {k: dict(v) for k, v in vehicle.effects.items()}
    for cause in fitted.causes:
        effects[cause.effect] = {
            k: v for k, v in layout.read_effect(fitted.theta, cause.effect).items() if math.isfinite(v)
        }
    return vehicle.model_copy(update={"parameters": priors, "effects": effects}).to_yaml()
