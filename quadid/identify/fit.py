"""Identification from first guess to parameters with intervals: swarm, polish, noise, covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from quadid.errors import NotIdentifiableError, WindowError
from quadid.identify.answer import final_answer, on_bounds
from quadid.identify.composite_likelihood import with_second_cut
from quadid.identify.covariance import Uncertainty, parameter_set, uncertainty
from quadid.identify.gauss_newton import Convergence, Polished, polish
from quadid.identify.global_search import Progress, swarm_search
from quadid.identify.long_logs import spread
from quadid.identify.noise_estimation import FAR_ITERATIONS, flexible_fit, reweighted_fit
from quadid.identify.noise_estimation import flexible_names as flexible_names
from quadid.identify.noise_estimation import noise_floor as noise_floor
from quadid.identify.noise_estimation import residual_noise as residual_noise
from quadid.identify.noise_memory import with_memory
from quadid.identify.noise_model import NoiseModel
from quadid.identify.particle_swarm import SwarmOptions
from quadid.identify.priors import default_prior
from quadid.identify.reliability import reliability
from quadid.identify.shooting import Free, Shooting
from quadid.identify.uncertain_scale import with_uncertain_scale
from quadid.model.layout import Layout
from quadid.parameters import INERTIAS, NOMINAL_NAMES, ParameterSet, at_bound
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Window

SWARM_SECONDS = 0.2
FIT_SECONDS = 1.0
SHORT_SEGMENTS = 1000
"""Most short segments of the first polish, whose result only starts the last one."""
SLOW_MOMENTS = ("cg_offset.x", "cg_offset.y")
"""Moments about pitch and roll that go with thrust, set aside segment by segment where the model lacks slow moments."""
MOMENT_MISFIT = 1.5
MOMENT_GAIN = 0.5
"""They are set aside when the fit is this bad, or rests on a bound, and the rate residual falls below this share."""
_SET_ASIDE = (
    "slow roll and pitch moments that the model lacks were set aside in every segment, so that they do not pass for "
    "inertia; parameters come from the faster motion alone; quadid diagnose names the cause"
)


@dataclass(frozen=True)
class FitOptions:
    """How to fit.

    Attributes:
        particles, iterations: swarm size and most iterations; 0 iterations start from the initial guess.
        swarm: variant of the swarm.
        polish: run Gauss-Newton after the swarm.
        seed: decides every random number.
        seconds: length of the shooting segments of the final fit [s].
        robust: down-weight outliers.
    """

    particles: int = 64
    iterations: int = 60
    swarm: SwarmOptions = field(default_factory=SwarmOptions)
    polish: bool = True
    seed: int = 0
    seconds: float = FIT_SECONDS
    robust: bool = True


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
        evaluations: parameter vectors simulated over the data (finite differences included).
        warnings: what a user should know.
    """

    vehicle: Vehicle
    theta: FloatArray
    parameters: ParameterSet
    noise: NoiseModel
    uncertainty: Uncertainty
    outcome: Convergence
    evaluations: int
    warnings: tuple[str, ...] = ()


LEAST_SECONDS = 2.0
"""Shortest stretch worth fitting."""


def check_windows(windows: Sequence[Window]) -> None:
    """Raises when `windows` lack what identification needs, saying what is missing and how to get it."""
    longest = max(((len(w) - 1) * w.dt for w in windows), default=0.0)
    if longest < LEAST_SECONDS:
        raise NotIdentifiableError(
            f"the longest stretch of usable data is {longest:.3g} s", f"at least {LEAST_SECONDS:g} s without gaps",
            "use a longer flight, or a wider span of it",
        )  # fmt: skip
    if all(w.gyro is None or not np.isfinite(w.gyro).any() for w in windows):
        raise WindowError("no gyro in the data", "p q r [rad/s]", "log the IMU at 50 Hz or faster")
    if len({round(w.dt, 9) for w in windows}) > 1:
        raise WindowError("windows on different grids", "one grid step for all", "give --rate")


