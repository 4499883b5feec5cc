"""The fit of a window that the vehicle file's model misses: every effect that moves the vehicle is fitted along.

Nothing is selected.  Each effect is held near the vehicle file's value by a few of its typical sizes, and has a value
of its own in each window: what cannot be told from the parameters widens their intervals instead of bending them.
Segments are short, because what no effect describes grows with their length.

What is left of a window is a quadratic model in the nominal six, the effects eliminated (Schur complement).  Its b is
the one with which the vehicle file's own model carries the weight at the same speed (`ThrustModel.like`): all rotors
count alike, and all windows share it, unlike the steepness of a curve.  What the six leave out of the thrust is told
beside them (`left_out`).

What the rotors do between two readings is not seen.  Where sticks move in steps and a rate loop rings, torque over
inertia is several per cent off and no residual says so; so every second row of the rotors is left out, and how far that
moves the estimate tells its error.  What was missed enters twice: in step with the motion, with a sign that depends on
which rows were left out, and by its square, as noise of an input does, which makes every inertia look larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quadid.data.window import Sampling, Window
from quadid.effects import EFFECTS
from quadid.identification.elimination import eliminated
from quadid.identification.gauss_newton import Polished, polish, robust_weights
from quadid.identification.noise import NoiseModel
from quadid.identification.noise_fit import residual_noise
from quadid.identification.problem import Free, Prior, Shooting, posterior_covariance, prior_terms
from quadid.identification.uncertainty import variance_ratio
from quadid.model.layout import B, ThrustModel
from quadid.online.fusion import WindowEstimate
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

SEGMENT = 0.5
"""Length of the shooting segments [s]."""
EFFECT_WIDTH = 3.0
"""Prior width of an effect, in its typical size."""
ROUNDS = 4
"""Fits after which the noise that the fit leaves has settled, where none is known."""
STEP = 1e-5
"""Of differences, in scaled parameters."""
ORDER: dict[Sampling, int] = {"held": 1, "instant": 2}
"""What is missed between readings grows with this power of their distance (Richardson): steps miss twice as much at
twice the distance, lines four times."""
LASTING = 75.0
"""A pilot's style and the place of the readings between the sticks' steps stay for more than a minute [s]: for that
long windows err alike, and what they miss counts once."""
ROLL_PITCH = [NOMINAL_NAMES.index(name) for name in ("J_xx", "J_yy")]
"""One set of sticks, loops and readings: two tries at the size of one error."""
ROOM = 16.0
"""A bare guess may be wrong by this factor each way; how sure it is stays as it was.

