"""The fit of one window, which a worker does beside the session: a pure function of its request.

The model is that of `quadid.estimate`: a Kalman filter with random forces and moments, whose innovations are the
likelihood.  The first fit, and each one after a change, searches globally and then climbs to the likelihood's maximum
over all that there is, noise and random forces with it.  Every later one is a step of a recursion: the filter passes
over the window with the gains of the noise numbers at hand, and what its newest rows say is handed back: information
and slope, which add.  Rows before them only bring the filter's state, and its derivatives, to where the new ones begin,
so that none is counted twice, and no border takes information away.  All are linearised at one point; where twice as
much was flown as it rests on, steps to the maximum over all of that lead to another, where all rows are estimated anew.

Free are the nominal six, trim moment, biases, what acts on every vehicle beside them (`filter_error.ALONG`), and a
thrust curve.  What else thrust may have is looked at beside that and never published: a support, each rotor's loss.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np

from quadid.data.window import Window
from quadid.effects import butterworth_delay
from quadid.estimate import kalman as k
from quadid.estimate.fit import ALL_NOISE, estimate, of_square, scoring
from quadid.estimate.kalman import Gains
from quadid.estimate.late_imu import MOST, delay_of, in_time
from quadid.estimate.problem import TRIMMED, UPRIGHT, Problem, Sensitivities
from quadid.estimate.track import from_window
from quadid.identification.filter_error import INFLOW, UNCOUPLED, fitted_along, start_of
from quadid.identification.fit import SWARM_SECONDS, swarm_search
from quadid.identification.particle_swarm import SwarmOptions
from quadid.identification.problem import Prior, Shooting
from quadid.identification.uncertainty import bounds_of, coarse
from quadid.model.layout import IMU_PERIOD, Layout
from quadid.online.checks import wrong_unit
from quadid.online.gate import with_room
from quadid.online.records import Job, JobReply
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray, check_shapes
from quadid.vehicle import GRAVITY, Vehicle

SIX = len(NOMINAL_NAMES)
ROLL_PITCH = [NOMINAL_NAMES.index(name) for name in ("J_xx", "J_yy")]

EXCITED = 0.02
"""A window is excited when it would give roll and pitch inertia to this relative standard deviation by itself, in calm
air and with usual sensors."""
EXCITED_SECONDS = 1.66
"""Length of the runs from which that is computed [s]."""
TURNS = 1
"""Steps in which the noise numbers follow those of a window: what is pooled settles."""
BEYOND = 2.0
"""An estimate may lie so far outside the bounds, log scale: the step from where it was linearised."""
NUDGE = 1e-3
"""Difference of a scaled effect of thrust for its derivative."""
CURVE = "thrust_curve.dead_speed"
"""Free as inflow and coupling are: without it, a rotor whose thrust is nearly straight makes inertias too large; see
`Curve`.  Without evidence fusion takes curve and lack of coupling to be none."""
SUPPORT = "thrust_curve.offset"
"""Likewise: a support, or a bias of the accelerometer, looks like a curve at hover."""
LOOSE = 4
"""Rows of `WindowEstimate.loose`: an answer of the rotors within a step about each axis, and their noise."""


@dataclass(frozen=True)
class Noise:
    """Noise of a flight, as the filter has it.

    Attributes:
        psi: noise numbers, shape (N_NOISE,).
        tail: see `kalman.kalman`, shape (4,).
        control: unit of what is random, see `problem.control_moment`, shape (3,).
        doubt: relative standard deviation of the variance of rotor speeds.
        late: delay of gyro and accelerometer that is undone first [s], see `late_imu`.
    """

    psi: FloatArray
    tail: FloatArray
    control: FloatArray
    doubt: float
    late: float = 0.0


@dataclass(frozen=True)
class WindowEstimate:
    """Share of some rows in the likelihood: a quadratic model of half its -2 ln, by all `names_of` a vehicle.

    Attributes:
        start, stop: time of the rows [s].
        z: scaled parameters where it was linearised, shape (P,).
        information: Fisher information of the rows there, without prior, shape (P, P).
        score: half the gradient there, shape (P,).
        cost: sum of squares there, of whitened innovations; rows: their number, so that cost / rows is about 1.
        noise: information that noise of rotor speeds takes away, shape (P, P), not in `information`.
        loose: slopes that are known by their size only, shape (LOOSE, P).
        half_information, half_score: the same from every second row, shapes (P, P) and (P,).
    """

    start: float
    stop: float
    z: FloatArray
    information: FloatArray
    score: FloatArray
    cost: float
    rows: float
    noise: FloatArray
    loose: FloatArray
    half_information: FloatArray
    half_score: FloatArray

    @property
    def mse(self) -> float:
        """Mean squared whitened innovation; about 1."""
        return self.cost / max(self.rows, 1.0)

    @property
    def finite(self) -> bool:
        """True if it contains finite numbers only."""
        arrays = (self.z, self.information, self.score, self.noise, self.loose, self.half_information, self.half_score)
        return math.isfinite(self.cost) and all(bool(np.isfinite(a).all()) for a in arrays)


@dataclass(frozen=True)
class FitReply(JobReply):
    """Answer to a request.

    Attributes:
        excitation: relative standard deviations that motion like this allows, shape (6,); None after a failure.
        excited: whether they suffice.
        estimates: quadratic models, one a span.
        theta: full parameter vector where it was linearised.
        noise: found by this fit; None: the request's still holds.
        fault: a wrong unit or frame of the windows, for which they were not fitted; or empty.
    """

    excitation: FloatArray | None = None
    excited: bool = False
    estimates: tuple[WindowEstimate, ...] = ()
    theta: FloatArray | None = None
    noise: Noise | None = None
    fault: str = ""

    @property
    def finite(self) -> bool:
        """True if its estimates contain finite numbers only."""
        return all(e.finite for e in self.estimates)


@dataclass(frozen=True)
class FitRequest(Job):
    """A window to be fitted.

    Attributes:
        theta: full parameter vector to start from.
        z: scaled parameters (`names_of`) where to linearise, or to begin, shape (P,).
        noise: None: nothing is known yet, or the vehicle has changed: search first.
        seed: of the swarm.
        spans: begin and end [s] of the rows of each estimate.
        learned: stretches of all of them where steps to the maximum over these lead to where to linearise, else none.
        measure: let the noise numbers follow this window.
    """

    reply = FitReply

    theta: FloatArray
    z: FloatArray
    noise: Noise | None
    seed: int
    spans: tuple[tuple[float, float], ...]
    learned: tuple[Window, ...] = ()
    measure: bool = False

    @property
    def is_long(self) -> bool:
        """True where it may take seconds."""
        return self.noise is None or bool(self.learned)

    def answer(self) -> FitReply:
        """Fits the windows."""
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                return fit(self)
        except np.linalg.LinAlgError:
            return FitReply(self.number, problem="the filter runs away from this window")

    def is_answered_by(self, reply: object) -> TypeGuard[JobReply]:
        """True if a reply is to this job, and of its form."""
        if not (super().is_answered_by(reply) and isinstance(reply, FitReply)):
            return False
        return (
            (reply.excitation is None or reply.excitation.shape == (SIX,))
            and (reply.noise is None or _is_noise(reply.noise, _known_delay(self) or MOST))
            and _are_estimates(reply.estimates, self)
            and (not reply.estimates or reply.noise is not None or self.noise is not None)
            and (reply.theta is None or _is_vector(reply.theta, self.theta) or not reply.finite)
        )


def _is_noise(noise: Noise, latest: float) -> bool:
    shapes = noise.psi.shape, noise.tail.shape, noise.control.shape
    if shapes != ((k.N_NOISE,), (4,), (3,)) or not (0.0 <= noise.doubt < math.inf and 0.0 <= noise.late <= latest):
        return False
    return all(bool(np.isfinite(a).all() and np.all(a >= 0.0)) for a in (noise.psi, noise.tail, noise.control))


def _is_vector(theta: FloatArray, asked: FloatArray) -> bool:
    """Finite and possible."""
    return theta.shape == asked.shape and bool(np.isfinite(theta).all() and np.all(theta[:SIX] > 0.0))


def _are_estimates(estimates: tuple[WindowEstimate, ...], request: FitRequest) -> bool:
    """None, or one a span, all linearised at one point."""
    if estimates and tuple((e.start, e.stop) for e in estimates) != request.spans:
        return False
    return all(_is_estimate(e, request) and np.array_equal(e.z, estimates[0].z, equal_nan=True) for e in estimates)


def _is_estimate(estimate: WindowEstimate, request: FitRequest) -> bool:
    """An estimate of this vehicle; one without finite numbers is refused later, with that reason."""
    P = len(request.z)
    vectors = estimate.z, estimate.score, estimate.half_score
    squares = estimate.information, estimate.noise, estimate.half_information
    if any(a.shape != (P,) for a in vectors) or any(a.shape != (P, P) for a in squares):
        return False
    if estimate.loose.shape != (LOOSE, P):
        return False
    if not estimate.finite:
        return True
    low, high = np.log([request.vehicle.limits(name) for name in NOMINAL_NAMES]).T
    if np.any(estimate.z[:SIX] < low - BEYOND) or np.any(estimate.z[:SIX] > high + BEYOND):
        return False
    values = np.linalg.eigvalsh(0.5 * (estimate.information + estimate.information.T))
    return bool(values[0] >= -1e-9 * max(values[-1], 1.0)) and estimate.rows > 0.0


# --- What is free


def own_names(vehicle: Vehicle) -> tuple[str, ...]:
    """Parameters that are estimated: the nominal six, trim and biases, and what acts on every vehicle."""
    layout = Layout(vehicle)
    initial, neutral = layout.initial(vehicle), layout.neutral()
    stated = {name.split(".")[0] for name, e in layout.entries.items() if initial[e.index] != neutral[e.index]}
    more = (name for name in (INFLOW, UNCOUPLED) if name.split(".")[0] not in stated)
    return (*NOMINAL_NAMES, *TRIMMED, UPRIGHT, *fitted_along(stated), *more, CURVE)


def thrust_names(vehicle: Vehicle) -> tuple[str, ...]:
    """Effects of thrust beside b and its curve: what is there while no rotor turns, and a loss of each rotor."""
    losses = [n for n in Layout(vehicle).entries if n.startswith("weak_rotor.loss_")]
    return (SUPPORT, *losses)


def names_of(vehicle: Vehicle) -> tuple[str, ...]:
    """Names of all scaled parameters, shape (P,)."""
    return (*own_names(vehicle), *thrust_names(vehicle))


def prior_of(vehicle: Vehicle) -> Prior:
    """Prior of the nominal six: the vehicle file's, but no tighter than 20 %, as the file rests on other flights."""
    given = [vehicle.parameters[name] for name in NOMINAL_NAMES]
    return Prior(vehicle.initial, np.array([min(max(p.log_sigma, 0.2), p.log_halfwidth) for p in given]))


