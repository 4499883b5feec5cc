"""Checks of units and frames, by physics: gravity, gyro, attitude, velocity and position against each other."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from quadid.checks.findings import ERROR, OK, UNKNOWN, WARNING, Check, estimates_off
from quadid.checks.motion import (
    ALLOWED,
    FEWEST,
    FEWEST_SAMPLES,
    TURN,
    Log,
    attitude_steps_check,
    changes_of_turn,
    factors,
    is_turning,
    turn_moments,
    within,
)
from quadid.data.grid import GAP, linear
from quadid.data.window import Channel, fresh_rows, measured_period, sample_period
from quadid.effects import butterworth_delay
from quadid.rotation import conjugate, euler, rotated, turn
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY

# --- Units and frames, tested by physics: gravity, gyro against attitude, velocity against attitude and accelerometer


_CLEAR = 0.5
"""R^2 above which a relation between two channels is believed."""
_MOTION = 0.03
"""Rotation rate [rad/s] an axis must have, as standard deviation, to be checked."""
_STEP = 0.1
"""Attitudes are compared over steps of at least this [s]: noise and repeated readings matter little then."""
_UNIT = 1.5
"""Two channels of one motion whose sizes are farther apart are of no use together."""
_JUMP = 8.0
"""An attitude step of so many times the usual one, beside half as much of the gyro's, is no motion."""
_LATE, _TOO_LATE = 0.013, 0.08
"""Time between gyro and attitude [s] that is named, for filters of autopilots at 20 Hz make 12 ms; and an error."""
_SMOOTHED = 0.8
"""Share that a smoothed gyro reads at most, somewhere, of what it reads of slow turning."""
_PARTS = 5
"""Parts of a log that show an error of its rates alike."""
_AXES = ("x", "y", "z")
_gravity_is = partial(Check, "gravity")
_rates_are = partial(Check, "gyro_attitude")
_velocity_is = partial(Check, "velocity_attitude")
_position_is = partial(Check, "position_velocity")


class AxisMap(NamedTuple):
    """The signed permutation of axes, times a scale, that turns one vector signal into another best.

    Attributes:
        axes: for each output axis, the input axis it follows.
        signs: its sign, +1 or -1.
        scale: common factor.
        r2: fraction of the output's variance explained.
    """

    axes: tuple[int, ...]
    signs: tuple[int, ...]
    scale: float
    r2: float

    @property
    def straight(self) -> bool:
        """Each axis follows itself with its own sign."""
        return self.axes == tuple(range(len(self.axes))) and all(s > 0 for s in self.signs)

    @property
    def absurd(self) -> bool:
        """The scale is wrong by more than `_UNIT`, whichever of the signals the noise is in."""
        return self.scale > _UNIT or self.scale < self.r2 / _UNIT

    def __str__(self) -> str:
        return ", ".join(
            f"{_AXES[i]} = {'-' if s < 0 else ''}{_AXES[a]}"
            for i, (a, s) in enumerate(zip(self.axes, self.signs, strict=True))
        )


def fit_axes(source: FloatArray, target: FloatArray) -> AxisMap:
    """Finds the signed permutation and scale that explain `target` (n, k) by `source` (n, k) best, k = 2 or 3.

    Axes stay where they are unless one follows another axis, or its own reversed, clearly: what hardly moves is noise,
    which any axis explains as well as any other.
    """
    x, y = source - source.mean(axis=0), target - target.mean(axis=0)
    cross, power = y.T @ x, np.sum(x**2, axis=0)
    size, whole = float(np.sum(power)), float(np.sum(power) * np.sum(y**2))
    straight = tuple(range(x.shape[1]))
    clear = cross**2 > _CLEAR * np.outer(np.sum(y**2, axis=0), power)
    best = AxisMap(straight, (1,) * x.shape[1], np.nan, 0.0)
    for axes in permutations(straight) if whole > 0.0 else ():
        for signs in product((1, -1), repeat=x.shape[1]):
            moved = [(i, a) for i, a, s in zip(straight, axes, signs, strict=True) if a != i or s < 0]
            if moved and not any(clear[place] for place in moved):
                continue
            gain = float(np.dot(signs, cross[straight, axes]))
            if gain > 0.0 and gain**2 / whole > best.r2 + 1e-9:
                best = AxisMap(axes, signs, gain / size, gain**2 / whole)
    return best


def gravity_check(log: Log) -> Check:
    """Length and direction of the mean specific force: 9.8 m/s^2 along -z in FRD."""
    accel, attitude = (log.recording.channels.get(name) for name in ("accel", "attitude"))
    if accel is None:
        return _gravity_is(UNKNOWN, "no accelerometer")
    inside = within(accel.t, log.spans) if log.spans else np.ones(len(accel.t), dtype=np.bool_)
    values = accel.values[inside]
    if not len(values):
        return _gravity_is(UNKNOWN, "no accelerometer sample in flight")
    length = float(np.median(np.linalg.norm(values, axis=1)))
    z = float(np.median(values[:, 2]))
    steady = float(np.linalg.norm(np.median(values, axis=0)))
    check = partial(_gravity_is, numbers={"length": length, "z": z})
    message = f"specific force has length {length:.4g} and z {z:.4g} (medians; about 9.81 and -9.81 m/s^2 expected)"
    # Specific force on the ground has the length that it must have, where there are samples enough to tell.
    resting = np.linalg.norm(accel.values[~inside], axis=1)
    if not (len(resting) >= 50 and abs(float(np.median(resting)) / GRAVITY - 1.0) < 0.1):
        for unit, factor in (("g", GRAVITY), ("milli-g (or cm/s^2)", GRAVITY * 1e-3)):
            if 0.7 < length * factor / GRAVITY < 1.6 and steady > 0.5 * length:
                return check(ERROR, f"{message}: it seems to be in {unit}", f"multiply acceleration by {factor:.6g}")
        if log.spans and steady < 0.3 * GRAVITY:
            return check(ERROR, f"{message}: gravity is missing", "log specific force, not linear acceleration")
        if not 0.5 < length / GRAVITY < 2.0:
            return check(ERROR, f"{message}: this is no specific force in m/s^2", "log raw acceleration")
    # A vehicle that lies on its back does not turn: there the attitude turns what is felt to one g upwards.
    flown = z > 0.5 * length and bool(log.spans)
    flown = flown and is_turning(log.recording.channels.get("gyro"), log.spans, _MOTION)
    if z > -0.5 * length and not flown and attitude is not None and len(attitude.t) > 1:
        world = np.median(_in_world(accel, attitude)[inside], axis=0)
        if np.linalg.norm(world + [0.0, 0.0, GRAVITY]) < 0.3 * GRAVITY:
            return check(UNKNOWN, f"{message}; its attitude agrees: the vehicle lies or turns this way")
    if not log.spans and z > -0.8 * length:
        return check(UNKNOWN, f"{message}; the vehicle does not fly in this log and may lie this way")
    if z > 0.5 * length:
        turned = f"{message}: z points up (FLU, as ROS has it) or the sign is reversed"
        return check(ERROR, turned, _downwards(log, accel, inside))
    if z > -0.5 * length:
        return check(ERROR, f"{message}: gravity is not along z", "check the axes of the IMU")
    return check(OK, message)


