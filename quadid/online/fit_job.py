"""The fit of one window, which a worker does beside the session: a pure function of its request.

The nominal six are fitted first.  Where the vehicle file's model misses the flight, every effect that moves the vehicle
is fitted along.  Nothing is selected: each effect is held near the vehicle file's value by a few of its typical sizes,
and has a value of its own in each window, so that what cannot be told from the parameters widens their intervals
instead of bending them.  Segments are short then, because what no effect describes grows with their length.

The result is a quadratic model in the nominal six, the effects eliminated (Schur complement).  Its b is the one with
which the vehicle file's own model carries the weight at the same speed (`ThrustModel.like`): all rotors count alike,
and all windows share it, unlike the steepness of a curve.  What the six leave out of the thrust stands beside them
(`left_out`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from quadid.data.window import Sampling, Window
from quadid.effects import EFFECTS
from quadid.identification.elimination import eliminated
from quadid.identification.excitation import bounds_of
from quadid.identification.gauss_newton import Polished, polish, robust_weights
from quadid.identification.noise import SHAPE_POINTS, NoiseModel
from quadid.identification.noise_fit import residual_noise, reweighted_fit
from quadid.identification.particle_swarm import SwarmOptions
from quadid.identification.problem import Free, Prior, Shooting, posterior_covariance, prior_terms
from quadid.identification.search import SWARM_SECONDS, swarm_search
from quadid.identification.uncertainty import variance_ratio
from quadid.model.layout import B, Layout, ThrustModel
from quadid.model.rollout import channels_of
from quadid.online.records import Job, JobReply
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

SIX = len(NOMINAL_NAMES)
ROLL_PITCH = [NOMINAL_NAMES.index(name) for name in ("J_xx", "J_yy")]

FIT_SECONDS = 1.66
"""Length of the shooting segments [s]: six of them fill a window, one a short stretch.

What happens across their borders is lost with the free states there.  The time between refits is no multiple of it, so
windows that overlap have their borders at different places, and fused they see nearly all.
"""
EXCITED = 0.02
"""A window is excited when roll and pitch inertia can be had from it alone to this relative standard deviation."""
FLEXIBLE_SECONDS = 0.5
"""Length of the segments where effects are fitted along [s]."""
EFFECT_WIDTH = 3.0
"""Prior width of an effect, in its typical size."""
ROUNDS = 4
"""Fits after which the noise that the fit leaves has settled, where none is known."""
ORDER: dict[Sampling, int] = {"held": 1, "instant": 2}
"""Power with which the error between readings grows of their distance (Richardson): steps miss twice as much at
twice the distance, lines four times."""
LASTING = 75.0
"""A pilot's style and the place of the readings between the sticks' steps stay for more than a minute [s]: for that
long windows err alike, and what they miss counts once."""
ROOM = 16.0
"""A bare guess may be wrong by this factor each way; how sure it is stays as it was.