def problem_of(window: Window, vehicle: Vehicle) -> Problem:
    """Likelihood of a window by what is estimated; a guess may turn out to be farther off than what was searched."""
    along = [n for n in own_names(vehicle)[SIX + len(TRIMMED) + 1 :] if n != INFLOW or window.velocity is not None]
    theta = Layout(vehicle).initial(vehicle)
    return Problem.of([from_window(window, vehicle, air=True)], with_room(vehicle), along, [window], theta)


# --- Scaled parameters of the recursion, and as the filter has them


class Curve:
    """Thrust curve of a vehicle, and a support of it, beside what its file has.

    By their own numbers these and the six are hard to tell apart.  In the recursion b is that with which the file's
    curve, of dead speed w_s and offset T_s, carries the weight at the hover speed w_h of the flown one, and the other
    five go with its slope there: curve and support hardly change those.  With u = w_h - w_0 and q = w_h - w_s above the
    flown dead speed w_0 and the file's, where a curve alone leaves the thrust at rest as it is and a support adds T_r,

        b_s q^2 = m g / R - T_s = b (u^2 + e) + T_r,  e = min(w_s, 0)^2 - min(w_0, 0)^2,  s = b u / (b_s q)      (1)
        log b_s = z_b,  log of d, J_xx, J_yy, J_zz, J_r = z + log s
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """Takes the curve of the vehicle file."""
        layout = Layout(vehicle)
        initial, curve, support = layout.initial(vehicle), layout.entry(CURVE), layout.entry(SUPPORT)
        self._at = len(own_names(vehicle)) - 1
        self._sizes = np.array([curve.typical, support.typical])
        self.dead, self.offset = float(initial[curve.index]), float(initial[support.index])
        self._weight = vehicle.mass * GRAVITY / len(vehicle.rotors) - self.offset

    def beside(self, z: FloatArray) -> tuple[float, float]:
        """Flown dead speed w_0 [rad/s] and support T_r [N]."""
        dead, support = (z[self._at : self._at + 2] * self._sizes).tolist()
        return dead, min(support, 0.9 * self._weight)

    def law(self, z: FloatArray) -> tuple[float, float, float]:
        """Flown b, dead speed [rad/s] and offset [N]."""
        (dead, support), square = self.beside(z), self._above(z)[2]
        b = (self._weight - support) / square
        return b, dead, self.offset + support + b * self._rest(dead)

    def filtered(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scaled parameters (P,) as the filter has them, and their derivatives by those of the recursion (P, P)."""
        (dead, support), (q, u, square) = self.beside(z), self._above(z)
        carried, by_dead = self._weight - support, 2.0 * (u + min(dead, 0.0)) / square
        out, slopes, beside = z.copy(), np.eye(len(z)), slice(self._at, self._at + 2)
        out[:SIX] += math.log(q * u / square * carried / self._weight)
        out[k.B] = math.log(carried / square)
        slopes[:SIX, k.B] += q * u / square - 0.5 * q / u - 0.5
        slopes[:SIX, beside] = self._sizes * [by_dead - 1.0 / u, -1.0 / carried]
        slopes[k.B, k.B], slopes[k.B, self._at] = q * u / square, self._sizes[0] * by_dead
        return out, slopes

    def fused(self, z: FloatArray) -> FloatArray:
        """Inverse of `filtered`, shape (P,)."""
        (dead, support), out = self.beside(z), z.copy()
        carried = self._weight - support
        square = carried / math.exp(z[k.B])
        u = math.sqrt(square - self._rest(dead))
        q = u + dead - self.dead
        out[:SIX] -= math.log(q * u / square * carried / self._weight)
        out[k.B] = math.log(self._weight / q**2)
        return out

    def _above(self, z: FloatArray) -> tuple[float, float, float]:
        """Speeds q and u, and u^2 + e of Eq. 1; u is a tenth of q at least."""
        dead, q = self.beside(z)[0], math.sqrt(self._weight / math.exp(z[k.B]))
        u = max(q + self.dead - dead, 0.1 * q)
        return q, u, u**2 + self._rest(dead)

    def _rest(self, dead: float) -> float:
        """Square e of Eq. 1."""
        return float(min(self.dead, 0.0) ** 2 - min(dead, 0.0) ** 2)


