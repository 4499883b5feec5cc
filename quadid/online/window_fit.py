"""The fit of one window: what the background worker does.  A pure function of its request."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np

from quadid.data.window import Window
from quadid.identification.excitation import bounds_of
from quadid.identification.gauss_newton import Polished, polish, robust_weights
from quadid.identification.noise import NoiseModel
from quadid.identification.noise_fit import residual_noise, reweighted_fit
from quadid.identification.particle_swarm import SwarmOptions
from quadid.identification.problem import Free, Prior, Shooting
from quadid.identification.search import SWARM_SECONDS, swarm_search
from quadid.model.layout import Layout
from quadid.model.rollout import channels_of
from quadid.online.flexible_fit import (
    alike,
    flexible_fit,
    flexible_prior,
    left_out,
    reduced,
    sampling_error,
    widened,
    with_room,
)
from quadid.online.fusion import WindowEstimate
from quadid.online.lack_of_fit import LackOfFit, lack_of_fit
from quadid.online.records import Job, JobReply
from quadid.online.reply_validation import SIX, is_estimate, is_noise, is_vector
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

FIT_SECONDS = 1.66
"""Length of the shooting segments [s]: six of them fill a window, one a short stretch.

What happens across their borders is lost with the free states there.  The time between refits is no multiple of it, so
windows that overlap have their borders at different places, and fused they see nearly all.
"""
SEARCH = SwarmOptions(iterations=40)
PARTICLES = 48
"""Swarm of the first fit: six parameters, a factor of 4 each way."""
EXCITED = 0.02
"""A window is excited when roll and pitch inertia can be had from it alone to this relative standard deviation."""
TIGHTEST = 0.2
"""Smallest standard deviation (log scale) that a vehicle file's own may have as a prior online."""
INFLATED = 9.0
"""Noise whose variance is above this multiple of the usual in some channel may have been taken from bad data."""
RATED = ("J_xx", "J_yy")
"""Parameters whose bound decides on excitation."""
INERTIAL = (0, 1, 2, 6, 7, 8)
"""Residual channels of gyro and accelerometer: their noise is the sensor's own, no estimator's."""


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
        return _fit(self)

    def is_answered_by(self, reply: object) -> TypeGuard[JobReply]:
        """Whether a reply is to this job, and of its form."""
        if not (super().is_answered_by(reply) and isinstance(reply, FitReply)):
            return False
        channels = min(map(channels_of, self.windows), default=0)
        estimate = reply.estimate
        return (
            all(a is None or a.shape == (SIX,) for a in (reply.excitation, reply.misfit, reply.between_rows))
            and all(n is None or is_noise(n, channels) for n in (reply.noise, reply.measured))
            and (
                reply.theta is None or is_vector(reply.theta, self.theta, estimate is not None and not estimate.finite)
            )
            and (estimate is None or is_estimate(estimate, self.vehicle, self.start, self.stop))
        )


def prior_of(vehicle: Vehicle) -> Prior:
    """Prior of the nominal six: the vehicle file's, but not tighter than `TIGHTEST`; it knows other flights."""
    given = [vehicle.parameters[name] for name in NOMINAL_NAMES]
    return Prior(vehicle.initial, np.array([min(max(p.log_sigma, TIGHTEST), p.log_halfwidth) for p in given]))