def _downwards(log: Log, accel: Channel, inside: BoolArray) -> str:
    """Advice what to turn where the specific force points up: what gyro, attitude and velocity agree with."""
    attitude, velocity = (log.recording.channels.get(name) for name in ("attitude", "velocity"))
    body = "turn body vectors to FRD: negate y and z"
    if attitude is None or len(attitude.t) < 2 or gyro_check(log).verdict is not OK:
        return body
    if float(np.median(_in_world(accel, attitude)[inside, 2])) < 0.0:
        return f"{body}, and turn the attitude with them"
    fixes = {
        "negate y and z of the accelerometer alone": replace(accel, values=accel.values * [1.0, -1.0, -1.0]),
        "turn all of it to FRD and NED: this is ROS' FLU and ENU": accel,
    }
    if velocity is not None and len(velocity.t) >= FEWEST_SAMPLES:
        tried = {fix: _velocity_gains(trial, attitude, velocity) for fix, trial in fixes.items()}
        fits = {fix: fit_axes(derived[:, :2], gained[:, :2]) for fix, (gained, derived) in tried.items()}
        clear = [fix for fix, fit in fits.items() if fit.straight and fit.r2 > _CLEAR]
        if len(clear) == 1:
            return clear[0]
    return " or ".join(fixes)


def attitude_check(log: Log) -> Check:
    """Attitude against gyro (axes, signs, degrees for radians) and against gravity (a world with z down)."""
    rates = gyro_check(log, log.once(response))
    if rates.numbers.get("r2", 1.0) < _CLEAR and (coarse := attitude_steps_check(log.recording)) is not None:
        rates = _rates_are(UNKNOWN, f"{coarse.message}: too coarse to compare with the gyro")
    known = log.channels("accel", "attitude", least=2)
    if rates.verdict is ERROR or known is None:
        return rates
    accel, attitude = known
    tame = np.linalg.norm(accel.values, axis=1) < 20.0 * GRAVITY  # single wild readings are no scale
    vertical = _in_world(accel, attitude)[tame, 2]
    if not len(vertical):
        return rates
    down, up, seconds = float(np.median(vertical)), -float(np.mean(vertical)), float(np.ptp(accel.t))
    if down >= 0.5 * GRAVITY:
        message = f"the attitude turns what the accelerometer reads to point down ({down:.3g} m/s^2)"
        fix = "convert attitude, velocity and position to NED; ROS uses east, north, up (ENU)"
        return _rates_are(ERROR, f"{message}: its world has z up", fix, {"down": down})
    # What is felt makes up for gravity on the average, upwards and along the body's axes, but for 5 m/s of speed.
    most = 0.7 + 5.0 / max(seconds, 1e-3)
    if most < abs(up - GRAVITY) < 0.5 * GRAVITY:
        message = (
            f"specific force is {up:.3g} m/s^2 upwards on the average of {seconds:.3g} s, which must be {GRAVITY:.2f}: "
            "scale or zero of the accelerometer is wrong, and b with it"
        )
        verdict = ERROR if abs(up - GRAVITY) > 2.0 * most else WARNING
        fix = f"calibrate it; if it is the scale, multiply acceleration by {GRAVITY / up:.3g}"
        return _gravity_is(verdict, message, fix, {"up": up}, estimates_off(mass=up / GRAVITY) if up > 0.0 else {})
    q = linear(attitude.t, attitude.values, accel.t)
    upwards = np.broadcast_to([0.0, 0.0, -GRAVITY], accel.values.shape)  # makes up for gravity alone
    felt = rotated(conjugate(q / np.linalg.norm(q, axis=1, keepdims=True)), upwards)
    aside = np.mean((accel.values - felt)[tame], axis=0)[:2]
    size = float(np.linalg.norm(aside))
    if rates.verdict is WARNING or size < most:
        return rates
    message = (
        f"specific force is {aside[0]:+.2g} m/s^2 along x and {aside[1]:+.2g} along y on the average of "
        f"{seconds:.3g} s, more than gravity and attitude explain: the accelerometer's zero is wrong, or the attitude"
    )
    fix = "calibrate it level, or subtract this"
    return _gravity_is(ERROR if size > 3.0 * most else WARNING, message, fix, {"aside": size})


# --- Gyro against the turning of the attitude: readings of the quaternion, then what of the rates cannot be


Rates = tuple[FloatArray, ...]
"""Mean rates by gyro and by attitude over the same steps [rad/s], both (m, 3), and what goes with them."""