What the nominal model made of a flight that it misses is no better guess: it may be wrong by as much.
"""
FEWEST_SEGMENTS = 5
"""Fewer segments do not give the noise well enough to say what is more than noise."""
BEYOND = 2.0
"""An estimate may lie so far outside the bounds, log scale: b at hover is not the b that was bounded."""


@dataclass(frozen=True)
class WindowEstimate:
    """Estimate of one window: a quadratic model of its cost.

    Attributes:
        start, stop: its time [s].
        z: scaled parameters where it was linearised, shape (P,).
        information: Fisher information there, without prior, shape (P, P).
        score: half the gradient of the cost there, shape (P,).
        cost: cost at z; rows: independent residuals, so that cost / rows is 1 at the noise floor.
        left_out: what the parameters leave out of thrust, and its standard deviations, shape (2, R + 1) (`left_out`).
    """

    start: float
    stop: float
    z: FloatArray
    information: FloatArray
    score: FloatArray
    cost: float
    rows: float
    left_out: FloatArray

    @property
    def mse(self) -> float:
        """Mean squared whitened residual; 1 at the noise floor."""
        return self.cost / max(self.rows, 1.0)

    @property
    def scale(self) -> float:
        """Factor on its information: residuals above the noise floor make it count less."""
        return 1.0 / max(self.mse, 1.0)

    @property
    def optimum(self) -> FloatArray:
        """Minimum of its cost, shape (P,)."""
        return np.asarray(self.z - np.linalg.solve(self.information, self.score))

    @property
    def finite(self) -> bool:
        """True if it contains finite numbers only."""
        arrays = (self.z, self.information, self.score, self.left_out)
        return math.isfinite(self.cost) and all(bool(np.isfinite(a).all()) for a in arrays)

    def deviance(self, z: FloatArray) -> float:
        """Cost of `z` in this window above that of its own estimate, in units of its residual level."""
        step = z - self.z
        return float(2.0 * self.score @ step + step @ self.information @ step) * self.scale


@dataclass(frozen=True)
class LackOfFit:
    """Part of the residuals that the effects of the catalogue would explain, all freed at once.

    Attributes:
        drop: of the deviance, in units of the residuals' own level.
        freedom: numbers freed: what noise alone would give.
        rows: independent residuals.
    """

    drop: float = 0.0
    freedom: int = 0
    rows: float = 0.0

    @property
    def share(self) -> float:
        """Share of the residuals, beyond what noise gives."""
        return (self.drop - self.freedom) / max(self.rows, 1.0)

    @property
    def significant(self) -> bool:
        """True if it is more than a trifle (1 %), and more than noise gives (6 standard deviations)."""
        errors = (self.drop - self.freedom) / math.sqrt(2.0 * max(self.freedom, 1))
        return self.share > 0.01 and errors > 6.0


@dataclass(frozen=True)
class FitReply(JobReply):
    """Answer to a request.

    Attributes:
        excitation: relative standard deviations that this window alone allows, shape (6,); None after a failure.
        excited: whether they suffice.
        estimate: quadratic model at the optimum.
        theta: full parameter vector there.
        noise: noise it was weighted with: the request's, or one that had to be found anew; what the model misses over a
            segment counts as noise.
        measured: noise measured in this window, when that was asked for.
        misfit: variance of gyro (x, y, z) and accelerometer residuals over that of the sensors' own noise, shape (6,):
            1 where the model misses nothing; with `measured`, or where noise was found anew, and effects were not
            fitted along.
        lack: what effects of the catalogue would explain; with `misfit`.
        flexible: every effect that moves the vehicle was fitted along.
        between_rows: standard deviations, log scale, by what the rotors do between readings, shape (6,); in `estimate`.
    """

    excitation: FloatArray | None = None
    excited: bool = False
    estimate: WindowEstimate | None = None
    theta: FloatArray | None = None
    noise: NoiseModel | None = None
    measured: NoiseModel | None = None
    misfit: FloatArray | None = None
    lack: LackOfFit | None = None
    flexible: bool = False
    between_rows: FloatArray | None = None


@dataclass(frozen=True)
class FitRequest(Job):
    """A window to be fitted.

    Attributes:
        theta: full parameter vector to start from.
        noise: sensor noise; None lets the fit estimate it.
        search: run the swarm first: nothing is known yet, or the vehicle has changed.
        seed: of the swarm.
        measure: measure the sensor noise in this window too.
        flexible: fit every effect that moves the vehicle along.
        spacing: time between two readings of the rotors [rows].
    """

    reply = FitReply

    theta: FloatArray
    noise: NoiseModel | None
    search: bool
    seed: int
    measure: bool = False
    flexible: bool = False
    spacing: float = 1.0

    def answer(self) -> FitReply:
        """Fits the windows."""
        return fit(self)

    def is_answered_by(self, reply: object) -> TypeGuard[JobReply]:
        """True if a reply is to this job, and of its form."""
        if not (super().is_answered_by(reply) and isinstance(reply, FitReply)):
            return False
        channels = min(map(channels_of, self.windows), default=0)
        estimate = reply.estimate
        return (
            all(a is None or a.shape == (SIX,) for a in (reply.excitation, reply.misfit, reply.between_rows))
            and all(n is None or _is_noise(n, channels) for n in (reply.noise, reply.measured))
            and (
                reply.theta is None or _is_vector(reply.theta, self.theta, estimate is not None and not estimate.finite)
            )
            and (estimate is None or _is_estimate(estimate, self.vehicle, self.start, self.stop))
        )


def _is_noise(noise: NoiseModel, channels: int) -> bool:
    """A noise model of so many channels."""
    shape = noise.white.shape
    if len(shape) != 1 or shape[0] != channels or noise.slow.shape != shape or not noise.slow_time > 0.0:
        return False
    return noise.shape is None or noise.shape.shape == (*shape, SHAPE_POINTS)


def _is_vector(theta: FloatArray, asked: FloatArray, no_numbers: bool) -> bool:
    """Finite and possible, but where the estimate is told to be no numbers: then nothing of it is taken in."""
    possible = bool(np.isfinite(theta).all() and np.all(theta[:SIX] > 0.0))
    return theta.shape == asked.shape and (possible or no_numbers)


def _is_estimate(estimate: WindowEstimate, vehicle: Vehicle, start: float, stop: float) -> bool:
    """An estimate of this vehicle from this time [s]; one that is no numbers is told as such later."""
    shapes = (estimate.z.shape, estimate.score.shape, estimate.information.shape)
    if shapes != ((SIX,), (SIX,), (SIX, SIX)) or (estimate.start, estimate.stop) != (start, stop):
        return False
    if estimate.left_out.shape != (2, len(vehicle.rotors) + 1) or np.any(estimate.left_out[1] <= 0.0):
        return False
    if not estimate.finite:
        return True
    entries = [Layout(vehicle).entry(name) for name in NOMINAL_NAMES]
    low, high = (np.log([getattr(e, side) for e in entries]) for side in ("lower", "upper"))
    if np.any(estimate.z < low - BEYOND) or np.any(estimate.z > high + BEYOND):
        return False
    values = np.linalg.eigvalsh(0.5 * (estimate.information + estimate.information.T))
    return bool(values[0] >= -1e-9 * max(values[-1], 1.0))


# --- The fit: segments, search, optimum, what the six leave out, what they lack


def fit(request: FitRequest) -> FitReply:
    """Fits the nominal six to a window, and with effects where these are asked for or lacking."""
    # 1. Segments of the window, and what the motion in them reveals, around the best estimate at hand.
    theta, noise = request.theta, request.noise
    shooting = Shooting.cut(request.windows, request.vehicle, FIT_SECONDS, noise)
    if shooting.count == 0:
        return FitReply(request.number, "no stretch is long enough for one segment")
    free = shooting.free(NOMINAL_NAMES)
    lin, guess = shooting.linearise(theta, free), shooting.layout.initial(request.vehicle)
    if not np.isfinite(lin.total_cost) and not np.array_equal(theta, guess):
        # A simulation that diverges shows no motion, and would at every later window: begin as with the first one.
        return fit(replace(request, theta=guess, noise=None, search=True))
    bounds = bounds_of(lin.information)
    spoilt = not is_excited(bounds) and _noise_is_spoilt(shooting, theta, free)
    if not is_excited(bounds) and not spoilt:
        return FitReply(request.number, excitation=bounds)
    if request.flexible:
        return _flexible(request, theta if noise is not None else _search(request)[0], None if spoilt else noise)
    # 2. Where nothing is known yet: global search, and the sensors' noise.
    sensor = None
    if request.search or noise is None or spoilt:
        theta, sensor = _search(replace(request, noise=None) if spoilt else request)
        # What sensors and model together miss over the segments of the fit.
        noise = _measured(request, FIT_SECONDS, theta, sensor, 8)
        shooting = shooting.with_noise(noise)
        if spoilt and not is_excited(bounds := bounds_of(shooting.linearise(theta, free).information)):
            return FitReply(request.number, excitation=bounds)
    # 3. The optimum.
    result = _polish(shooting, theta, free)
    if not np.isfinite(result.cost):
        return FitReply(request.number, problem="the simulation diverges at every point tried", excitation=bounds)
    lin = result.lin
    # 4. Thrust that the six leave out, a thrust curve freed beside them.
    curved = shooting.free([*NOMINAL_NAMES, "thrust_curve.dead_speed"])
    prior = flexible_prior(prior_of(shooting.vehicle), curved, shooting)
    bent = polish(shooting, result.theta, curved, prior, result.states, iterations=3)
    estimate = WindowEstimate(
        request.start, request.stop, free.scaled(result.theta[free.index]), lin.information, lin.gradient,
        lin.total_cost, lin.total_rows, left_out(Flexible(shooting, curved, prior, bent)),
    )  # fmt: skip
    # 5. Now and then: the noise that this window shows, and whether effects would explain what the six leave.
    measured = None
    if request.measure:
        measured = residual_noise(shooting, result)
        sensor = _measured(request, SWARM_SECONDS, result.theta, noise, 3)
    reply = FitReply(request.number, "", bounds_of(lin.information), True, estimate, result.theta, noise, measured)
    if sensor is None:
        return reply
    lack = lack_of_fit(shooting, result)
    if lack.significant:
        joined = replace(request, vehicle=with_room(request.vehicle))
        return replace(_flexible(joined, result.theta, None), lack=lack)
    inertial = [0, 1, 2, 6, 7, 8]  # of gyro and accelerometer: their noise is the sensor's own, no estimator's
    ratio = (measured or noise).variance / sensor.variance
    return replace(reply, misfit=np.asarray(ratio[inertial]), lack=lack)


def _flexible(request: FitRequest, theta: FloatArray, noise: NoiseModel | None) -> FitReply:
    """The fit with every effect that moves the vehicle; `noise` None lets it find the noise."""
    fitted = flexible_fit(request.windows, request.vehicle, prior_of(request.vehicle), theta, noise)
    best, noise = fitted.best, fitted.problem.noise
    if not np.isfinite(best.cost):
        return FitReply(request.number, "the simulation diverges at every point tried")
    estimate = reduced(request.start, request.stop, fitted)
    # What the motion reveals by itself; how well it is known beside everything else, the estimate says.
    bounds = bounds_of(best.lin.information[:SIX, :SIX])
    missed = sampling_error(estimate, fitted, request.spacing)
    wide = widened(estimate, alike(estimate) * missed)
    return FitReply(
        request.number, "", bounds, is_excited(bounds), wide, best.theta, noise,
        residual_noise(fitted.problem, best) if request.measure else None,
        flexible=True, between_rows=np.sqrt(np.diag(missed)),
    )  # fmt: skip


def prior_of(vehicle: Vehicle) -> Prior:
    """Prior of the nominal six: the vehicle file's, but no tighter than 20 %, as the file knows other flights only."""
    given = [vehicle.parameters[name] for name in NOMINAL_NAMES]
    return Prior(vehicle.initial, np.array([min(max(p.log_sigma, 0.2), p.log_halfwidth) for p in given]))