def _fit(request: FitRequest) -> FitReply:
    theta, noise = request.theta, request.noise
    shooting = Shooting.cut(request.windows, request.vehicle, FIT_SECONDS, noise)
    if shooting.count == 0:
        return FitReply(request.number, "no stretch is long enough for one segment")
    free = shooting.free(NOMINAL_NAMES)
    lin, guess = shooting.linearise(theta, free), shooting.layout.initial(request.vehicle)
    if not np.isfinite(lin.total_cost) and not np.array_equal(theta, guess):
        # A simulation that diverges shows no motion, and would at every later window: begin as with the first one.
        return _fit(replace(request, theta=guess, noise=None, search=True))
    bounds = bounds_of(lin.information)
    spoilt = not is_excited(bounds) and _noise_is_spoilt(shooting, theta, free)
    if not is_excited(bounds) and not spoilt:
        return FitReply(request.number, excitation=bounds)
    if request.flexible:
        if noise is None:
            theta, _ = _search(request)
        return _flexible(request, theta, None if spoilt else noise)
    sensor = None
    if request.search or noise is None or spoilt:
        theta, sensor = _search(replace(request, noise=None) if spoilt else request)
        # What sensors and model together miss over the segments of the fit.
        noise = _measured(request, FIT_SECONDS, theta, sensor, 8)
        shooting = shooting.with_noise(noise)
        if spoilt and not is_excited(bounds := bounds_of(shooting.linearise(theta, free).information)):
            return FitReply(request.number, excitation=bounds)
    result = _polish(shooting, theta, free)
    if not np.isfinite(result.cost):
        return FitReply(request.number, problem="the simulation diverges at every point tried", excitation=bounds)
    lin = result.lin
    estimate = WindowEstimate(
        request.start, request.stop, free.scaled(result.theta[free.index]), lin.information, lin.gradient,
        lin.total_cost, lin.total_rows, _curved(shooting, result),
    )  # fmt: skip
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
    return replace(reply, misfit=_share_of(measured or noise, sensor), lack=lack)


def _curved(shooting: Shooting, result: Polished) -> FloatArray:
    """Thrust that the nominal six leave out (`left_out`), a thrust curve freed beside them."""
    free = shooting.free([*NOMINAL_NAMES, "thrust_curve.dead_speed"])
    prior = flexible_prior(prior_of(shooting.vehicle), free, shooting)
    return left_out(shooting, free, prior, polish(shooting, result.theta, free, prior, result.states, iterations=3))


def _share_of(noise: NoiseModel, sensor: NoiseModel) -> FloatArray:
    return np.asarray((noise.variance / sensor.variance)[list(INERTIAL)])


def _flexible(request: FitRequest, theta: FloatArray, noise: NoiseModel | None) -> FitReply:
    """The fit with every effect that moves the vehicle; `noise` None lets it find the noise."""
    nominal = prior_of(request.vehicle)
    shooting, free, prior, result = flexible_fit(request.windows, request.vehicle, nominal, theta, noise)
    if not np.isfinite(result.cost):
        return FitReply(request.number, "the simulation diverges at every point tried")
    estimate = reduced(request.start, request.stop, shooting, free, prior, result)
    # What the motion reveals by itself; how well it is known beside everything else, the estimate says.
    bounds = bounds_of(result.lin.information[: len(NOMINAL_NAMES), : len(NOMINAL_NAMES)])
    missed = sampling_error(estimate, shooting, free, prior, result, request.spacing)
    wide = widened(estimate, alike(estimate) * missed)
    reply = FitReply(
        request.number, "", bounds, is_excited(bounds), wide, result.theta, shooting.noise,
        flexible=True, between_rows=np.sqrt(np.diag(missed)),
    )  # fmt: skip
    return replace(reply, measured=residual_noise(shooting, result)) if request.measure else reply


def is_excited(bounds: FloatArray) -> bool:
    """Whether a window reveals roll and pitch dynamics."""
    return bool(np.all(bounds[[NOMINAL_NAMES.index(name) for name in RATED]] <= EXCITED))


def _noise_is_spoilt(shooting: Shooting, theta: FloatArray, free: Free) -> bool:
    """Whether the motion suffices with usual noise, and the noise at hand is far above that.

    Noise once taken from bad data would call every later motion too small, and so never be measured again.
    """
    usual = NoiseModel.guess(shooting.channels, shooting.vehicle.noise)
    if not np.any(shooting.noise.variance > INFLATED * usual.variance):
        return False
    return is_excited(bounds_of(shooting.with_noise(usual).linearise(theta, free).information))


def _search(request: FitRequest) -> tuple[FloatArray, NoiseModel]:
    """Global search and sensor noise from short segments, all structure counted as noise."""
    short = Shooting.cut(request.windows, request.vehicle, SWARM_SECONDS, request.noise)
    free = short.free(NOMINAL_NAMES)
    theta, _ = swarm_search(short, request.theta, free, SEARCH, PARTICLES, request.seed, lambda stage, share: None)
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
