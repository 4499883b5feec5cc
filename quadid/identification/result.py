"""Results as plain dictionaries, ready for JSON: the forms of ``quadid.identify/1`` and ``quadid.score/1``.

Numbers stay Python floats; NaN and infinities mean "no answer" and become null when written.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from quadid.identification.fit import Fit, possible_moments
from quadid.identification.predict import SUM_TO, HorizonScore
from quadid.identification.score import SetScore
from quadid.model.layout import Layout
from quadid.parameters import INERTIAS, NOMINAL_NAMES, UNKNOWN, Parameter, ParameterSet, Status, impossible_inertia
from quadid.types import FloatArray, JsonDict
from quadid.vehicle import ParameterPrior, Vehicle

NOTHING_NEW = 0.9
"""Share of the information that the prior brings, above which the data add nothing."""
CORRELATED = 0.01
"""Least correlation that is written into a file."""
_DIGITS = 7
"""Significant digits of a fitted vehicle file; far below any interval."""


@dataclass(frozen=True)
class ScoredSet:
    """One log with its scores.

    Attributes:
        log: its name.
        role: ``train`` or ``validate``.
        initial: score of the initial guess.
        fitted: score of the fit.
        paper: mean squared error of the paper's closed-loop simulation before and after; None without a stabiliser.
        mse: mean square of whitened innovations before and after.
    """

    log: str
    role: str
    initial: SetScore
    fitted: SetScore
    paper: tuple[float, float] | None = None
    mse: tuple[float, float] = (math.nan, math.nan)


def identify_result(
    fit: Fit,
    optimizer: str,
    seed: int,
    seconds: float,
    sets: Sequence[ScoredSet],
    vehicle_file: str | None,
    warnings: Sequence[str] = (),
) -> JsonDict:
    """The result of an identification.

    Args:
        fit: the fit.
        optimizer: name of the search that was used.
        seed: of all random numbers.
        seconds: wall time of the fit, on the caller's clock.
        sets: training and validation sets with their scores.
        vehicle_file: absolute path of the written vehicle file; None when none was written.
        warnings: beyond those of the fit, from reading the logs.
    """
    return {
        "schema": "quadid.identify/1",
        "vehicle": fit.vehicle.name,
        "optimizer": optimizer,
        "seed": seed,
        "seconds": seconds,
        "parameters": [parameter_entry(p) for p in fit.parameters],
        "sets": [_set_entry(s) for s in sets],
        "vehicle_file": vehicle_file,
        "warnings": [*warnings, *fit.warnings, *inertia_warnings(fit.parameters)],
    }


def parameter_entry(p: Parameter) -> JsonDict:
    """One parameter of the contract, and the share of the information that was known before the flight."""
    entry: JsonDict = {
        "name": p.name,
        "unit": p.unit,
        "value": p.value,
        "ci95": list(p.ci95),
        "initial": p.initial,
        "status": p.status.value,
        "prior_share": p.prior_share,
        "measured_before": p.measured_before,
    }
    if p.relative_to is not None:
        entry["relative_to"] = p.relative_to
    return entry


def _set_entry(s: ScoredSet) -> JsonDict:
    seen = [c for c in s.fitted.channels if c.samples > 0]
    paper = None if s.paper is None else {"initial": s.paper[0], "fitted": s.paper[1]}
    return {
        "log": s.log,
        "role": s.role,
        "mse": {"initial": s.mse[0], "fitted": s.mse[1], "noise_floor": 1.0},
        "mse_paper": paper,
        "fit_percent": {c.name: c.fit_percent for c in seen},
        "rmse": {c.name: {"value": c.rmse, "unit": c.unit} for c in seen},
    }


def inertia_warnings(parameters: ParameterSet) -> list[str]:
    """Says when identified moments of inertia cannot belong to a rigid body."""
    values = {p.name: p for p in parameters if p.name in INERTIAS}
    if len(values) < len(INERTIAS) or any(p.status in UNKNOWN for p in values.values()):
        return []
    why = impossible_inertia([values[n].value for n in INERTIAS], slack=1.3)
    if why is None:
        return []
    return [
        f"no rigid body has these moments of inertia: {why}; check mass, rotor positions and units in the vehicle file"
    ]


def answered(parameters: ParameterSet) -> bool:
    """True when the data add to the vehicle file for at least one parameter.

    A value measured before may be decided by that on data that are informative, too.
    """
    return any(
        p.status is not Status.PRIOR_DOMINATED or (p.measured_before and p.prior_share < NOTHING_NEW)
        for p in parameters
    )


def fitted_vehicle(fit: Fit) -> Vehicle:
    """The vehicle with fitted values as initial guess, their standard deviations and correlations, fitted effects."""
    effects = [p.name.split(".")[0] for p in fit.parameters if p.name not in NOMINAL_NAMES]
    return with_correlation(with_values(fit.vehicle, fit.parameters, effects, fit.theta), fit.parameters)


def with_correlation(vehicle: Vehicle, parameters: ParameterSet) -> Vehicle:
    """The vehicle with correlations of those of its values that have a standard deviation."""
    names, found = parameters.names, parameters.correlation
    known = [i for i, n in enumerate(names) if n in NOMINAL_NAMES and vehicle.parameters[n].sigma is not None]
    together = {
        names[i]: {names[j]: round(float(found[i, j]), 3) for j in known if j < i and abs(found[i, j]) >= CORRELATED}
        for i in known
    }
    return vehicle.model_copy(update={"correlation": {one: others for one, others in together.items() if others}})


def with_values(
    vehicle: Vehicle, parameters: Iterable[Parameter], effects: Iterable[str] = (), theta: FloatArray | None = None
) -> Vehicle:
    """The vehicle with the identified nominal values as initial guess, their bounds kept unless a value lies outside.

    Any other value stays as the vehicle has it, without a standard deviation: a guess, or a number of a model that
    misses the flight, never becomes a sharp prior of the next fit.  A moment of inertia that no rigid body has beside
    those identified moves as far as it must.

    Args:
        vehicle: the vehicle.
        parameters: fitted ones; others than nominal are passed over.
        effects: which it has besides, or with other numbers.
        theta: full parameter vector that holds the numbers of these.
    """
    nominal = [p for p in parameters if p.name in NOMINAL_NAMES]
    kept = {p.name: vehicle.parameters[p.name].initial for p in nominal if p.status is not Status.IDENTIFIED}
    written, _ = possible_moments(tuple(replace(p, value=kept.get(p.name, p.value)) for p in nominal))
    priors = {p.name: _prior(vehicle.parameters[p.name], p) for p in written}
    found = {name: dict(values) for name, values in vehicle.effects.items()}
    if theta is not None:
        layout = Layout(vehicle)
        for name in effects:
            found[name] = {k: _rounded(v) for k, v in layout.read_effect(theta, name).items() if math.isfinite(v)}
    told = {"parameters": {**vehicle.parameters, **priors}, "effects": found, "correlation": {}}
    return vehicle.model_copy(update=told)


def _prior(given: ParameterPrior, p: Parameter) -> ParameterPrior:
    value = given.initial if p.value == given.initial else _rounded(p.value)
    known = p.status is Status.IDENTIFIED and math.isfinite(p.sigma) and p.sigma > 0.0
    bounds = given.bounds and (min(given.bounds[0], value), max(given.bounds[1], value))
    return ParameterPrior(initial=value, bounds=bounds, sigma=_rounded(p.sigma) if known else None)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def score_result(vehicle: str, pooled: HorizonScore, files: Sequence[tuple[str, int, HorizonScore]]) -> JsonDict:
    """The result of ``quadid score``.

    Args:
        vehicle: its name.
        pooled: over all starts of all files.
        files: name, number of gaps, and score of each file.
    """
    return {
        "schema": "quadid.score/1",
        "vehicle": vehicle,
        **_horizon_entry(pooled, sum(gaps for _, gaps, _ in files)),
        "files": [{"log": name, **_horizon_entry(score, gaps)} for name, gaps, score in files],
    }


def _horizon_entry(score: HorizonScore, gaps: int) -> JsonDict:
    return {
        "samples": score.samples,
        "gaps": gaps,
        "horizons": {str(h): score.at(h) for h in score.horizons},
        "spread": {str(h): score.between(h) for h in score.horizons},
        "sum": {"to": SUM_TO, **score.sum},
    }