def fit(
    windows: Sequence[Window], vehicle: Vehicle, options: FitOptions | None = None, names: Sequence[str] | None = None,
    progress: Progress | None = None, out_of_reach: Mapping[str, str] | None = None,
) -> Fit:  # fmt: skip
    """Identifies parameters from flight data.

    Args:
        windows: training data on one grid.
        vehicle: geometry, mass, initial guess, bounds and known effects.
        options: swarm, seed, segment length.
        names: parameters to free; by default the paper's six.
        progress: called with a stage and a fraction done.
        out_of_reach: parameters that the channels of the log cannot show, and why; they keep the file's value.

    Raises:
        WindowError: no gyro, or several grids.
        NotIdentifiableError: too little data, or equations that have no finite step; see `polish`.
    """
    options = options or FitOptions()
    report = progress or (lambda stage, share: None)
    check_windows(windows)
    windows, said = spread(windows)
    layout = Layout(vehicle)
    free_names = list(names or NOMINAL_NAMES)
    theta = layout.initial(vehicle)
    short = Shooting.cut(windows, vehicle, SWARM_SECONDS, layout=layout)
    evaluations = 0
    if options.iterations > 0:
        settings = replace(options.swarm, iterations=options.iterations)
        theta, evaluations = swarm_search(
            short, theta, short.free(free_names), settings, options.particles, options.seed, report
        )
    if not options.polish:
        return final_answer(_finish(short, theta, free_names, Convergence.BUDGET, evaluations), out_of_reach or {})
    report("polish", 0.0)
    short = short.at_most(SHORT_SEGMENTS)
    free = short.free(free_names)
    typical = short.noise
    short, first = reweighted_fit(short, theta, free, iterations=10, robust=options.robust)
    moments = _slow_moments(short, theta, first, free)
    if moments is not None:
        # Longer segments would only let the missing moments in again.
        final, result = moments
        # What the moments leave is no measure of the noise, nor are its weights a start for one.
        starts = [result.theta, first.theta]
        flexible = flexible_fit(windows, short, starts, free, typical, FAR_ITERATIONS)
        noise, spent, said = flexible.noise, flexible.simulated, (*said, _SET_ASIDE)
    else:
        noise, spent = noise_floor(windows, short, first.theta, free)
        report("polish", 0.4)
        final = Shooting.cut(windows, vehicle, options.seconds, noise, layout)
        result = polish(final, first.theta, free, robust=options.robust)
        noise, more = with_memory(windows, final, result.theta, free_names)
        final, spent = final.with_noise(noise), spent + more
        theta, states = result.theta, result.states
        del result  # of a long log its residuals are a large part of all memory
        result = polish(final, theta, free, states=states, robust=options.robust)
    if not np.isfinite(result.cost):
        final, result = short, first
    report("polish", 1.0)
    evaluations += spent + (first.iterations + result.iterations) * (len(free.entries) + 10)
    # Where channels cannot show how the vehicle turns, longer segments and other models cannot be compared either.
    judge = None if set(INERTIAS) & set(out_of_reach or ()) else first
    found = _finish(final, result.theta, free_names, result.outcome, evaluations, result, options.robust, judge)
    return final_answer(replace(found, noise=noise, warnings=(*said, *found.warnings)), out_of_reach or {})


def _slow_moments(short: Shooting, start: FloatArray, plain: Polished, free: Free) -> tuple[Shooting, Polished] | None:
    """Problem and fit with a slow roll and pitch moment of its own in each segment; None unless the data ask for it.

    Aerodynamic moments, uncalibrated rotor speeds and offsets act slowly; a model that lacks them otherwise takes them
    for a large inertia.
    """
    if plain.lin.total_cost < MOMENT_MISFIT * plain.lin.total_rows and _at_rest(free, plain.theta):
        return None
    apart = short.with_local(SLOW_MOMENTS)
    best = polish(apart, start, free, iterations=10)
    for _ in range(2):
        apart = apart.with_noise(residual_noise(apart, best))
        best = polish(apart, best.theta, free, states=best.states, iterations=8)
    free_variance, variance = residual_noise(apart, best).variance[:2], short.noise.variance[:2]
    return (apart, best) if np.any(free_variance < MOMENT_GAIN * variance) else None


def _at_rest(free: Free, theta: FloatArray) -> bool:
    """True when no parameter rests on a bound."""
    return not any(at_bound(float(theta[e.index]), e.lower, e.upper) for e in free.entries)


def _finish(
    shooting: Shooting, theta: FloatArray, names: list[str], outcome: Convergence, evaluations: int,
    polished: Polished | None = None, robust: bool = False, short: Polished | None = None,
) -> Fit:  # fmt: skip
    """Intervals and statuses; `short` is the fit to short segments, which tells what the numbers are worth."""
    free = shooting.free(names)
    prior = default_prior(shooting, free)
    both = None if polished is None else with_second_cut(shooting, polished, free, prior, robust)
    lin = polished.lin if polished is not None else shooting.linearise(theta, free)
    unc = uncertainty(lin, prior, None if both is None else both.information)
    if both is not None:
        theta, evaluations = both.theta, evaluations + both.iterations * (len(free.entries) + 10)
    theta, unc = with_uncertain_scale(shooting.vehicle, free, prior, theta, unc)
    doubts: tuple[str, ...] = ()
    if polished is not None and short is not None and np.isfinite(polished.cost):
        trust = reliability(shooting, polished, free, prior, short)
        unc, doubts = trust.widened(unc), trust.reasons(free, unc)
    initial = shooting.layout.initial(shooting.vehicle)
    parameters = parameter_set(free, theta, initial, unc)
    return Fit(
        shooting.vehicle, theta, parameters, shooting.noise, unc, outcome, evaluations,
        (*doubts, *_warnings(free, parameters, unc)),
    )  # fmt: skip


def _warnings(free: Free, parameters: ParameterSet, unc: Uncertainty) -> tuple[str, ...]:
    out = on_bounds(parameters)
    grown = [f"{e.name} x{g:.1f}" for e, g in zip(free.entries, unc.inflation, strict=True) if g > 1.5]
    if grown:
        out.append(
            "residuals are larger or more correlated than noise, so intervals were widened: " + ", ".join(grown)
            + "; quadid diagnose names the cause"
        )  # fmt: skip
    return tuple(out)