def gyro_check(log: Log, found: "Response | None" = None) -> Check:
    """Gyro against differentiated attitude: axes, signs and scale (degrees for radians); `found` is of `response`."""
    if (known := log.channels("gyro", "attitude")) is None:
        return _rates_are(UNKNOWN, "needs gyro and attitude")
    gyro, attitude = known
    if (period := measured_period(gyro.t, gyro.values)) > _STEP:
        return _rates_are(UNKNOWN, f"gyro at {1.0 / period:.2g} Hz is too slow to compare with the attitude")
    if measured_period(attitude.t, attitude.values) > 0.5 * _STEP:  # slow readings may be written again and again
        attitude = _fresh(attitude)
    given = attitude.values
    own = _moving_rates(gyro, attitude.t, given)
    readings = {"as given": given, "world to body": conjugate(given), "x y z w (scalar last)": given[:, [3, 0, 1, 2]]}
    fits: dict[str, AxisMap] = {}

    def likely(reading: str) -> float:
        """R^2, with a bonus for axes that agree and one for taking the numbers as given."""
        fit = fits[reading]
        return fit.r2 + (0.1 if fit.straight else 0.0) + (0.05 if reading == "as given" else 0.0)

    for name, q in readings.items():
        if fits and max(map(likely, fits)) >= 1.1:
            break  # no other can be likelier
        measured, derived = own if q is given else _moving_rates(gyro, attitude.t, q)
        if len(measured) >= FEWEST_SAMPLES:
            fits[name] = fit_axes(measured, derived)
            if np.isfinite(fits[name].scale):  # once more without rows far off: estimators reset their heading
                axes, signs, scale, _ = fits[name]
                miss = np.linalg.norm(derived - scale * measured[:, axes] * np.array(signs), axis=1)
                near = miss <= _JUMP * np.median(miss)
                fits[name] = fit_axes(measured[near], derived[near])
        elif name == "as given":  # as much noise moves every reading of it: no other is more likely for it
            break
    if not fits:
        return _rates_are(UNKNOWN, "too little rotation to compare gyro and attitude")
    reading = max(fits, key=likely)
    given_fits, fit, rows = reading == "as given", fits[reading], _without_jumps(*own)
    if given_fits and found is not None and abs(found.late) - 3.0 * found.sigma >= _TOO_LATE:
        later, sooner = ("gyro", "attitude") if found.late > 0.0 else ("attitude", "gyro")
        message = f"{later} comes {1e3 * abs(found.late):.0f} ms after the {sooner}"
        fix = f"stamp the {later} when it is measured, on the clock of the {sooner}"
        return _rates_are(ERROR, message, fix, {"lag_s": found.late})
    late = found is not None and abs(found.late) - 3.0 * found.sigma > _LATE
    smoothed = given_fits and found is not None and (found.left < _SMOOTHED or late)
    return (
        (_angle_rates(gyro, attitude) if given_fits else None)
        or _one_axis(rows)
        or _bias_step(*own)
        or (_tilted(rows) if given_fits and fit.straight else None)
        or _judge_rates(gyro, attitude, reading, fit, smoothed)
    )


def _moving_rates(gyro: Channel, t: FloatArray, q: FloatArray) -> Rates:
    """Rates over steps long enough for the motion to stand above the attitude's noise; none if still.

    White attitude noise adds a variance that falls with the square of the step and motion one that does not, so two
    steps separate them: motion = (4 var(2 step) - var(step)) / 3.
    """
    stride = max(1, round(_STEP / sample_period(t)))
    if stride > 100:  # no attitude comes at more than 1 kHz: times in minutes or hours
        stride = len(t) // (3 * FEWEST_SAMPLES) + 1
    rates = _rates(gyro, t[::stride], q[::stride])
    kept = _without_jumps(*rates)
    # Resets are few, a twentieth of the steps: where more rows differ, gyro and attitude do not agree.
    measured, derived = kept if len(kept[0]) > 0.95 * len(rates[0]) else rates
    longer = _without_jumps(*_rates(gyro, t[:: 2 * stride], q[:: 2 * stride]))[1]
    if len(longer) < FEWEST_SAMPLES:
        return longer[:0], longer[:0]
    # Without the few rows that turn most: resets that noise hides are no motion, and what is, the gyro reads, too.
    variances = []
    for turned in (derived, longer):
        size = np.linalg.norm(turned - np.median(turned, axis=0), axis=1)
        variances.append(np.var(turned[size <= np.quantile(size, 0.95)], axis=0))
    total, twice = variances
    motion = np.maximum((4.0 * twice - total) / 3.0, 0.0)
    if max(np.max(np.sqrt(motion)), np.max(np.std(measured, axis=0))) < _MOTION:
        return longer[:0], longer[:0]
    # Over longer steps a flip turns by more than half a turn, and looks like another one.
    angle = float(np.max(np.linalg.norm(derived, axis=1))) * stride * sample_period(t)
    if np.sum(motion) > 0.8 * np.sum(total) or 4.0 * angle > np.pi or len(t) < FEWEST_SAMPLES * 4 * stride:
        return measured, derived
    return _rates(gyro, t[:: 4 * stride], q[:: 4 * stride])


def _rates(gyro: Channel, t: FloatArray, q: FloatArray) -> Rates:
    """Mean rates over each step between attitudes that has no gap."""
    keep = usable_steps(t, gyro.t)
    mean = np.diff(running_integral(gyro, t), axis=0)[keep] / np.diff(t)[keep, None]
    return mean, turn(q[:-1], q[1:])[keep] / np.diff(t)[keep, None]


def _without_jumps(measured: FloatArray, derived: FloatArray, *more: FloatArray) -> Rates:
    """Rates without rows in which the attitude jumps and the gyro does not: an estimator reset its heading there."""
    if not len(derived):
        return measured, derived, *more
    # Where both go together, a jump need be no faster than the motion.
    apart, turned = (np.linalg.norm(rows, axis=1) for rows in (derived - measured, derived))
    jumps = _jumps(measured, derived) | (apart > _JUMP * np.maximum(np.median(apart), 0.1 * np.median(turned)))
    return tuple(rows[~jumps] for rows in (measured, derived, *more))