# --- The fit


def fit(request: FitRequest) -> FitReply:
    """Fits a window: the maximum where nothing is known yet, else one step of the recursion."""
    # 0. Units and frames, beside the session; it has asked for those of a vehicle that is not known yet.
    if request.noise is not None and (fault := wrong_unit(request.windows)):
        return FitReply(request.number, fault=fault)
    # 1. What the motion reveals.
    bounds = _excitation(request)
    if bounds is None:
        return FitReply(request.number, "no stretch is long enough for one segment")
    if not is_excited(bounds):
        return FitReply(request.number, excitation=bounds)
    # 2. Gyro and accelerometer in time.
    late, period = _late(request), request.theta[IMU_PERIOD]
    request = _in_time(request, late)
    # 3. The maximum of the likelihood: from a global search where nothing is known yet, or a delay shows first, else
    # over much more than before; now and then the noise numbers of this window.
    z, noise, found = request.z, request.noise, None
    if noise is None or (request.learned and (late > 0.0) != (noise.late > 0.0)):
        z, noise = _maximum(request, late, *_searched(request))
        found = noise
        if not np.isfinite(z).all():
            return FitReply(request.number, problem="the simulation diverges at every point tried", excitation=bounds)
    elif request.learned:
        problem, begin, _ = _like(max(request.learned, key=len), request.vehicle, z, noise)
        better, renewed = _maximum(request, late, problem, begin)
        if np.isfinite(better).all():
            z, noise = better, renewed
        found = noise
    elif request.measure:
        found = _followed(request, noise)
    # 4. What the new rows say.
    estimates, theta = _estimates(request, z, noise)
    theta[IMU_PERIOD] = period
    return FitReply(request.number, "", bounds, True, estimates, theta, found)


