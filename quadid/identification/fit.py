"""Identification from first guess to parameters with intervals: swarm, polish, noise, covariance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from quadid.blas import one_thread
from quadid.chi_square import Z95
from quadid.data.window import Window
from quadid.errors import NotIdentifiableError, WindowError
from quadid.identification.filter_error import Filtered, filtered
from quadid.identification.gauss_newton import Convergence
from quadid.identification.noise import NoiseModel
from quadid.identification.noise_fit import reweighted_fit
from quadid.identification.particle_swarm import SwarmOptions
from quadid.identification.problem import Free, Shooting, default_prior
from quadid.identification.search import SWARM_SECONDS, Progress, swarm_search
from quadid.identification.uncertainty import Uncertainty, doubted, parameter_set, uncertainty, with_scale_uncertainty
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

# --- The answer of an identification: what these data cannot show keeps its guess, and guesses belong to a rigid body


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


def final_answer(fit: Fit, out_of_reach: Mapping[str, str], off: Mapping[str, float] | None = None) -> Fit:
    """The fit as every command, the library and the node give it.

    Intervals hold the truth if a doubt about the log is right.  Parameters that these data cannot identify keep the
    vehicle file's values, with the prior's interval, the status ``prior_dominated`` and a warning; moments of inertia
    are those of a rigid body, see `possible_moments`.

    Args:
        fit: of all parameters together, so that those kept do not suffer from wrong guesses of the others.
        out_of_reach: parameters that the channels of the log cannot show, and why, in words.
        off: natural logarithm of estimate over truth by parameter if what is doubted of the log is wrong.
    """
    held, told = doubted(fit.parameters.parameters, off or {})
    rows, warnings = list(held), (*told, *fit.warnings)
    grown = np.array(
        [1.0 if new is old else new.sigma / old.sigma for new, old in zip(held, fit.parameters, strict=True)]
    )
    covariance = fit.parameters.covariance * np.outer(grown, grown)
    lost = [n for n in fit.parameters.names if n in out_of_reach]
    for j, p in enumerate(rows):
        if p.name in lost:
            spread = float(fit.uncertainty.prior_sigma[j])
            covariance[j, :], covariance[:, j] = 0.0, 0.0
            covariance[j, j] = (spread * p.initial) ** 2
            ci = (p.initial * math.exp(-Z95 * spread), p.initial * math.exp(Z95 * spread))
            rows[j] = replace(
                p,
                value=p.initial,
                sigma=spread * p.initial,
                ci95=ci,
                relative_to=None,
                prior_share=1.0,
                status=Status.PRIOR_DOMINATED,
            )
    if lost:
        reasons = dict.fromkeys(out_of_reach.values())
        why = {reason: ", ".join(n for n in lost if out_of_reach[n] == reason) for reason in reasons}
        reset = [f"{who}: the vehicle file's values are kept, because {reason}" for reason, who in why.items() if who]
        warnings = (*reset, *(w for w in warnings if not w.startswith(tuple(f"{n} = " for n in lost))))
    parameters, moved = possible_moments(tuple(rows))
    if moved is not None:
        warnings = (*warnings, moved)
    theta, layout = fit.theta.copy(), Layout(fit.vehicle)
    for p in parameters:
        theta[layout.entry(p.name).index] = p.value
    return replace(fit, theta=theta, parameters=ParameterSet(parameters, covariance), warnings=warnings)


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
    """Parameters that rest on a bound, and which nominal ones have an interval that reaches one, in words."""
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


# --- A log of many hours: as much of it as the parameters need, so that memory and time do not grow with the log


MOST_SECONDS = 3600.0
"""Longest flight that is fitted whole [s]: an excited hour leaves some tenths of a per cent at worst."""
STRETCH = 60.0
"""Length of the stretches that are taken of a longer one [s]; each loses half a segment at its ends."""


def spread(windows: Sequence[Window]) -> tuple[list[Window], tuple[str, ...]]:
    """Stretches spread evenly over a flight that is longer than needed, and a sentence for people; else all of it."""
    total = sum(len(w) * w.dt for w in windows)
    if total <= MOST_SECONDS:
        return list(windows), ()
    share, due, count = MOST_SECONDS / total, 1.0, 0
    kept = []
    for w in windows:
        pieces = max(round(len(w) * w.dt / STRETCH), 1)
        count += pieces
        for k in range(pieces):
            if due >= 1.0:
                kept.append(w.slice(k * len(w) // pieces, (k + 1) * len(w) // pieces))
                due -= 1.0
            due += share
    return kept, (
        f"{total / 3600.0:.1f} h of flight are more than the parameters need: they come from {len(kept)} of {count} "
        f"stretches of {STRETCH:.3g} s, spread evenly",
    )


# --- The fit


MOST_SEGMENTS = 1000
"""Most segments of the first polish; a start needs no more."""
_RANDOM = (
    "something that the model lacks moves the vehicle: the fit therefore allows for random forces and moments, and "
    "fits drag, damping, centre of gravity, lag and delay along; `quadid diagnose` looks for the cause"
)
NO_FILTER = "a filter with this model has no finite answer on this flight: its numbers are not to be used"


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit.

    Attributes:
        particles, iterations: swarm size and most iterations; 0 iterations start from the initial guess.
        swarm: variant of the swarm.
        seed: decides every random number.
    """

    particles: int = 64
    iterations: int = 60
    swarm: SwarmOptions = field(default_factory=SwarmOptions)
    seed: int = 0