def is_excited(bounds: FloatArray) -> bool:
    """True if a window reveals roll and pitch dynamics."""
    return bool(np.all(bounds[ROLL_PITCH] <= EXCITED))


def _noise_is_spoilt(shooting: Shooting, theta: FloatArray, free: Free) -> bool:
    """True if the motion suffices with usual noise, and the noise at hand is far above that.

    Noise once taken from bad data would call every later motion too small, and so never be measured again.
    """
    usual = NoiseModel.guess(shooting.channels, shooting.vehicle.noise)
    if not np.any(shooting.noise.variance > 9.0 * usual.variance):
        return False
    return is_excited(bounds_of(shooting.with_noise(usual).linearise(theta, free).information))


def _search(request: FitRequest) -> tuple[FloatArray, NoiseModel]:
    """Global search and sensor noise from short segments, all structure counted as noise."""
    short = Shooting.cut(request.windows, request.vehicle, SWARM_SECONDS, request.noise)
    free = short.free(NOMINAL_NAMES)
    # 48 particles find six parameters that are known to a factor of 4 each way.
    swarm = SwarmOptions(iterations=40)
    theta, _ = swarm_search(short, request.theta, free, swarm, 48, request.seed, lambda stage, share: None)
    short, result = reweighted_fit(short, theta, free, iterations=8)
    return result.theta, residual_noise(short, result)