def _known_delay(request: FitRequest) -> float | None:
    cutoff = request.vehicle.effects.get("imu_lag", {}).get("cutoff")
    return None if cutoff is None else butterworth_delay(cutoff)


def _late(request: FitRequest) -> float:
    """Delay of gyro and accelerometer [s]: by the vehicle file's low-pass, or as the flight shows it."""
    known = _known_delay(request)
    if known is not None:
        return known
    if request.noise is not None and not request.learned:
        return request.noise.late
    return delay_of(request.learned or request.windows)


def _in_time(request: FitRequest, late: float) -> FitRequest:
    """The request with gyro and accelerometer as they were before a low-pass."""
    effects = {name: values for name, values in request.vehicle.effects.items() if name != "imu_lag"}
    windows, learned = (tuple(in_time(w, late) for w in part) for part in (request.windows, request.learned))
    vehicle, theta = request.vehicle.model_copy(update={"effects": effects}), request.theta.copy()
    theta[IMU_PERIOD] = 0.0
    return replace(request, vehicle=vehicle, windows=windows, learned=learned, theta=theta)


def is_excited(bounds: FloatArray) -> bool:
    """True if a window reveals roll and pitch dynamics."""
    return bool(np.all(bounds[ROLL_PITCH] <= EXCITED))


