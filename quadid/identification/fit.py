"""Identification from first guess to parameters with intervals: swarm, polish, noise, covariance."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from quadid.blas import one_thread
from quadid.chi_square import Z95
from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.errors import NotIdentifiableError, WindowError
from quadid.identification.elimination import InitialStates
from quadid.identification.filter_error import Filtered, filtered
from quadid.identification.gauss_newton import Convergence, Polished, polish
from quadid.identification.noise import SHAPE_POINTS, NoiseModel, estimate_noise
from quadid.identification.particle_swarm import Stop, Swarm, SwarmOptions
from quadid.identification.problem import RIDGE, Free, Shooting, default_prior
from quadid.identification.uncertainty import Uncertainty, doubted, parameter_set, uncertainty, with_scale_uncertainty
from quadid.model.layout import Layout
from quadid.model.simd import LANES
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
from quadid.types import FloatArray, IndexArray
from quadid.vehicle import Vehicle

# --- Noise of a flight from what fits leave: its level and spectrum, from a flexible fit
#
# The flexible fit frees everything the catalogue can free at once, so that it leaves noise whatever the model of
# interest lacks.


# --- Spectrum of what a fit leaves: cosine modes of the whitened residual beside those of pure noise
#
# Rotor vibration folds to a hump somewhere between 0 Hz and the Nyquist frequency, so inertial noise is not white.  The
# spectrum is taken from the residual of the flexible fit above `LOWEST`; below it the level found just above is carried
# on, because what stands there is more likely dynamics than noise, and must stay visible.


LOWEST = 3.0
"""Frequency [Hz] below which residual power is not counted as noise."""
BAND = 1.5
"""Width [Hz] above `LOWEST` whose level is carried on below it."""
DRAWS = 4
SMOOTH = 3
LEAST_SEGMENTS = 20
LEAST_LEFT = 0.3
"""Share of its power that the elimination must leave a mode of noise for it to count."""


def mode_power(
    shooting: Shooting, theta: FloatArray, free: Free, rng: np.random.Generator, states: InitialStates
) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Mean power of each mode (channels, length) of the residual, and of noise through the same elimination.

    Args:
        shooting: problem.
        theta: full parameter vector.
        free: free parameters of the model (decide what is eliminated).
        rng: for the drawn noise.
        states: initial states at their optimum.

    Returns:
        Power found, power of unit white noise, and the number of segments, per channel; NaN where none is complete.
    """
    found, null = np.zeros((2, shooting.channels, shooting.length))
    counts = np.zeros(shooting.channels, dtype=np.intp)
    for c in shooting.columns(theta, free, states, parameters=False):
        found += np.einsum("scm,sc->cm", _powers(c.residual, c.basis), c.complete)
        for _ in range(DRAWS):
            powers = _powers(rng.standard_normal(c.residual.shape), c.basis)
            null += np.einsum("scm,sc->cm", powers, c.complete) / DRAWS
        counts += c.complete.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return found / counts[:, None], null / counts[:, None], counts


def _powers(residual: FloatArray, basis: FloatArray) -> FloatArray:
    """Squared cosine modes of the residual less its part in `basis`: (segments, channels, length)."""
    count, length, channels = residual.shape
    flat = residual.reshape(count, -1)
    inside = np.matmul(basis.transpose(0, 2, 1), flat[..., None])
    flat = flat - np.matmul(basis, inside)[..., 0]
    modes = np.matmul(_cosines(length), flat.reshape(count, length, channels))
    return np.asarray((modes**2).transpose(0, 2, 1))


@lru_cache(maxsize=8)
def _cosines(length: int) -> FloatArray:
    """Orthonormal cosine modes as rows (DCT-II), shape (length, length)."""
    modes = np.cos(np.pi / length * np.outer(np.arange(length), np.arange(length) + 0.5))
    modes *= np.sqrt(2.0 / length)
    modes[0] *= np.sqrt(0.5)
    return np.asarray(modes)