def _measured(request: FitRequest, seconds: float, theta: FloatArray, noise: NoiseModel, iterations: int) -> NoiseModel:
    """Noise in what a fit to segments of `seconds` [s], from `theta`, leaves: short ones leave that of the sensors."""
    problem = Shooting.cut(request.windows, request.vehicle, seconds, noise)
    return residual_noise(problem, polish(problem, theta, problem.free(NOMINAL_NAMES), iterations=iterations))


def _polish(shooting: Shooting, theta: FloatArray, free: Free) -> Polished:
    """Gauss-Newton to the optimum, then once more with outliers down-weighted."""
    prior = prior_of(shooting.vehicle)
    result = polish(shooting, theta, free, prior, iterations=8)
    if not np.isfinite(result.cost):
        return result
    shooting = shooting.with_robust(robust_weights(shooting, result.lin))
    return polish(shooting, result.theta, free, prior, result.states, iterations=4)


# --- Every effect that moves the vehicle is fitted along


class Flexible(NamedTuple):
    """A fit of everything: the problem with its noise, what is free, its prior, and the optimum."""

    problem: Shooting
    free: Free
    prior: Prior
    best: Polished


def with_room(vehicle: Vehicle) -> Vehicle:
    """The vehicle with wide bounds about its bare guesses, as sure of these as before; bounds that it gives stay."""
    parameters = {}
    for name, given in vehicle.parameters.items():
        bounds = given.bounds or (given.initial / ROOM, given.initial * ROOM)
        sigma = given.sigma or (None if given.bounds else given.log_sigma * given.initial)
        parameters[name] = given.model_copy(update={"bounds": bounds, "sigma": sigma})
    return vehicle.model_copy(update={"parameters": parameters})