def _jumps(measured: FloatArray, derived: FloatArray) -> BoolArray:
    """True for rows in which the attitude jumps and the gyro does not."""
    turned, felt = (np.linalg.norm(rows, axis=1) for rows in (derived, measured))
    return np.asarray((turned > _JUMP * np.nanmedian(turned)) & (felt < 0.5 * _JUMP * np.nanmedian(felt)))


def _angle_rates(gyro: Channel, attitude: Channel) -> Check | None:
    """An error where the gyro holds the rates of roll, pitch and yaw angle, not those about the body's axes.

    Both differ by a part that grows with tilt; what the gyro differs from the body's rates is compared with it.
    """
    stride = max(1, round(_STEP / sample_period(attitude.t)))
    t, q = attitude.t[::stride], attitude.values[::stride]
    keep = usable_steps(t, gyro.t)
    angles = np.diff(np.unwrap(euler(q), axis=0), axis=0)[keep] / np.diff(t)[keep, None]
    measured, turned, angles = _without_jumps(*_rates(gyro, t, q), angles)
    if len(angles) < FEWEST_SAMPLES:
        return None
    # What this difference, as it is, takes of what the gyro misses beside its bias: on the axis about which they differ
    # most, where the others add their noise, and in every part of the flight: a swing that dies away looks like any.
    apart, missed = angles - turned, measured - turned
    axis = int(np.argmax(np.sum(apart**2, axis=0)))
    was, left = (
        np.array([part.sum() for part in np.array_split((x[:, axis] - x[:, axis].mean()) ** 2, _PARTS)])
        for x in (missed, missed - apart)
    )
    share = 1.0 - float(left.sum() / max(was.sum(), 1e-300))
    if share < _CLEAR or not np.all(left < was):
        return None
    message = "gyro is the rates of roll, pitch and yaw angle (Euler rates), not those about the body's axes"
    fix = (
        "log the gyro; or p = phi' - psi' sin(theta), q = theta' cos(phi) + psi' sin(phi) cos(theta), "
        "r = psi' cos(phi) cos(theta) - theta' sin(phi)"
    )
    return _rates_are(ERROR, message, fix, {"share": share})


def _one_axis(rows: Rates) -> Check | None:
    """An error where one axis is still or has a scale of its own, a warning where one is far off zero."""
    if len(rows[0]) < FEWEST_SAMPLES:
        return None
    (size, turned), offset = (np.std(x, axis=0) for x in rows), np.mean(rows[0] - rows[1], axis=0)
    together = np.mean((rows[0] - rows[0].mean(axis=0)) * (rows[1] - rows[1].mean(axis=0)), axis=0)
    correlation = together / (size * turned + 1e-12)
    follows = correlation > 0.9
    scale = turned / np.maximum(size, 1e-300)
    agrees = follows & (scale < _UNIT) & (scale > 1.0 / _UNIT) & (size > _MOTION)
    if not agrees.any():
        return None
    for axis, name in enumerate(_AXES):
        check = partial(_rates_are, ERROR, numbers={"scale": float(scale[axis]), "offset": float(offset[axis])})
        still = [which for which, x in (("gyro", size), ("attitude", turned)) if x[axis] < 1e-6]
        if len(still) == 1 and max(size[axis], turned[axis]) > 3.0 * _MOTION:
            return check(f"{still[0]} does not turn about {name}, where the other does", "log all of its axes")
        if abs(correlation[axis]) < 0.3 and size[axis] > 0.2 and np.count_nonzero(agrees) == 2:
            message = f"gyro does not follow the attitude about {name} (correlation {correlation[axis]:.2f})"
            return check(message, f"check {name} of both, or a heading that was held")
        if follows[axis] and not agrees[axis] and size[axis] > _MOTION:
            message = f"attitude rate / gyro = {scale[axis]:.3g} about {name}, not about every axis"
            return check(message, f"multiply the gyro's {name} by it, or correct the attitude")
    worst = int(np.argmax(np.abs(offset)))
    most = float(offset[worst])
    if abs(most) < 0.1 or not agrees[worst]:  # [rad/s]; of recorded flights up to 0.04
        return None
    message = f"gyro reads {most:+.2g} rad/s about {_AXES[worst]} more than the attitude turns"
    return _rates_are(WARNING, message, "calibrate it at rest, or subtract this", {"offset": most})


def _bias_step(measured: FloatArray, derived: FloatArray) -> Check | None:
    """An error where the gyro follows the attitude, or both stand still, but for one step of its bias."""
    n = len(measured)
    if n < FEWEST_SAMPLES or fit_axes(measured, derived).r2 >= _CLEAR:
        return None
    # Size of a step after each row, and the variance that it takes
    apart, count = measured - derived, np.arange(5, n - 4)[:, None]
    before = np.cumsum(apart, axis=0)[4 : n - 5] / count
    size = (apart.sum(axis=0) - before * count) / (n - count) - before
    share = size**2 * count * (n - count) / n
    k, axis = (int(i) for i in np.unravel_index(np.argmax(share), share.shape))
    left, step = measured.copy(), float(size[k, axis])
    left[count[k, 0] :, axis] -= step
    fit, noise = fit_axes(left, derived), float(np.var((left - derived)[:, axis]))
    still = np.max(np.std(left, axis=0)) < _MOTION
    if share[k, axis] < _JUMP**2 * noise or not (still or (fit.straight and fit.r2 >= _CLEAR)):
        return None
    message = f"the gyro's bias about {_AXES[axis]} stepped by {step:+.2g} rad/s; without that the attitude agrees"
    return _rates_are(ERROR, message, "use the flight before it, and calibrate the gyro at rest", {"step": step})