def _excitation(request: FitRequest) -> FloatArray | None:
    """Relative standard deviations that the motion allows, shape (6,); None where no stretch is long enough."""
    shooting = Shooting.cut(request.windows, request.vehicle, EXCITED_SECONDS, None)
    if shooting.count == 0:
        return None
    free = shooting.free(NOMINAL_NAMES)
    for theta in (request.theta, shooting.layout.initial(request.vehicle)):
        lin = shooting.linearise(theta, free)
        if np.isfinite(lin.total_cost):
            break
    return bounds_of(lin.information)


def _searched(request: FitRequest) -> tuple[Problem, FloatArray]:
    """Likelihood of the longest window, and where a global search ends."""
    vehicle, short = request.vehicle, Shooting.cut(request.windows, request.vehicle, SWARM_SECONDS, None)
    # 48 particles find six parameters that are known to a factor of 4 each way.
    swarm, free = SwarmOptions(iterations=40), short.free(NOMINAL_NAMES)
    theta, _ = swarm_search(short, request.theta, free, swarm, 48, request.seed, lambda stage, share: None)
    problem = problem_of(max(request.learned or request.windows, key=len), vehicle)
    return problem, start_of(problem, theta, own_names(vehicle))


def _maximum(request: FitRequest, late: float, problem: Problem, begin: FloatArray) -> tuple[FloatArray, Noise]:
    """Scaled parameters (P,) and noise of the largest likelihood, from `begin`; not finite where there is none.

    Random forces are large at first: with those of a calm flight the steps stop early once it is rough.
    """
    found = estimate(problem, begin)
    z, support = np.zeros(len(request.z)), problem.layout.entry(SUPPORT)
    curve = Curve(request.vehicle)
    z[len(own_names(request.vehicle))] = (problem.theta[support.index] - curve.offset) / support.typical
    z[_places(found.problem, request.vehicle)] = found.z
    doubt = of_square(found.problem, found.z, found.psi, found.problem.passes(found.z, found.psi)[1])
    return curve.fused(z), Noise(found.psi, found.problem.tail, found.problem.control, doubt, late)