def moving_names(problem: Shooting) -> list[str]:
    """The nominal six and every effect that moves the vehicle and that these data could show."""
    windows = [r.window for r in problem.rollouts]
    known = {"readings" if problem.vehicle.command.kind == "rotor_speed" else "commands"}
    known |= {n for n in ("velocity", "battery") if all(getattr(w, n) is not None for w in windows)}
    out = list(NOMINAL_NAMES)
    for effect in EFFECTS.values():
        # Of sensors only what shifts their time is fitted along.
        moves = effect.acts in ("command", "rotor", "air", "body") and not effect.per_log
        moves = moves or effect.name in ("imu_lag", "attitude_delay")
        seen = known.issuperset(effect.needs) and (effect.flexible != "with_velocity" or problem.has_velocity)
        if moves and seen and effect.name != "weak_rotor":
            out += (*effect.entries, *effect.refinements)
    return out + [n for n in problem.layout.entries if n.startswith("weak_rotor.loss_")]


def flexible_prior(nominal: Prior, free: Free, problem: Shooting) -> Prior:
    """Prior of everything that is free: `nominal` of the nominal six, effects about the vehicle file's values."""
    effects = free.index[len(NOMINAL_NAMES) :]
    mean = np.concatenate([nominal.mean, problem.layout.initial(problem.vehicle)[effects]])
    return Prior(mean, np.concatenate([nominal.sigma, np.full(len(effects), EFFECT_WIDTH)]))


def flexible_fit(
    windows: Sequence[Window], vehicle: Vehicle, nominal: Prior, theta: FloatArray, noise: NoiseModel | None
) -> Flexible:
    """Fits everything.

    Args:
        nominal: prior of the nominal six.
        theta: start, full vector.
        noise: None lets the fit find it, all structure that remains counted as noise.
    """
    problem = Shooting.cut(windows, vehicle, FLEXIBLE_SECONDS, noise)
    free = problem.free(moving_names(problem))
    prior = flexible_prior(nominal, free, problem)
    result = polish(problem, theta, free, prior, iterations=12)
    for _ in range(0 if noise is not None else ROUNDS - 1):
        problem = problem.with_noise(residual_noise(problem, result))
        result = polish(problem, result.theta, free, prior, iterations=12)
    if not np.isfinite(result.cost):
        return Flexible(problem, free, prior, result)
    robust = problem.with_robust(robust_weights(problem, result.lin))
    best = polish(robust, result.theta, free, prior, result.states, iterations=4)
    return Flexible(problem, free, prior, best)