def _tilted(rows: Rates) -> Check | None:
    """A gyro that is turned by some degrees against the attitude, in all parts of the log alike (Kabsch 1976)."""
    if len(rows[0]) < 2 * FEWEST_SAMPLES:
        return None

    def turning(measured: FloatArray, derived: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation between the rates, and its roll, pitch and yaw [rad]."""
        u, _, v = np.linalg.svd((measured - measured.mean(axis=0)).T @ (derived - derived.mean(axis=0)))
        m = (u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v).T
        return m, np.array([np.arctan2(m[2, 1], m[2, 2]), -np.arcsin(m[2, 0]), np.arctan2(m[1, 0], m[0, 0])])

    parts = [turning(*part)[1] for part in zip(*(np.array_split(r, _PARTS) for r in rows), strict=True)]
    (m, angles), error = turning(*rows), np.linalg.norm(np.std(parts, axis=0)) / np.sqrt(_PARTS)
    size = float(np.linalg.norm(angles))
    # Where each axis goes with its own, noise turns more.
    tilt = math.radians(4.0)
    if not max(tilt, _PARTS * float(error)) <= size < 0.5 * np.pi:
        return None
    # What an axis reads of the others' acceleration is no answer to its torque.
    read = np.diff(rows[0], axis=0)
    sizes = np.sum(read**2, axis=0) / np.sum(read * (read @ m.T), axis=0)
    roll, pitch, yaw = np.degrees(angles)
    message = f"gyro is turned against the attitude: roll {roll:.2g}, pitch {pitch:.2g}, yaw {yaw:.2g} deg"
    rotation = ", ".join(f"{angle:.3f}" for angle in angles)
    fix = f"mounting: {{rotation: [{rotation}]}} in the vehicle file, or correct the attitude"
    off = estimates_off(turning=sizes.tolist()) if sizes.min() > 0.0 else {}
    return _rates_are(ERROR if size > 2.0 * tilt else WARNING, message, fix, {"angle_rad": size}, off)


def _judge_rates(gyro: Channel, attitude: Channel, reading: str, fit: AxisMap, smoothed: bool) -> Check:
    """Judgement of axes and scale of the best fit; a smoothed gyro lacks quick turning, which is no matter of scale."""
    check = partial(_rates_are, numbers={"scale": fit.scale, "r2": fit.r2})
    if fit.r2 < _CLEAR:
        remedy = "check units, axes and time stamps of both; quaternions are scalar first, body to world"
        return check(ERROR, f"gyro does not follow the attitude (R^2 {fit.r2:.2f})", remedy)
    if reading != "as given":
        message = f"attitude fits the gyro only when read as {reading} (R^2 {fit.r2:.2f})"
        return check(ERROR, message, "write wxyz quaternions, body to world, FRD to NED")
    if not fit.straight:
        remedy = "body axes must be FRD for both; ROS' FLU has y and z reversed"
        if (fit.axes, fit.signs) == ((1, 0, 2), (1, 1, -1)):
            remedy = "that is an attitude in world axes east, north, up (ENU): turn it, velocity and position into NED"
        return check(ERROR, f"gyro axes differ from the attitude's: {fit} (R^2 {fit.r2:.2f})", remedy)
    for scale, unit in ((60.0, "minutes"), (3600.0, "hours")):
        if fit.r2 > 0.9 and 0.97 < fit.scale / scale < 1.03:
            message = f"attitude rate / gyro = {fit.scale:.4g}: time seems to be in {unit}"
            return check(ERROR, message, f"multiply times by {scale:g}")
    degree = math.radians(1.0)
    for scale, what in ((degree, "gyro seems to be in deg/s"), (1.0 / degree, "attitude seems to be in degrees")):
        if 0.75 < fit.scale / scale < 1.33:
            return check(ERROR, f"{what} (attitude rate / gyro = {fit.scale:.3g})", "convert to radians")
    message = f"attitude rate / gyro = {fit.scale:.3f} (R^2 {fit.r2:.2f})"
    if fit.absurd:
        remedy = f"multiply gyro by {fit.scale:.3g}, or correct the attitude"
        return check(ERROR, f"{message}: the scale of one is wrong", remedy)
    # Turns of the attitude over those of the gyro about each axis, unless they are too slow or too few
    step = max(sample_period(attitude.t), 0.1 * TURN)
    at, q = _on_steps(gyro, attitude, step)
    by_axis = []
    if not smoothed and step <= 0.25 * TURN and len(at) >= FEWEST * TURN / step:
        turns = _without_jumps(*changes_of_turn(linear(gyro.t, gyro.values, at), q, step))
        if (seconds := len(turns[0]) * step) >= FEWEST * TURN:
            by_axis = [factors(axis, seconds, turn_moments(turns, axis, step))[0] for axis in range(3)]
    sizes = np.array([f.value if f.disagrees and f.value > 0.0 else 1.0 for f in by_axis] or [fit.scale] * 3)
    message = ", ".join(str(f) for f in by_axis if f.known) or message
    if smoothed or np.all(sizes == 1.0) or not by_axis and 0.85 * fit.r2 < fit.scale < 1.15:
        return check(OK, message)
    remedy = "check scales and filters of both; multiply the gyro by this if the attitude is right"
    return check(WARNING, message, remedy, off=estimates_off(turning=(1.0 / sizes).tolist()))


# --- The gyro beside the attitude by frequency: late, low-passed, or no sensor of its own


class Response(NamedTuple):
    """The gyro beside the turning of the attitude, by frequency.

    Attributes:
        late: time of the gyro after the attitude [s]; sigma: its standard deviation.
        left: least share that the gyro has, in any band, of what it reads of slow turning, at the top of its error.
        read: share that it has of all angular acceleration.
    """

    late: float
    sigma: float
    left: float
    read: float


def response(log: Log) -> Response | None:
    """Gyro beside differentiated attitude in bands of frequency, by cross-spectra; None where too few are clear.

    Both are means over the same steps, so that rates and steps of the channels do not matter.  Noise of the gyro makes
    the share that it reads too large and that of the attitude leaves it, so that a share below 1 is a filter's.
    """
    if (known := log.channels("gyro", "attitude")) is None:
        return None
    gyro, attitude = known[0], _fresh(known[1])
    step = max(0.01, sample_period(attitude.t))
    slowest = max(step, measured_period(gyro.t, gyro.values))
    rows = round(float(np.clip(np.ptp(attitude.t) / 6.0, 1.0, 2.0)) / step)
    hz, lags = np.fft.rfftfreq(rows, step)[1:], np.arange(-0.3, 0.3 + 1e-9, 0.005)
    late = 0.0
    for first in (True, False):  # once more where both agree best: else parts hold different ends of the motion
        shifted = Channel("gyro", gyro.t - late, gyro.values)
        at, q = _on_steps(shifted, attitude, step)
        if len(at) <= rows or rows < 4:
            return None
        felt, turned = (x / step for x in (np.diff(running_integral(shifted, at), axis=0), turn(q[:-1], q[1:])))
        felt[_jumps(felt, turned)] = np.nan
        spectra = tapered_spectra(np.hstack([felt, turned]), rows)
        if len(spectra) < 5:
            return None
        one, other = np.split(spectra[..., 1:], 2, 1)
        cross, power, beside = (np.sum(x, axis=(0, 1)) for x in (other * one.conj(), abs(one) ** 2, abs(other) ** 2))
        agree = np.real(np.exp(-2j * np.pi * np.outer(lags, hz)) @ cross)
        late += float(lags[np.argmax(agree)]) if first else 0.0
    # Sums over bands that both can hold: phase, the gyro's share and its relative error, and coherence.
    place = np.digitize(hz, np.geomspace(0.4, 23.0, 11)) * (hz < 0.4 / slowest)
    bands = [place == k for k in np.unique(place) if 0 < k < 11]
    both, own, its, hz = (np.array([np.sum(x[k]) for k in bands]) for x in (cross, power, beside, hz * abs(cross)))
    hz, coherence = hz / (abs(both) + 1e-300), abs(both) ** 2 / (own * its + 1e-300) + 1e-12
    samples = [0.7 * len(spectra) * np.count_nonzero(k) for k in bands]
    error = np.sqrt(np.maximum(1.0 - coherence, 0.0) / (2.0 * coherence) / samples)
    clear = coherence > 0.8  # less is motion beside errors of the attitude that have a memory
    if np.count_nonzero(clear) < 2:
        return None
    # Time by the phases, weighted by their errors, of half a millisecond at least; what scatters more is less sure.
    lag = np.angle(both[clear]) / (2.0 * np.pi * hz[clear])
    weight = 1.0 / ((error[clear] / (2.0 * np.pi * hz[clear])) ** 2 + 5e-4**2)
    lag_mean = float(np.average(lag, weights=weight))
    scatter = float(np.average((lag - lag_mean) ** 2, weights=weight)) / (len(lag) - 1)
    sigma = float(np.sqrt(max(1.0 / weight.sum(), scatter)))
    # Sampling takes its share of motion beyond a tenth of the rate.
    share = own / (abs(both) + 1e-300)
    share = share / share[np.flatnonzero(clear)[0]]
    known = (error < 0.1) & (hz < 0.1 / slowest)
    quick = np.where(known, abs(both) * hz**2, 0.0)
    left = float(np.min((share * (1.0 + 2.0 * error))[known], initial=1.0))
    read = float(quick.sum() / np.sum(quick / np.minimum(share, 1.0))) if known.any() else 1.0
    return Response(late + lag_mean, sigma, left, read)


def tapered_spectra(values: FloatArray, rows: int) -> FloatArray:
    """Spectra of half overlapping parts of `rows` rows of (n, columns), Hann-tapered, without those with NaN.

    Shape (parts, columns, rows // 2 + 1), complex.
    """
    parts = np.lib.stride_tricks.sliding_window_view(values, rows, axis=0)[:: rows // 2]
    parts = parts[np.isfinite(parts).all(axis=(1, 2))]
    return np.asarray(np.fft.rfft((parts - parts.mean(axis=-1, keepdims=True)) * np.hanning(rows)))


def gyro_source_check(log: Log) -> Check | None:
    """A warning where the gyro is the attitude, differentiated, an error where its noise rules, or it was filtered.

    Noise of the attitude is then that of the gyro, row by row: their difference is far below what changes from one
    row to the next but one, which is what a sensor of its own and a central difference leave.
    """
    if (known := log.channels("gyro", "attitude")) is None:
        return None
    gyro, attitude = known[0], _fresh(known[1])
    inside = (attitude.t >= gyro.t[0]) & (attitude.t <= gyro.t[-1])
    t, q = attitude.t[inside], attitude.values[inside]
    if len(t) < FEWEST_SAMPLES or np.min(np.diff(t)) <= 0.0:
        return None

    def middle(rows: FloatArray) -> float:
        return float(np.median(np.linalg.norm(rows, axis=1)))

    rates = turn(q[:-1], q[1:]) / np.diff(t)[:, None]
    bends, read = middle(np.diff(rates, 2, axis=0)), linear(gyro.t, gyro.values, t)
    missed = (read[:-1] - rates, read[1:] - rates, read[1:-1] - 0.5 * (rates[1:] + rates[:-1]))
    least = min(map(middle, missed))
    if least >= 0.05 * bends:
        return _filtered(log)
    noisy = bends > 0.5 * middle(rates)
    message = "gyro is the attitude, differentiated: it measures nothing by itself" + ", and is mostly noise" * noisy
    fix = "log the gyro; noise and delay of the attitude are in both"
    numbers = {"missed_rad_s": least, "bends_rad_s": bends}
    return Check("gyro_source", ERROR if noisy else WARNING, message, fix, numbers)


def _filtered(log: Log) -> Check | None:
    """A warning where gyro or attitude are late beyond the vehicle's effects, or the gyro misses quick turning."""
    if (found := log.once(response)) is None:
        return None
    known: Mapping[str, Mapping[str, float]] = {} if log.described is None else log.described.effects
    lag = known.get("imu_lag", {}).get("cutoff", math.inf)
    late = found.late - butterworth_delay(lag) + known.get("attitude_delay", {}).get("delay", 0.0)
    smoothed = found.left < _SMOOTHED and "imu_lag" not in known
    sure = _LATE < abs(late) - 3.0 * found.sigma < _TOO_LATE
    if not (smoothed or sure):
        return None
    later, sooner = ("attitude", "gyro") if late < 0.0 else ("gyro", "attitude")
    notes = []
    if sure:
        delay = f"{later} comes {1e3 * abs(late):.0f} ms after the {sooner}"
        notes.append(f"{delay}, as low-passed at {butterworth_delay(abs(late)):.2g} Hz or stamped late")
    if smoothed:
        how = "low-passed" if sure and late > 0.0 else "smoothed without a delay"
        notes.append(f"gyro has {found.left:.0%} of the attitude's quick turning: it was {how}")
    models = "`attitude_delay` models a delay" if sure and late < 0.0 else "`imu_lag` models a filter"
    fix = f"log the raw {later if sure else 'gyro'}" + f"; {models}" * sure
    off = estimates_off(turning=(found.read,) * 3) if later == "gyro" or smoothed else {}
    return Check("gyro_source", WARNING, "; ".join(notes), fix, {"late_s": late, "left": found.left}, off)


# --- Velocity against attitude and accelerometer, and against the change of position


def velocity_check(log: Log) -> Check:
    """Change of world velocity against rotated specific force and gravity: world frame of attitude and velocity.

    Where no velocity is logged, it is that of the position.
    """
    velocity, position = log.recording.channels.get("velocity"), log.channels("position")
    if velocity is None and position is not None:
        # Change of the position [m/s] over steps of at least 0.5 s, at their middles
        stride = max(1, round(0.5 / sample_period(position[0].t)))
        t, place = position[0].t[::stride], position[0].values[::stride]
        flown = np.diff(place, axis=0) / np.diff(t)[:, None]
        velocity = Channel("position", 0.5 * (t[1:] + t[:-1]), flown, position[0].source)
    known = log.channels("accel", "attitude")
    if known is None or velocity is None or len(velocity.t) < FEWEST_SAMPLES:
        return _velocity_is(UNKNOWN, "needs accelerometer, attitude and velocity or position")
    accel, attitude = known
    if not 0.5 < np.median(np.linalg.norm(accel.values, axis=1)) / GRAVITY < 2.0:
        return _velocity_is(UNKNOWN, "needs specific force in m/s^2")
    name, (gained, derived) = velocity.name, _velocity_gains(accel, attitude, velocity)
    level = _velocity_is(UNKNOWN, "too little horizontal acceleration to compare")
    if len(gained) < FEWEST_SAMPLES:
        return level
    if np.max(np.std(gained[:, :2], axis=0)) >= 0.2:
        fit = fit_axes(derived[:, :2], gained[:, :2])
        check = partial(_velocity_is, numbers={"scale": fit.scale, "r2": fit.r2})
        message = f"{name} follows tilt and thrust (scale {fit.scale:.3g}, R^2 {fit.r2:.2f})"
        if fit.r2 < _CLEAR:
            level = check(UNKNOWN, f"{name} does not follow tilt and thrust clearly (R^2 {fit.r2:.2f})")
        elif not fit.straight:
            message = f"world axes of {name} differ from the attitude's: {fit} (R^2 {fit.r2:.2f})"
            return check(ERROR, message, "use NED for both; ROS' ENU swaps x and y")
        elif fit.absurd:
            return check(ERROR, f"{message}: its scale is wrong", f"divide {name} by {fit.scale:.3g}")
        else:
            level = check(OK, message)
    # Vertical changes that are clearly the reverse of what the force makes.
    up, down = gained[:, 2], derived[:, 2]
    if not (min(np.std(up), np.std(down)) > 0.05 and np.corrcoef(up, down)[0, 1] < -0.8):
        return level
    message = f"vertical {name} rises where the force pushes down: it points up"
    fix = f"negate {'vz, and z if it points up too' if name == 'velocity' else 'z'}: the world is NED"
    return _velocity_is(ERROR, message, fix, {"vertical": -1.0})


def _velocity_gains(accel: Channel, attitude: Channel, velocity: Channel) -> tuple[FloatArray, FloatArray]:
    """Mean acceleration [m/s^2] over steps of at least 0.2 s, of the velocity and from force, both (m, 3)."""
    world = Channel("accel", accel.t, _in_world(accel, attitude) + np.array([0.0, 0.0, GRAVITY]))
    stride = max(1, round(0.2 / sample_period(velocity.t)))
    t, speed = velocity.t[::stride], velocity.values[::stride]
    keep = usable_steps(t, accel.t) & usable_steps(t, attitude.t)
    gained, derived = (np.diff(x, axis=0)[keep] / np.diff(t)[keep, None] for x in (speed, running_integral(world, t)))
    return gained, derived


def _in_world(accel: Channel, attitude: Channel) -> FloatArray:
    """Specific force in the attitude's world [m/s^2], shape (n, 3), at the accelerometer's times."""
    q = linear(attitude.t, attitude.values, accel.t)
    return rotated(q / np.linalg.norm(q, axis=1, keepdims=True), accel.values)


def _fresh(channel: Channel) -> Channel:
    """The channel without rows that repeat a reading."""
    fresh = fresh_rows(channel.values)
    return replace(channel, t=channel.t[fresh], values=channel.values[fresh])


def _on_steps(gyro: Channel, attitude: Channel, step: float) -> tuple[FloatArray, FloatArray]:
    """Times `step` [s] apart (n,) at which both are known, and the attitude there (n, 4), NaN in gaps of either."""
    at = np.arange(max(gyro.t[0], attitude.t[0]), min(gyro.t[-1], attitude.t[-1]), step)
    q = linear(attitude.t, attitude.values, at)
    q[~usable_steps(attitude.t, gyro.t)[np.searchsorted(attitude.t[1:-1], at, "right")]] = np.nan
    return at, q


def usable_steps(t: FloatArray, other: FloatArray) -> BoolArray:
    """True for steps of `t` without a gap, neither in `t` nor, as long as a quarter of one, in the other's times."""
    steps = np.diff(t)
    usual = float(np.median(steps)) if len(steps) else 0.0
    longest = max(GAP * sample_period(other), 0.25 * usual)
    holes = np.flatnonzero(np.diff(other) > longest)
    following = np.searchsorted(other[holes + 1], t[:-1], "right")
    spoiled = np.append(other[holes], np.inf)[following] < t[1:]
    inside = (t[:-1] >= other[0]) & (t[1:] <= other[-1])
    return np.asarray(inside & ~spoiled & (steps < GAP * usual))


def running_integral(channel: Channel, at: FloatArray) -> FloatArray:
    """Running integral (trapezoidal) of a channel, read at times `at`, shape (m, columns)."""
    area = 0.5 * (channel.values[1:] + channel.values[:-1]) * np.diff(channel.t)[:, None]
    total = np.concatenate([np.zeros((1, area.shape[1])), np.cumsum(area, axis=0)])
    return linear(channel.t, total, at)


_SAME = 0.98
"""Correlation above which two changes of position are the same motion, seen by two channels."""


def position_check(log: Log) -> Check | None:
    """Integral of the velocity against the change of position: scale and correlation; None where one is not logged.

    Horizontal axes together, the vertical one by itself: an estimator that scales one of them is wrong in one.
    """
    channels = (log.read or log.recording).channels
    position, velocity = (channels.get(name) for name in ("position", "velocity"))
    if position is None or velocity is None or min(len(position.t), len(velocity.t)) < FEWEST_SAMPLES:
        return None
    # Changes of position and integrals of velocity, both (m, 3), over overlapping stretches of a second, which is slow
    # enough for delays and low-passes of either not to count; and the number of independent ones
    period = sample_period(position.t)
    steps, every = max(round(1.0 / period), 1), max(round(0.1 / period), 1)
    broken = np.concatenate([[0], np.cumsum(~usable_steps(position.t, velocity.t))])
    start = np.arange(0, len(position.t) - steps, every)
    start = start[broken[start + steps] == broken[start]]
    path = running_integral(velocity, position.t)
    moved, flown = (x[start + steps] - x[start] for x in (position.values, path))
    finite = np.isfinite(moved).all(axis=1) & np.isfinite(flown).all(axis=1)
    moved, flown, independent = moved[finite], flown[finite], float(np.count_nonzero(finite)) * every / steps
    if independent < 4.0:
        return _position_is(UNKNOWN, "too few stretches without a gap to compare")
    fit = fit_axes(moved, flown)
    turned = fit.axes != (0, 1, 2) or min(fit.signs[:2]) < 0
    least = 0.1  # [m], as standard deviation; below, noise of the position may decide
    if np.max(np.std(moved[:, :2], axis=0)) > least and fit.r2 > _SAME**2 and turned:
        message = f"world axes of velocity differ from those of position: {fit} (R^2 {fit.r2:.2f})"
        return _position_is(WARNING, message, "use NED for both; ROS' ENU swaps x and y", {"r2": fit.r2})
    numbers: dict[str, float] = {}
    scales: list[str] = []
    off: list[str] = []
    unit = False
    for where, axes in (("horizontally", (0, 1)), ("vertically", (2,))):
        p, v = (x[:, axes] - x[:, axes].mean(axis=0) for x in (moved, flown))
        correlation = float(np.sum(p * v) / np.sqrt(max(np.sum(p * p) * np.sum(v * v), 1e-300)))
        motion = np.max(np.std(p, axis=0))
        if where == "vertically" and motion > 0.2 * least and correlation < -0.8:
            message = f"position rises where velocity falls (correlation {correlation:.2f}): one of them points up"
            fix = "negate z or vz: the world is NED, its z down"
            return _position_is(ERROR, message, fix, {"correlation": correlation})
        if motion < least or correlation < _SAME:
            continue
        # Both have errors: the ratio of their sizes, not a regression of one on the other.
        scale = float(np.sqrt(np.sum(v * v) / np.sum(p * p)))
        error = scale * np.sqrt(max(1.0 - correlation**2, 0.0) / (independent * len(axes)))
        numbers |= {f"scale {where}": scale, f"correlation {where}": correlation}
        scales.append(f"{scale:.3f} ± {error:.3f} {where} (correlation {correlation:.4f})")
        unit |= not 1.0 / _UNIT < scale < _UNIT
        # Beyond chance, and enough to matter to whoever predicts positions
        if abs(scale - 1.0) > max(ALLOWED, 4.0 * error):
            off.append(f"{abs(scale - 1.0):.1%} {'larger' if scale > 1.0 else 'smaller'} {where}")
    if not scales:
        message = "velocity does not follow the change of position clearly, or the vehicle hardly moves"
        return _position_is(UNKNOWN, message)
    measured = f"velocity against change of position: {', '.join(scales)}"
    if unit:
        fix = "write position in m and velocity in m/s"
        return _position_is(ERROR, f"{measured}: they are in different units", fix, numbers)
    if not off:
        return _position_is(OK, measured, numbers=numbers)
    message = (
        f"the logged velocity is {' and '.join(off)} than the logged change of position ({measured}): the scale of one "
        "of them is wrong; a simulation fitted to such a log misses positions by as much, unless it has "
        "`velocity_scale`"
    )
    fix = "check the scale of the positioning system and of the estimator's velocity (flow sensor, marker distances)"
    return _position_is(WARNING, message, fix, numbers)