def shaped_noise(shooting: Shooting, theta: FloatArray, free: Free, states: InitialStates) -> NoiseModel:
    """Noise model of `shooting` with the spectrum of its inertial channels, from the residual at `theta` and `states`.

    `shooting.noise` must be white in those channels.  Attitude keeps its slow part; channels with few segments stay
    white.
    """
    noise = shooting.noise
    found, null, counts = mode_power(shooting, theta, free, np.random.default_rng(0), states)
    channels, length = found.shape
    frequency = 0.5 * np.arange(length) / (length * shooting.dt)
    grid = np.linspace(0.0, 0.5 / shooting.dt, SHAPE_POINTS)
    shape, white = np.ones((channels, SHAPE_POINTS)), noise.white.copy()
    for c in range(channels):
        if 3 <= c < 6 or counts[c] < LEAST_SEGMENTS or not np.isfinite(found[c]).all():
            continue
        level, modes = band_power(found[c], null[c], SMOOTH)
        known = np.flatnonzero(modes > 0.0)
        level = np.interp(np.arange(length), known, level[known])
        band = (frequency >= LOWEST) & (frequency < LOWEST + BAND)
        level = np.where(frequency < LOWEST, np.mean(level[band]), level)
        level = np.maximum(level, 1e-3 * np.max(level))
        mean = float(np.mean(level))
        white[c] *= np.sqrt(mean)
        shape[c] = np.interp(grid, frequency, level / mean)
    return replace(noise, white=white, shape=shape)