def reduced(start: float, stop: float, fitted: Flexible, known: FloatArray | None = None) -> WindowEstimate:
    """Estimate of the nominal six by a window, whatever the effects are; b is that at hover.

    Information counts for less where the scores of segments scatter more than the noise explains (`score_products`).
    `known`: thrust that the six leave out (`left_out`), where that was computed already.
    """
    problem, free, prior, result = fitted
    lin, six = result.lin, SIX
    precision, pull, _ = prior_terms(free, prior, result.theta)
    effects = np.arange(len(precision)) >= six
    h, g, scores = lin.information + np.diag(precision * effects), lin.gradient + pull * effects, lin.grad
    z = free.scaled(result.theta[free.index])[:six]
    # Published is the b at hover, whose derivatives to all scaled parameters are `slopes`.
    weight, stated = problem.vehicle.mass * GRAVITY, ThrustModel.stated(problem.vehicle)
    z[B], slopes = _differences(
        lambda at: np.log(ThrustModel(problem.layout, at).like(stated, weight)), free, result.theta
    )
    back = np.eye(len(g))
    back[B] = -slopes / slopes[B]
    back[B, B] = 1.0 / slopes[B]
    h, g, scores = back.T @ h @ back, back.T @ g, scores @ back
    information, gain = eliminated(h[:six, :six], h[:six, six:], h[six:, six:])
    step = np.linalg.solve(information, g[:six] - gain @ g[six:])
    own = replace(lin, grad=scores[:, :six] - scores[:, six:] @ gain.T)
    excess = np.sqrt(np.maximum(variance_ratio(own, np.asarray(np.linalg.inv(information)))[0], 1.0))
    information = 0.5 * (information + information.T) / np.outer(excess, excess)
    return WindowEstimate(
        start, stop, z, information, information @ step, lin.total_cost, lin.total_rows,
        left_out(fitted) if known is None else known,
    )  # fmt: skip