What the nominal model made of a flight that it misses is no better guess: it may be wrong by as much.
"""
MOVING = ("command", "rotor", "air", "body")
"""Places of effects that move the vehicle; of sensors only what shifts their time is fitted along:"""
TIMING = ("imu_lag", "attitude_delay")


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
        moves = (effect.acts in MOVING and not effect.per_log) or effect.name in TIMING
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
) -> tuple[Shooting, Free, Prior, Polished]:
    """Fits everything; the problem with its noise, what is free, its prior, and the optimum.

    Args:
        windows: data.
        vehicle: the vehicle.
        nominal: prior of the nominal six.
        theta: start, full vector.
        noise: None lets the fit find it, all structure that remains counted as noise.
    """
    problem = Shooting.cut(windows, vehicle, SEGMENT, noise)
    free = problem.free(moving_names(problem))
    prior = flexible_prior(nominal, free, problem)
    result = polish(problem, theta, free, prior, iterations=12)
    for _ in range(0 if noise is not None else ROUNDS - 1):
        problem = problem.with_noise(residual_noise(problem, result))
        result = polish(problem, result.theta, free, prior, iterations=12)
    if not np.isfinite(result.cost):
        return problem, free, prior, result
    robust = problem.with_robust(robust_weights(problem, result.lin))
    return problem, free, prior, polish(robust, result.theta, free, prior, result.states, iterations=4)


def reduced(
    start: float, stop: float, problem: Shooting, free: Free, prior: Prior, result: Polished,
    known: FloatArray | None = None,
) -> WindowEstimate:  # fmt: skip
    """What a window says of the nominal six, whatever the effects are; b is that at hover.

    Information counts for less where the scores of segments scatter more than the noise explains (`score_products`).
    `known`: thrust that the six leave out (`left_out`), where that was computed already.
    """
    lin, six = result.lin, len(NOMINAL_NAMES)
    precision, pull, _ = prior_terms(free, prior, result.theta)
    effects = np.arange(len(precision)) >= six
    h, g, scores = lin.information + np.diag(precision * effects), lin.gradient + pull * effects, lin.grad
    z = free.scaled(result.theta[free.index])[:six]
    z[B], slopes = _at_hover(problem, free, result.theta)
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
        left_out(problem, free, prior, result) if known is None else known,
    )  # fmt: skip


def halved(window: Window, first: int) -> Window:
    """The window as if only every second row of the rotors had been there, from row `first` (0 or 1) on."""
    at, kept = np.arange(len(window)), np.arange(first, len(window), 2)
    if window.sampling == "held":
        speed = window.rotor_speed[kept[np.maximum((at - first) // 2, 0)]]
    else:
        speed = np.column_stack([np.interp(at, kept, c) for c in window.rotor_speed[kept].T])
    return replace(window, rotor_speed=speed, rotor_slope=None)


def sampling_error(
    estimate: WindowEstimate, problem: Shooting, free: Free, prior: Prior, best: Polished, spacing: float
) -> FloatArray:
    """Variances of the nominal six, log scale, on the diagonal, shape (6, 6), by what the rotors do between readings.

    Two trials do not tell which combinations are known better than their parts: a covariance out of them would be
    infinitely sure of four of six, and windows fused with it of all.  Half of the trials' difference is what is in step
    with the motion, their mean what grows with the square; the former falls with the readings' distance to the power
    `ORDER`, the latter to twice that.

    Args:
        estimate: of the windows of `problem`.
        problem: data in segments, with the noise of the fit.
        free: what was free, with `prior`.
        prior: of everything that was free.
        best: the optimum.
        spacing: time between two readings of the rotors [rows].
    """
    windows = [r.window for r in problem.rollouts]
    shifts = []
    for first in (0, 1):
        sparse = problem.on([halved(w, first) for w in windows])
        # One linear step tells the size; a descent may refuse every step, and would then tell of no error at all.
        lin = sparse.linearise(best.theta, free, best.states)
        there = reduced(estimate.start, estimate.stop, problem, free, prior, replace(best, lin=lin), estimate.left_out)
        shifts.append(there.optimum - estimate.optimum)
    share = (0.5 * spacing) ** ORDER[windows[0].sampling]
    missed = (share * 0.5 * (shifts[0] - shifts[1])) ** 2 + (share**2 * 0.5 * (shifts[0] + shifts[1])) ** 2
    missed[ROLL_PITCH] = np.mean(missed[ROLL_PITCH])
    return np.diag(missed)


def alike(estimate: WindowEstimate) -> float:
    """How many windows like this one err alike: by so much the variance of what they miss has to count in each."""
    return max(LASTING / (estimate.stop - estimate.start), 1.0)


def widened(estimate: WindowEstimate, covariance: FloatArray) -> WindowEstimate:
    """The estimate with `covariance`, shape (6, 6), added to its own; its optimum stays."""
    step = np.linalg.solve(estimate.information, estimate.score)
    information = np.linalg.inv(np.linalg.inv(estimate.information) + covariance * estimate.scale)
    information = 0.5 * (information + information.T)
    return replace(estimate, information=information, score=information @ step)


def left_out(problem: Shooting, free: Free, prior: Prior, result: Polished) -> FloatArray:
    """Thrust at hover beyond b w^2: a row of values and one of their standard deviations, shape (2, R).

    The value of a rotor is the logarithm of its thrust's change with speed, as fitted, over that by the published b.  A
    thrust curve, a support force and an accelerometer of another scale give all rotors the same, a weak rotor itself.
    """
    weight, stated = problem.vehicle.mass * GRAVITY, ThrustModel.stated(problem.vehicle)

    def value(at: FloatArray) -> FloatArray:
        fitted = ThrustModel(problem.layout, at)
        six = stated.with_b(fitted.like(stated, weight))
        return np.log(np.maximum(fitted.slope(weight), 1e-12) / six.slope(weight))

    here = value(result.theta)
    steps = np.array(
        [(value(free.move(result.theta, step)) - here) / STEP for step in STEP * np.eye(len(free.entries))]
    )
    covariance = posterior_covariance(result.lin.information, prior)
    excess = np.maximum(variance_ratio(result.lin, covariance)[0], 1.0)
    spread = np.sqrt(excess)[:, None] * steps
    return np.stack([here, np.sqrt(np.einsum("pr,pq,qr->r", spread, covariance, spread))])


def _at_hover(problem: Shooting, free: Free, theta: FloatArray) -> tuple[float, FloatArray]:
    """Logarithm of the published b, and its derivatives to all scaled parameters."""
    weight, stated = problem.vehicle.mass * GRAVITY, ThrustModel.stated(problem.vehicle)

    def value(at: FloatArray) -> float:
        return float(np.log(ThrustModel(problem.layout, at).like(stated, weight)))

    here, steps = value(theta), STEP * np.eye(len(free.entries))
    return here, np.array([(value(free.move(theta, step)) - here) / STEP for step in steps])