def _places(problem: Problem, vehicle: Vehicle) -> list[int]:
    names = names_of(vehicle)
    return [names.index(name) for name, *_ in problem.entries]


def _like(window: Window, vehicle: Vehicle, z: FloatArray, noise: Noise) -> tuple[Problem, FloatArray, FloatArray]:
    """Likelihood of a window in the noise's units, scaled parameters (N,) at z, and their derivatives by z (N, P)."""
    shapes = ("psi", noise.psi, (k.N_NOISE,)), ("tail", noise.tail, (4,)), ("control", noise.control, (3,))
    check_shapes("filter", ("z", z, (len(names_of(vehicle)),)), *shapes)
    problem, curve = problem_of(window, vehicle), Curve(vehicle)
    own, by_z = (part[_places(problem, vehicle)] for part in curve.filtered(z))
    theta = problem.theta.copy()
    theta[problem.layout.entry(SUPPORT).index] = curve.offset + curve.beside(z)[1]
    problem = replace(problem, theta=theta, control=noise.control, tail=noise.tail)
    return replace(problem.based_on(own)[0], control=noise.control).along(own, noise.psi), own, by_z


def _followed(request: FitRequest, noise: Noise) -> Noise:
    """The noise numbers after one step towards those of this window."""
    problem, own, _ = _like(max(request.windows, key=len), request.vehicle, request.z, noise)
    _, psi, value, *_ = scoring(problem, own, noise.psi, TURNS, ALL_NOISE, physics=False)
    return replace(noise, psi=psi) if math.isfinite(value) else noise


def _estimates(request: FitRequest, z: FloatArray, noise: Noise) -> tuple[tuple[WindowEstimate, ...], FloatArray]:
    """Estimate of the rows of each span, by all parameters; full vector where they are linearised."""
    vehicle, count, theta = request.vehicle, len(z), request.theta
    vector, square, loose = np.zeros(count), np.zeros((count, count)), np.zeros((LOOSE, count))
    out = [WindowEstimate(*span, z, square, vector, 0.0, 0.0, square, loose, square, vector) for span in request.spans]
    for window in request.learned or request.windows:
        # 1. Innovations and their derivatives, and the same on every second row.
        sparse = coarse(window)
        problem, own, E, gains, near = _linearised(window, vehicle, z, noise)
        *_, half = _linearised(sparse, vehicle, z, noise)
        # 2. What noise of rotor speeds makes of it, and an answer of the rotors within a step.
        slope, curvature = problem.unbiased(own, noise.psi, gains).taken
        slope, curvature = slope @ E, E.T @ curvature @ E
        unsure = np.vstack([0.5 * problem.within_a_step(own, gains) @ E, noise.doubt * slope])
        for i, e in enumerate(out):
            start, stop = e.start - 0.5 * window.dt, e.stop - 0.5 * window.dt
            new, half_new = ((w.t > start) & (w.t < stop) for w in (window, sparse))
            share, (information, score) = float(np.mean(new)), near.quadratic(new)
            of_half = half.quadratic(half_new)
            out[i] = replace(
                e,
                information=e.information + information,
                score=e.score + score - share * slope,
                cost=e.cost + float(np.sum(near.plain[new] ** 2)),
                rows=e.rows + 3.0 * np.count_nonzero(problem.tracks[0].seen[new]),
                noise=e.noise + share * curvature,
                loose=e.loose + share * unsure,
                half_information=e.half_information + of_half[0],
                half_score=e.half_score + of_half[1],
            )
        theta = problem.vector(own, 0)
    # The six go with the vehicle file's curve.
    layout = Layout(vehicle)
    curve = [layout.entry(name).index for name in (CURVE, SUPPORT)]
    theta[:SIX], theta[curve] = np.exp(z[:SIX]), layout.initial(vehicle)[curve]
    return tuple(out), theta