def halved(window: Window, first: int) -> Window:
    """The window as if only every second row of the rotors had been there, from row `first` (0 or 1) on."""
    at, kept = np.arange(len(window)), np.arange(first, len(window), 2)
    if window.sampling == "held":
        speed = window.rotor_speed[kept[np.maximum((at - first) // 2, 0)]]
    else:
        speed = np.column_stack([np.interp(at, kept, c) for c in window.rotor_speed[kept].T])
    return replace(window, rotor_speed=speed, rotor_slope=None)


def sampling_error(estimate: WindowEstimate, fitted: Flexible, spacing: float) -> FloatArray:
    """Variances of the nominal six, log scale, on the diagonal, shape (6, 6), by what the rotors do between readings.

    Where sticks move in steps and a rate loop rings, torque over inertia is several per cent off and no residual shows
    it; so every second row of the rotors is left out, and how far that moves the estimate tells its error.  What was
    missed enters twice: in step with the motion, with a sign that depends on which rows were left out, and by its
    square, as noise of an input does, which makes every inertia look larger.

    Two trials do not tell which combinations are known better than their parts: a covariance out of them would be
    infinitely sure of four of six, and windows fused with it of all.  Half of the trials' difference is what is in step
    with the motion, their mean what grows with the square; the former falls with the readings' distance to the power
    `ORDER`, the latter to twice that.

    Args:
        estimate: of the windows of `fitted`.
        fitted: the fit that it is of.
        spacing: time between two readings of the rotors [rows].
    """
    best, windows, shifts = fitted.best, [r.window for r in fitted.problem.rollouts], []
    for first in (0, 1):
        sparse = fitted.problem.on([halved(w, first) for w in windows])
        # One linear step tells the size; a descent may refuse every step, and would then tell of no error at all.
        moved = fitted._replace(best=replace(best, lin=sparse.linearise(best.theta, fitted.free, best.states)))
        there = reduced(estimate.start, estimate.stop, moved, estimate.left_out)
        shifts.append(there.optimum - estimate.optimum)
    share = (0.5 * spacing) ** ORDER[windows[0].sampling]
    missed = (share * 0.5 * (shifts[0] - shifts[1])) ** 2 + (share**2 * 0.5 * (shifts[0] + shifts[1])) ** 2
    missed[ROLL_PITCH] = np.mean(missed[ROLL_PITCH])
    return np.diag(missed)


def alike(estimate: WindowEstimate) -> float:
    """Number of windows like this one that err alike: so many times the variance of what they miss counts in each."""
    return max(LASTING / (estimate.stop - estimate.start), 1.0)


def widened(estimate: WindowEstimate, covariance: FloatArray) -> WindowEstimate:
    """The estimate with `covariance`, shape (6, 6), added to its own; its optimum stays."""
    step = np.linalg.solve(estimate.information, estimate.score)
    information = np.linalg.inv(np.linalg.inv(estimate.information) + covariance * estimate.scale)
    information = 0.5 * (information + information.T)
    return replace(estimate, information=information, score=information @ step)


def left_out(fitted: Flexible) -> FloatArray:
    """Thrust beyond b w^2: a row of values and one of their standard deviations, shape (2, R + 1).

    The value of a rotor is the logarithm of its thrust's change with speed at hover, as fitted, over that by the
    published b.  A thrust curve, a support force and an accelerometer of another scale give all rotors the same, a weak
    rotor itself.  The last value tells them apart: the thrust that the fitted law has where no rotor turns, over the
    weight.  A rotor's own curve has none there; what a support carries, or the bias that hides a wrong scale, is there.
    Where no such constant is fitted along, nothing is known of it.
    """
    problem, free, prior, best = fitted
    weight, stated = problem.vehicle.mass * GRAVITY, ThrustModel.stated(problem.vehicle)

    def value(at: FloatArray) -> FloatArray:
        full = ThrustModel(problem.layout, at)
        six = stated.with_b(full.like(stated, weight))
        own = np.log(np.maximum(full.slope(weight), 1e-12) / six.slope(weight))
        return np.append(own, (full.at_rest - six.at_rest) / weight)

    here, steps = _differences(value, free, best.theta)
    covariance = posterior_covariance(best.lin.information, prior)
    excess = np.maximum(variance_ratio(best.lin, covariance)[0], 1.0)
    spread = np.sqrt(excess)[:, None] * steps
    sigma = np.sqrt(np.einsum("pr,pq,qr->r", spread, covariance, spread))
    if all(e.name != "thrust_curve.offset" for e in free.entries):
        here[-1], sigma[-1] = 0.0, 1.0
    return np.stack([here, sigma])


def _differences(value: Callable[[FloatArray], Any], free: Free, theta: FloatArray) -> tuple[Any, FloatArray]:
    """A function of the full vector, and its derivatives to all scaled parameters, one a row."""
    here, step = value(theta), 1e-5
    moved = [value(free.move(theta, one)) for one in step * np.eye(len(free.entries))]
    return here, np.array([(there - here) / step for there in moved])


# --- Whether the window asks for that


def lack_of_fit(problem: Shooting, result: Polished) -> LackOfFit:
    """Score test of the flexible part of everything that moves the vehicle, and of the IMU filter, freed at once.

    Errors of sensors are left out: with them a slow error of the AHRS would look like a lack.
    """
    if problem.count < FEWEST_SEGMENTS:
        return LackOfFit()
    rigid = {n for e in EFFECTS.values() for n in (*e.entries, *e.refinements) if n not in e.flexible_entries}
    rigid |= {n for e in EFFECTS.values() if e.flexible == "never" for n in e.entries}
    free = problem.free([n for n in moving_names(problem) if n not in rigid])
    lin = problem.linearise(result.theta, free)
    weight = np.where(free.is_log, 0.0, 1.0 / EFFECT_WIDTH**2) + 1e-9
    drop = float(lin.gradient @ np.linalg.solve(lin.information + np.diag(weight), lin.gradient))
    return LackOfFit(drop * lin.total_rows / max(lin.total_cost, 1.0), len(weight), lin.total_rows)


def warm_up(vehicle: Vehicle) -> None:
    """Compiles or loads every kernel that a fit needs, on two seconds of made-up hover."""
    rows, dt = 150, 0.02
    speed = np.full((rows, len(vehicle.rotors)), vehicle.hover_speed())
    speed += 5.0 * np.sin(np.arange(rows)[:, None] * 0.3 + np.arange(speed.shape[1]))
    attitude, accel = np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1)), np.tile([0.0, 0.0, -9.80665], (rows, 1))
    for sampling in ("held", "instant"):
        window = Window(0.0, dt, speed, np.zeros((rows, 3)), attitude, accel, sampling=sampling)
        request = FitRequest(0, vehicle, (window,), 0.0, 3.0, Layout(vehicle).initial(vehicle), None, True, 0)
        theta, noise = _search(request)
        shooting = Shooting.cut((window,), vehicle, FIT_SECONDS, noise)
        _polish(shooting, theta, shooting.free(NOMINAL_NAMES))