LEAST_SECONDS = 2.0
"""Shortest stretch worth fitting."""


def check_windows(windows: Sequence[Window]) -> None:
    """Raises when `windows` lack what identification needs, saying what is missing and how to get it."""
    longest = max(((len(w) - 1) * w.dt for w in windows), default=0.0)
    if longest < LEAST_SECONDS:
        raise NotIdentifiableError(
            f"the longest stretch of usable data is {longest:.3g} s",
            f"at least {LEAST_SECONDS:g} s without gaps",
            "use a longer flight, or a wider span of it",
        )
    if all(w.gyro is None or not np.isfinite(w.gyro).any() for w in windows):
        raise WindowError("no gyro in the data", "p q r [rad/s]", "log the IMU at 50 Hz or faster")
    if len({round(w.dt, 9) for w in windows}) > 1:
        raise WindowError("windows on different grids", "one grid step for all", "give --rate")


@one_thread()
def fit(
    windows: Sequence[Window],
    vehicle: Vehicle,
    options: FitOptions | None = None,
    names: Sequence[str] | None = None,
    progress: Progress | None = None,
    out_of_reach: Mapping[str, str] | None = None,
    off: Mapping[str, float] | None = None,
) -> Fit:
    """Identifies parameters from flight data.

    Args:
        windows: training data on one grid.
        vehicle: geometry, mass, initial guess, bounds and known effects.
        options: swarm, seed, segment length.
        names: parameters to free; by default the paper's six.
        progress: called with a stage and a fraction done.
        out_of_reach: parameters that the channels of the log cannot show, and why; they keep the file's value.
        off: natural logarithm of estimate over truth by parameter if what is doubted of the log is wrong.

    Raises:
        WindowError: no gyro, or several grids.
        NotIdentifiableError: too little data, or equations that have no finite step; see `polish`.
    """
    options = options or FitOptions()
    report = progress or (lambda stage, share: None)
    check_windows(windows)
    windows, thinned = spread(windows)
    # 1. Global search on segments so short that the simulation is nearly linear in all parameters.
    short = Shooting.cut(windows, vehicle, SWARM_SECONDS)
    free = short.free(list(names or NOMINAL_NAMES))
    theta, evaluations = short.layout.initial(vehicle), 0
    if options.iterations > 0:
        settings = replace(options.swarm, iterations=options.iterations)
        theta, evaluations = swarm_search(short, theta, free, settings, options.particles, options.seed, report)
    # 2. Polish there, and the noise that it leaves.
    report("polish", 0.0)
    short = short.at_most(MOST_SEGMENTS)
    short, first = reweighted_fit(short, theta, free, iterations=10, robust=True)
    report("polish", 0.2)
    # 3. The likelihood of innovations from there, how far its parameters hold, and the noise that belongs to it.
    beside = filtered(windows, short.vehicle, first.theta, free)
    if beside is None:
        unc = uncertainty(first.lin, default_prior(short, free))
        rows = parameter_set(free, first.theta, short.layout.initial(vehicle), unc).unreliable(free.names)
        found = Fit(vehicle, first.theta, rows, short.noise, unc, first.outcome, 0, (NO_FILTER, *on_bounds(rows)))
    else:
        found = beside_random_forces(short, beside, free)
    report("polish", 1.0)
    found = replace(found, evaluations=evaluations + first.simulated, warnings=(*thinned, *found.warnings))
    return final_answer(found, out_of_reach or {}, off)


def beside_random_forces(short: Shooting, found: Filtered, free: Free) -> Fit:
    """The answer of the fit beside random forces: its parameters, intervals and statuses."""
    # An uncertain mass or arm moves what the data show; what estimates differ by comes after.
    theta, unc = with_scale_uncertainty(short.vehicle, free, default_prior(short, free), found.theta, found.uncertainty)
    remarks = (*((_RANDOM,) if found.tilting else ()), *found.doubts(free))
    unc = found.held(unc)
    rows = parameter_set(free, theta, short.layout.initial(short.vehicle), unc)
    noise = found.noise.extended(short.noise)
    return Fit(short.vehicle, theta, rows, noise, unc, Convergence.CONVERGED, 0, (*remarks, *on_bounds(rows)))