def band_power(found: FloatArray, null: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Power over `width` modes around each relative to that of noise, and how many of them count.

    Modes that the initial state takes away do not count.

    Args:
        found: power of each mode, shape (length,).
        null: what noise leaves there, likewise.
        width: odd number of modes.
    """
    kernel, usable = np.ones(width), null > LEAST_LEFT
    power, noise, modes = (np.convolve(usable * a, kernel, mode="same") for a in (found, null, np.ones_like(null)))
    return np.asarray(power / np.maximum(noise, 1e-9)), np.asarray(modes)


# --- The noise floor: sensor noise from a deliberately flexible fit, whatever the model of interest lacks


SPECTRUM_SECONDS = 0.5
LINE_SECONDS = 1.0
"""Segments of this length separate a line of vibration, as in calm flight, from a hump; where the model follows."""
LINE_SEGMENTS = 100
"""Fewest of them: from fewer, so fine a spectrum would be known too poorly to weigh by."""
FLEXIBLE_DRAG = 0.1
"""Rotor drag [1/s] the flexible fit starts from: velocities and moments of drag show only where there is any."""
FAR_ITERATIONS = 10
"""Linearisations of the flexible fit where the nominal one is far off."""
GROWS = 3.0
"""Growth of a channel's residual variance, from short segments to longer ones, that no sensor noise shows …"""
STAYS = 1.2
"""… and up to which the longer ones are followed as well."""
SHORT_SEGMENTS = 400
"""Most short segments the flexible model is fitted to at first."""
FROM_START = 8
"""Linearisations spent on the longer segments when they begin anew."""
LONG_SEGMENTS = 300
"""Most longer segments it is fitted to afterwards: its parameters need no more."""
MOST_NOISE_SEGMENTS = 4000
"""Most longer segments that the noise is measured on; they give it to a thousandth."""
_SETTLING = ("imu_lag.period", "rotor_drag.k_x")


def residual_noise(shooting: Shooting, polished: Polished, parameters: int | None = None) -> NoiseModel:
    """Noise from the residuals of a polish, all structure counted as noise (a starting point).

    Args:
        shooting: the problem.
        polished: its optimum.
        parameters: how many were fitted to these data; by default those of the polish.
    """
    lin = polished.lin
    used = lin.total_rows
    fitted = lin.gram.shape[1] if parameters is None else parameters
    freedom = max(used - fitted, 1.0) / max(used, 1.0)
    return estimate_noise(lin.residuals, lin.weights, shooting.dt, freedom)


def reweighted_fit(
    shooting: Shooting, theta: FloatArray, free: Free, iterations: int, robust: bool = False
) -> tuple[Shooting, Polished]:
    """Fits, measures the noise in what the fit leaves, and fits again: the problem with that noise, and the last fit.

    Args:
        shooting: the problem.
        theta: start, full vector.
        free: parameters to move.
        iterations: most linearisations of the second fit.
        robust: down-weight outliers in the second fit.
    """
    first = polish(shooting, theta, free, iterations=8)
    shooting = shooting.with_noise(residual_noise(shooting, first))
    return shooting, polish(shooting, first.theta, free, states=first.states, iterations=iterations, robust=robust)


def flexible_names(layout: Layout, shooting: Shooting) -> list[str]:
    """Everything the catalogue can free at once on these data: the model that leaves only noise."""
    kinds = ("always", "with_velocity") if shooting.has_velocity else ("always",)
    effects = [e for e in EFFECTS.values() if e.flexible in kinds]
    out = [*NOMINAL_NAMES, *(n for e in effects for n in e.flexible_entries)]
    losses = [n for n in layout.entries if n.startswith("weak_rotor.loss_")]
    return out + losses[1:]


class Flexible(NamedTuple):
    """The flexible fit: the noise that it leaves, and its optimum, a full vector."""

    noise: NoiseModel
    theta: FloatArray


def flexible_fit(
    windows: Sequence[Window],
    short: Shooting,
    starts: Sequence[FloatArray],
    free: Free,
    noise: NoiseModel | None = None,
    iterations: int = 4,
) -> Flexible:
    """Fits everything the catalogue can free at once.

    The flexible model is fitted on short segments, where it is nearly linear (of a long flight on some of them, spread
    evenly), and again on longer ones that resolve the spectrum of the vibration.

    Args:
        windows: data.
        short: short segments.
        starts: full vectors; the best outcome counts.
        free: nominal free parameters (kept free).
        noise: weights of the first fit; by default that of `short`.
        iterations: linearisations to spend on the short segments.
    """
    names = list(dict.fromkeys([*free.names, *flexible_names(short.layout, short)]))
    # The best of all starts on short segments, with some drag, without which velocities show in nothing.
    drag = short.free([n for n in ("rotor_drag.k_x", "rotor_drag.k_y") if n not in free.names]).index
    few = thinned(windows, short, short.seconds, noise or short.noise, SHORT_SEGMENTS)
    wide = few.free(names)
    tried = []
    for theta in starts:
        start = theta.copy()
        start[drag] = np.where(start[drag] == 0.0, FLEXIBLE_DRAG, start[drag])
        tried.append(polish(few, start, wide, iterations=iterations))
    first = min(tried, key=lambda p: p.cost)
    brief = residual_noise(few, first)
    longer = thinned(windows, short, SPECTRUM_SECONDS, brief, MOST_NOISE_SEGMENTS)
    # In calm flight short segments may make flexible parameters diverge; then longer ones begin where they did.
    for theta, iterations in [(first.theta, 3), *((start, FROM_START) for start in starts)]:
        found = polish(longer.at_most(LONG_SEGMENTS), theta, wide, iterations=iterations)
        second = _settled(longer, found.theta, names)
        noise = residual_noise(longer, second, len(names))
        if np.any(noise.variance > GROWS * brief.variance):
            continue  # noise does not grow with the length of a segment; what does is the model losing its way
        # The spectrum shows best in the longest segments that the model follows as well.
        shown, states = longer.with_noise(noise), second.states
        longest = thinned(windows, longer, LINE_SECONDS, noise, MOST_NOISE_SEGMENTS)
        if longest.count >= LINE_SEGMENTS:
            fitted = _settled(longest, second.theta, names)
            level = residual_noise(longest, fitted, len(names))
            if not np.any(level.variance > STAYS * noise.variance):
                shown, states = longest.with_noise(level), fitted.states
        return Flexible(shaped_noise(shown, second.theta, wide, states), second.theta)
    return Flexible(brief, first.theta)


def _settled(shooting: Shooting, theta: FloatArray, names: Sequence[str]) -> Polished:
    """Initial states of all segments at `theta`: all of them show the level of the noise.

    Two parameters move beside the initial states, so that segments are started and filters warmed up as for all.
    """
    return polish(shooting, theta, shooting.free([n for n in _SETTLING if n in names]), iterations=3)


def thinned(windows: Sequence[Window], like: Shooting, seconds: float, noise: NoiseModel, most: int) -> Shooting:
    """Segments of `seconds`, at most about `most` of them spread evenly; vehicle as in `like`."""
    return Shooting.cut(windows, like.vehicle, seconds, noise, like.layout).at_most(most)


# --- Global search: the particle swarm on short segments, whose valley Gauss-Newton then follows to the bottom


Progress = Callable[[str, float], None]

SWARM_SECONDS = 0.2
"""Length of the segments that the swarm simulates [s]."""
RESOLUTION = 0.5
"""Differences of the swarm's cost, a sum of squares over the noise, below which particles are equally good."""
SWARM_SEGMENTS = 100
"""Most segments the swarm simulates, spread evenly: it has to find the valley, whose bottom the polish finds."""


def swarm_search(
    shooting: Shooting,
    theta: FloatArray,
    free: Free,
    options: SwarmOptions,
    particles: int,
    seed: int,
    report: Progress,
) -> tuple[FloatArray, int]:
    """Global search by the particle swarm on a thinned set of segments.

    Args:
        shooting: the problem, short segments.
        theta: full vector; what is not free stays.
        free: parameters to search within their bounds.
        options: variant of the swarm and most iterations.
        particles: their number.
        seed: of the swarm.
        report: called with a stage and a fraction done.

    Returns:
        Full vector of the best particle, and the number of parameter vectors simulated.
    """
    stated = dict(zip(NOMINAL_NAMES, shooting.vehicle.bounds, strict=True))
    box = np.array([stated.get(e.name, (e.lower, e.upper)) for e in free.entries])
    lower, upper = (free.scaled(bound) for bound in box.T)
    cost = Projected(shooting, theta, free, SWARM_SEGMENTS).costs
    guess = np.clip(free.scaled(theta[free.index]), lower, upper)[None]
    settings = replace(options, initial_points=guess)
    swarm = Swarm(lower, upper, particles, seed, settings)
    done = 0
    while swarm.stop is Stop.RUNNING and not _resolved(swarm, settings):
        points = swarm.ask()
        thetas = np.repeat(theta[None], len(points), axis=0)
        thetas[:, free.index] = free.unscaled(points)
        swarm.tell(cost(thetas))
        done += 1
        report("swarm", min(done / (options.iterations + 1), 1.0))
    best = theta.copy()
    best[free.index] = free.unscaled(swarm.best)
    return best, done * particles


def _resolved(swarm: Swarm, settings: SwarmOptions) -> bool:
    """True when no particle's best is worse than the best of all by more than the data resolve."""
    worst = float(np.max(swarm.personal_bests[1]))
    return settings.tolerance > 0.0 and np.isfinite(worst) and worst - swarm.best_cost < RESOLUTION


class Projected:
    """Residuals of short segments without what their initial states can undo, for many parameter vectors at once.

    The directions of the initial states are taken at `theta` and projected out (variable projection): within a short
    segment they hardly depend on the parameters.
    """

    def __init__(self, shooting: Shooting, theta: FloatArray, free: Free, most: int) -> None:
        """Takes at most `most` segments, spread evenly, and the directions that matter beside `free`."""
        self._n_pre, k = shooting.start_of(theta, free)
        few = shooting.at_most(most)
        sigma = np.sqrt(few.noise.variance)
        self._jobs = []
        windows = zip(few.rollouts, few.segments, few.starts(self._n_pre).x0, strict=True)
        for i, (rollout, segments, start) in enumerate(windows):
            x0 = start.copy()
            rolled, steps = few.roll_directions(i, theta, few.free([]), x0, self._n_pre, k)
            columns = rolled[0, ..., : few.channels, 1 : k + 1] - rolled[0, ..., : few.channels, :1]
            flat = (columns / steps * (few.measured_weights(i) / sigma)[..., None]).reshape(len(x0), -1, k)
            flat = np.concatenate([flat, np.repeat(np.diag(1e-6 / RIDGE[:k])[None], len(flat), axis=0)], axis=1)
            basis = np.ascontiguousarray(np.linalg.qr(flat)[0][:, :-k])  # once, not at every call
            self._jobs.append((rollout, segments, x0, rollout.valid[:, : few.channels] / sigma, basis))

    def costs(self, thetas: FloatArray) -> FloatArray:
        """Sums of squares, in the noise's units, shapes (m, size) -> (m,)."""
        parts = [r.costs(cut, thetas, x0, weights, basis, self._n_pre) for r, cut, x0, weights, basis in self._jobs]
        return np.asarray(np.sum(parts, axis=0), dtype=np.float64)

    def residuals(self, thetas: FloatArray) -> FloatArray:
        """Residuals whose squares `costs` sums, shapes (m, size) -> (m, samples)."""
        parts = []
        for rollout, segments, x0, weights, basis in self._jobs:
            out, _ = rollout.roll(segments, thetas, x0, None, self._n_pre)
            scaled = out[..., : weights.shape[1], :] * weights[segments.rows][..., None]
            flat = scaled.reshape(*out.shape[:2], -1, LANES)
            flat = flat - np.matmul(basis, np.matmul(basis.transpose(0, 2, 1), flat))
            parts.append(flat.transpose(0, 3, 1, 2).reshape(-1, flat.shape[1] * flat.shape[2])[: len(thetas)])
        return np.concatenate(parts, axis=1)


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
        beside: what was fitted along, as effects of a vehicle file.
    """

    vehicle: Vehicle
    theta: FloatArray
    parameters: ParameterSet
    noise: NoiseModel
    uncertainty: Uncertainty
    outcome: Convergence
    evaluations: int
    warnings: tuple[str, ...] = ()
    beside: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


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
    warnings = (*remarks, *on_bounds(rows))
    return Fit(short.vehicle, theta, rows, noise, unc, Convergence.CONVERGED, 0, warnings, found.beside)
