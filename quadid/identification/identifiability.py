"""The answer of an identification: what these data cannot show keeps its guess, and guesses belong to a rigid body."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.chi_square import Z95
from quadid.identification.covariance import Uncertainty
from quadid.identification.gauss_newton import Convergence
from quadid.identification.noise_model import NoiseModel
from quadid.model.layout import Layout
from quadid.parameters import (
    INERTIAS,
    NOMINAL_NAMES,
    UNKNOWN,
    Parameter,
    ParameterSet,
    Status,
    at_bound,
    impossible_inertia,
)
from quadid.types import FloatArray
from quadid.vehicle import Vehicle


@dataclass(frozen=True)
class Fit:
    """Result of an identification.

    Attributes:
        vehicle: the vehicle as given.
        theta: full parameter vector.
        parameters: free parameters with intervals and status.
        noise: estimated sensor noise, in which errors are stated.
        uncertainty: covariance of the scaled parameters.
        outcome: how the polish ended.
        evaluations: parameter vectors simulated by search and fits (finite differences included); the noise's apart.
        warnings: for the user.
    """

    vehicle: Vehicle
    theta: FloatArray
    parameters: ParameterSet
    noise: NoiseModel
    uncertainty: Uncertainty
    outcome: Convergence
    evaluations: int
    warnings: tuple[str, ...] = ()

    def of(self, names: Sequence[str]) -> Fit:
        """The same for some of its parameters, which come first; others were fitted along and are neutral again."""
        if len(names) == len(self.parameters):
            return self
        theta, layout = self.theta.copy(), Layout(self.vehicle)
        for p in self.parameters.parameters[len(names) :]:
            theta[layout.entry(p.name).index] = p.initial
        return replace(
            self,
            theta=theta,
            parameters=self.parameters.first(len(names)),
            uncertainty=self.uncertainty.first(len(names)),
        )


def final_answer(fit: Fit, out_of_reach: Mapping[str, str]) -> Fit:
    """The fit as every command, the library and the node give it.

    Args:
        fit: of all parameters together, so that those kept do not suffer from wrong guesses of the others.
        out_of_reach: parameters that the channels of the log cannot show, and why, in words.
    """
    return possible_inertia(mask_unidentifiable(fit, out_of_reach))


def mask_unidentifiable(fit: Fit, reasons: Mapping[str, str]) -> Fit:
    """The fit with parameters that these data cannot identify reset to the vehicle file's values.

    Args:
        fit: of all parameters together, so that those kept do not suffer from wrong guesses of the others.
        reasons: why, by parameter, in words.

    Returns:
        The fit with the status ``prior_dominated``, the prior's interval and a warning for every name in `reasons`.
    """
    names = [n for n in fit.parameters.names if n in reasons]
    if not names:
        return fit
    layout = Layout(fit.vehicle)
    theta, covariance = fit.theta.copy(), np.array(fit.parameters.covariance)
    rows = []
    for j, p in enumerate(fit.parameters):
        if p.name in reasons:
            spread = float(fit.uncertainty.prior_sigma[j])
            theta[layout.entry(p.name).index] = p.initial
            covariance[j, :], covariance[:, j] = 0.0, 0.0
            covariance[j, j] = (spread * p.initial) ** 2
            ci = (p.initial * math.exp(-Z95 * spread), p.initial * math.exp(Z95 * spread))
            p = replace(p, value=p.initial, sigma=spread * p.initial, ci95=ci, relative_to=None, prior_share=1.0,
                        status=Status.PRIOR_DOMINATED)  # fmt: skip
        rows.append(p)
    why = {reason: ", ".join(n for n in names if reasons[n] == reason) for reason in dict.fromkeys(reasons.values())}
    reset = [f"{who}: the vehicle file's values are kept, because {reason}" for reason, who in why.items() if who]
    kept = [w for w in fit.warnings if not w.startswith(tuple(f"{n} = " for n in names))]
    return replace(fit, theta=theta, parameters=ParameterSet(tuple(rows), covariance), warnings=(*reset, *kept))


def possible_inertia(fit: Fit) -> Fit:
    """The fit with moments of inertia that a rigid body can have; see `possible_moments`."""
    parameters, remark = possible_moments(tuple(fit.parameters))
    if remark is None:
        return fit
    theta, layout = fit.theta.copy(), Layout(fit.vehicle)
    for p in parameters:
        theta[layout.entry(p.name).index] = p.value
    return replace(
        fit, theta=theta, parameters=ParameterSet(parameters, np.array(fit.parameters.covariance)),
        warnings=(*fit.warnings, remark),
    )  # fmt: skip


def possible_moments(parameters: tuple[Parameter, ...]) -> tuple[tuple[Parameter, ...], str | None]:
    """Parameters with guessed moments of inertia moved to where a rigid body can have them beside those identified.

    Each principal moment lies between the difference and the sum of the other two; what breaks that by more than a
    vehicle file may is moved there, with a remark.  Where identified ones alone are impossible, the largest is
    not to be used, and is moved as a guess is.
    """
    values = {p.name: p for p in parameters if p.name in INERTIAS}
    if len(values) < len(INERTIAS) or impossible_inertia([values[n].value for n in INERTIAS]) is None:
        return parameters, None
    movable = [n for n in INERTIAS if values[n].status in UNKNOWN]
    if not movable:
        movable = [max(INERTIAS, key=lambda n: values[n].value)]
    name = max(movable, key=lambda n: values[n].sigma / values[n].value)
    one, two = (values[n].value for n in INERTIAS if n != name)
    old = values[name]
    value = min(max(old.value, abs(one - two)), one + two)
    status = old.status if old.status in UNKNOWN else Status.UNRELIABLE
    moved = replace(old, value=value, status=status, relative_to=None)
    remark = (
        f"{name}: moved from {old.value:.4g} to {value:.4g} {old.unit}, because no rigid body has the former beside "
        "the other two moments of inertia"
    )
    return tuple(moved if p.name == name else p for p in parameters), remark


def on_bounds(parameters: Iterable[Parameter]) -> list[str]:
    """Which parameters rest on a bound, and which nominal ones have an interval that reaches one, in words."""
    out = []
    for p in parameters:
        low, high = p.bounds
        if at_bound(p.value, low, high):
            out.append(f"{p.name} = {p.value:.4g} {p.unit} rests on its bound [{low:.4g}, {high:.4g}]")
        elif p.name in NOMINAL_NAMES and p.status is Status.UNRELIABLE and not (low <= p.ci95[0] and p.ci95[1] <= high):
            out.append(f"the interval of {p.name} reaches its bound [{low:.4g}, {high:.4g}]: check what is assumed")
    return out


def tied(parameters: Sequence[Parameter], names: Sequence[str]) -> tuple[Parameter, ...]:
    """Parameters; of two `names` those that are identified are known relative to the other one only."""
    other = dict(zip(names, reversed(names), strict=True))
    return tuple(
        replace(p, status=Status.RATIO_ONLY, relative_to=other[p.name])
        if p.name in other and p.status is Status.IDENTIFIED
        else p
        for p in parameters
    )