def _linearised(
    window: Window, vehicle: Vehicle, z: FloatArray, noise: Noise
) -> tuple[Problem, FloatArray, FloatArray, list[Gains], Sensitivities]:
    """Likelihood of a window near z.

    Returns:
        The problem; its scaled parameters (N,) and their derivatives by z (N, P); gains; sensitivities by z.
    """
    problem, own, by_z = _like(window, vehicle, z, noise)
    gains = problem.passes(own, noise.psi)[1]
    by_own = problem.sensitivities(0, own, noise.psi, gains[0])
    J = np.tensordot(by_z, by_own.J, (0, 0))
    J[len(own_names(vehicle)) :] += _by_thrust(problem, own, noise, gains[0], by_own.plain)
    return problem, own, by_z, gains, by_own._replace(entries=list(range(len(J))), J=J)


def _by_thrust(problem: Problem, z: FloatArray, noise: Noise, gains: Gains, plain: FloatArray) -> FloatArray:
    """Derivatives of whitened innovations, `plain` (n, M), by what thrust may have beside b, shape (R + 2, n, M).

    A rotor that loses turns as it did, with less thrust and drag torque.  A loss of all rotors is b itself; a rotor's
    is what it loses beyond their mean.
    """
    p, track = problem.physics(z, 0), problem.tracks[0]._replace(beyond=gains.beyond)
    table, turns = k.moments(track, *k.turning(p)), np.arange(3 * k.MOMENTS) % k.MOMENTS >= 4

    def whitened(physics: FloatArray, moments: FloatArray) -> FloatArray:
        out = np.zeros_like(plain)
        k.replay(track, physics, noise.psi, gains, moments, out)
        return out

    out = []
    for name in thrust_names(problem.vehicle):
        step = NUDGE * problem.layout.entry(name).typical
        if name == SUPPORT:
            moved = p.copy()
            moved[k.OFFSET] += step
            nudged = whitened(moved, k.moments(track, *k.turning(moved)))
        else:
            share = track.share.copy()
            share[:, int(name.rsplit("_", 1)[1]) - 1] *= 1.0 - step
            less = k.moments(track._replace(share=share), *k.turning(p))
            nudged = whitened(p, np.where(turns, table, less))
        out.append((nudged - plain) / NUDGE)
    by = np.array(out)
    by[1:] -= by[1:].mean(axis=0)
    return by


def warm_up(vehicle: Vehicle) -> None:
    """Compiles or loads every kernel that a fit needs, on two seconds of made-up flight."""
    rows, dt = 100, 0.02
    swing = np.sin(np.arange(rows)[:, None] * 0.3 + np.arange(len(vehicle.rotors)))
    speed = vehicle.hover_speed() + 5.0 * swing
    attitude, accel = np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1)), np.tile([0.0, 0.0, -9.80665], (rows, 1))
    gyro, z = 0.3 * np.cos(np.arange(rows)[:, None] * [0.3, 0.29, 0.2]), np.zeros(len(names_of(vehicle)))
    window, span = Window(0.0, dt, speed, gyro, attitude, accel), (0.0, rows * dt)
    theta = Layout(vehicle).initial(vehicle)
    request = FitRequest(0, vehicle, (window,), *span, theta, z, None, 0, (span,))
    with suppress(np.linalg.LinAlgError):
        _estimates(request, *_maximum(request, 0.0, *_searched(request)))
