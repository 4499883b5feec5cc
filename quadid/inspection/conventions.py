"""Units and frames, tested by physics: gravity, gyro against attitude, velocity against attitude and accelerometer."""

from __future__ import annotations

from functools import partial
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from quadid.inspection.airborne import Spans, within
from quadid.inspection.findings import Check, CheckResult
from quadid.resample import linear, sample_period
from quadid.resampling_plan import GAP
from quadid.rotation import conjugate, rotated, turn
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY
from quadid.window import Channel, Recording

DEGREES = 57.29577951308232
"""Degrees in a radian."""
_CLEAR = 0.5
"""R^2 above which a relation between two channels is believed."""
_MOTION = 0.03
"""Rotation rate [rad/s] an axis must have, as standard deviation, to be checked."""
_STEP = 0.1
"""Attitudes are compared over steps of at least this [s]: noise and repeated readings matter little then."""
_JUMP = 8.0
"""An attitude step of so many times the usual one, beside half as much of the gyro's, is no motion."""
_FARTHEST, _LAG, _TOO_LATE = 0.3, 0.02, 0.08
"""Gyro and attitude are compared at times so far apart at most [s], in these steps; more than the last is an error."""
_REVERSED = 0.7
"""Correlation below the negative of which a vertical signal points up."""
_RESTING = 50
"""Samples on the ground that tell the length of gravity."""
_AXES = ("x", "y", "z")


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
    cross, power, total = y.T @ x, np.sum(x**2, axis=0), float(np.sum(y**2))
    straight = tuple(range(x.shape[1]))
    clear = cross**2 > _CLEAR * np.outer(np.sum(y**2, axis=0), power)
    best = AxisMap(straight, (1,) * x.shape[1], np.nan, 0.0)
    for axes in permutations(range(x.shape[1])):
        for signs in product((1, -1), repeat=x.shape[1]):
            moved = [(i, a) for i, a, s in zip(straight, axes, signs, strict=True) if a != i or s < 0]
            if moved and not any(clear[place] for place in moved):
                continue
            gain = sum(s * cross[i, a] for i, (a, s) in enumerate(zip(axes, signs, strict=True)))
            norm = float(sum(power[a] for a in axes))
            if gain > 0.0 and norm > 0.0 and total > 0.0:
                r2 = float(gain**2 / norm / total)
                if r2 > best.r2 + 1e-9:
                    best = AxisMap(axes, signs, float(gain / norm), r2)
    return best


def _fit_without_jumps(source: FloatArray, target: FloatArray) -> AxisMap:
    """Fits twice, the second time without rows far off (estimators reset their heading, and rows jump with it)."""
    fit = fit_axes(source, target)
    if not np.isfinite(fit.scale):
        return fit
    miss = np.linalg.norm(target - fit.scale * source[:, fit.axes] * np.array(fit.signs), axis=1)
    return fit_axes(*(rows[miss <= _JUMP * np.median(miss)] for rows in (source, target)))


def gravity_check(recording: Recording, spans: Spans) -> Check:
    """Length and direction of the mean specific force: 9.8 m/s^2 along -z in FRD."""
    accel = recording.channels.get("accel")
    if accel is None:
        return Check("gravity", CheckResult.UNKNOWN, "no accelerometer")
    inside = within(accel.t, spans) if spans else np.ones(len(accel.t), dtype=np.bool_)
    values = accel.values[inside]
    if not len(values):
        return Check("gravity", CheckResult.UNKNOWN, "no accelerometer sample in flight")
    length = float(np.median(np.linalg.norm(values, axis=1)))
    z = float(np.median(values[:, 2]))
    steady = float(np.linalg.norm(np.median(values, axis=0)))
    check = partial(Check, "gravity", numbers={"length": length, "z": z})
    message = f"specific force has length {length:.4g} and z {z:.4g} (medians; about 9.81 and -9.81 m/s^2 expected)"
    if not _reads_gravity_at_rest(accel.values[~inside]):
        for unit, factor in (("g", GRAVITY), ("milli-g (or cm/s^2)", GRAVITY * 1e-3)):
            if 0.7 < length * factor / GRAVITY < 1.6 and steady > 0.5 * length:
                fix = f"multiply acceleration by {factor:.6g}"
                return check(CheckResult.ERROR, f"{message}: it seems to be in {unit}", fix)
        if spans and steady < 0.3 * GRAVITY:
            fix = "log specific force, not linear acceleration"
            return check(CheckResult.ERROR, f"{message}: gravity is missing", fix)
        if not 0.5 < length / GRAVITY < 2.0:
            return check(CheckResult.ERROR, f"{message}: this is no specific force in m/s^2", "log raw acceleration")
    if z > -0.5 * length and _attitude_explains(accel, recording.channels.get("attitude"), inside):
        return check(CheckResult.UNKNOWN, f"{message}; its attitude says that the vehicle lies or turns so")
    if not spans and abs(z) < 0.8 * length:
        return check(CheckResult.UNKNOWN, f"{message}; the vehicle does not fly in this log")
    if z > 0.5 * length:
        turned = f"{message}: z points up (FLU, as ROS has it) or the sign is reversed"
        return check(CheckResult.ERROR, turned, "turn body vectors to FRD: negate y and z")
    if z > -0.5 * length:
        return check(CheckResult.ERROR, f"{message}: gravity is not along z", "check the axes of the IMU")
    return check(CheckResult.OK, message)


def _reads_gravity_at_rest(values: FloatArray) -> bool:
    """Whether specific force on the ground, shape (n, 3), has the length that it must have [m/s^2]."""
    return len(values) >= _RESTING and abs(float(np.median(np.linalg.norm(values, axis=1))) / GRAVITY - 1.0) < 0.1


def _attitude_explains(accel: Channel, attitude: Channel | None, inside: BoolArray) -> bool:
    """Whether the attitude turns the specific force of the rows `inside` to one g upwards."""
    if attitude is None or len(attitude.t) < 2:
        return False
    world = np.median(_in_world(accel, attitude)[inside], axis=0)
    return bool(np.linalg.norm(world + [0.0, 0.0, GRAVITY]) < 0.3 * GRAVITY)


def attitude_check(recording: Recording) -> Check:
    """Attitude against gyro (axes, signs, degrees for radians) and against gravity (a world with z down)."""
    rates = gyro_check(recording)
    accel, attitude = recording.channels.get("accel"), recording.channels.get("attitude")
    if rates.verdict is CheckResult.ERROR or accel is None or attitude is None or len(attitude.t) < 2:
        return rates
    down = float(np.median(_in_world(accel, attitude)[:, 2]))
    if down < 0.5 * GRAVITY:
        return rates
    return Check(
        rates.name, CheckResult.ERROR,
        f"the attitude turns what the accelerometer reads to point down ({down:.3g} m/s^2): its world has z up",
        "convert attitude, velocity and position to NED; ROS uses east, north, up (ENU)",
    )  # fmt: skip


def gyro_check(recording: Recording) -> Check:
    """Gyro against differentiated attitude: axes, signs and scale (degrees for radians)."""
    gyro, attitude = recording.channels.get("gyro"), recording.channels.get("attitude")
    if gyro is None or attitude is None or min(len(gyro.t), len(attitude.t)) < 20:
        return Check("gyro_attitude", CheckResult.UNKNOWN, "needs gyro and attitude")
    best: tuple[str, AxisMap] | None = None
    for name, q in _attitude_readings(attitude.values):
        measured, derived = _moving_rates(gyro, attitude.t, q)
        if len(measured) < 20:
            continue
        fit = _fit_without_jumps(measured, derived)
        if best is None or _likely(name, fit) > _likely(*best):
            best = (name, fit)
    if best is None:
        return Check("gyro_attitude", CheckResult.UNKNOWN, "too little rotation to compare gyro and attitude")
    late = _apart(gyro, attitude, best[1].r2) if best[0] == "as given" else None
    return late or _judge_rates(*best)


def _apart(gyro: Channel, attitude: Channel, now: float) -> Check | None:
    """An error where the gyro follows the attitude clearly better at another time; `now` is R^2 at its own."""
    found = []
    for lag in np.arange(-_FARTHEST, _FARTHEST + 1e-9, _LAG):
        rows = _moving_rates(Channel("gyro", gyro.t - lag, gyro.values), attitude.t, attitude.values)
        found.append((fit_axes(*rows).r2 if len(rows[0]) >= 20 else 0.0, float(lag)))
    r2, lag = max(found)
    if abs(lag) < _TOO_LATE or r2 < _CLEAR or r2 - now < 0.5 * (1.0 - now):
        return None
    which = ("gyro", "attitude") if lag > 0.0 else ("attitude", "gyro")
    return Check(
        "gyro_attitude", CheckResult.ERROR,
        f"{which[0]} comes {1e3 * abs(lag):.0f} ms after the {which[1]} (R^2 {r2:.2f} there, {now:.2f} as stamped)",
        f"stamp the {which[0]} when it is measured, on the clock of the {which[1]}", {"lag_s": lag, "r2": r2},
    )  # fmt: skip


def _moving_rates(gyro: Channel, t: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rates as of `_rates` over steps long enough for the motion to stand above the attitude's noise; none if still.

    White attitude noise adds a variance that falls with the square of the step and motion one that does not, so two
    steps separate them: motion = (4 var(2 step) - var(step)) / 3.
    """
    stride = max(1, round(_STEP / sample_period(t)))
    measured, derived = _without_jumps(*_rates(gyro, t[::stride], q[::stride]))
    longer = _without_jumps(*_rates(gyro, t[:: 2 * stride], q[:: 2 * stride]))[1]
    if len(longer) < 20:
        return longer[:0], longer[:0]
    total = np.var(derived, axis=0)
    motion = np.maximum((4.0 * np.var(longer, axis=0) - total) / 3.0, 0.0)
    if max(np.max(np.sqrt(motion)), np.max(np.std(measured, axis=0))) < _MOTION:
        return longer[:0], longer[:0]
    if np.sum(motion) > 0.8 * np.sum(total):
        return measured, derived
    return _rates(gyro, t[:: 4 * stride], q[:: 4 * stride])


def _without_jumps(measured: FloatArray, derived: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rates without rows in which the attitude jumps and the gyro does not: an estimator reset its heading there."""
    if not len(derived):
        return measured, derived
    turned, felt = (np.linalg.norm(rows, axis=1) for rows in (derived, measured))
    jumps = (turned > _JUMP * np.median(turned)) & (felt < 0.5 * _JUMP * np.median(felt))
    return measured[~jumps], derived[~jumps]


def _likely(reading: str, fit: AxisMap) -> float:
    """R^2, with a bonus for axes that agree and one for taking the numbers as given."""
    return fit.r2 + (0.1 if fit.straight else 0.0) + (0.05 if reading == "as given" else 0.0)


def _judge_rates(reading: str, fit: AxisMap) -> Check:
    check = partial(Check, "gyro_attitude", numbers={"scale": fit.scale, "r2": fit.r2})
    if fit.r2 < _CLEAR:
        message = f"gyro does not follow the attitude (R^2 {fit.r2:.2f})"
        remedy = "check units, axes and time stamps of both; quaternions are scalar first, body to world"
        return check(CheckResult.ERROR, message, remedy)
    if reading != "as given":
        message = f"attitude fits the gyro only when read as {reading} (R^2 {fit.r2:.2f})"
        return check(CheckResult.ERROR, message, "write wxyz quaternions, body to world, FRD to NED")
    if not fit.straight:
        message = f"gyro axes differ from the attitude's: {fit} (R^2 {fit.r2:.2f})"
        remedy = "body axes must be FRD for both; ROS' FLU has y and z reversed"
        if (fit.axes, fit.signs) == ((1, 0, 2), (1, 1, -1)):
            remedy = "that is an attitude in world axes east, north, up (ENU): turn it, velocity and position into NED"
        return check(CheckResult.ERROR, message, remedy)
    for scale, what in ((1.0 / DEGREES, "gyro seems to be in deg/s"), (DEGREES, "attitude seems to be in degrees")):
        if 0.75 < fit.scale / scale < 1.33:
            return check(CheckResult.ERROR, f"{what} (attitude rate / gyro = {fit.scale:.3g})", "convert to radians")
    message = f"attitude rate / gyro = {fit.scale:.3f} (R^2 {fit.r2:.2f})"
    if 0.85 < fit.scale < 1.15:
        return check(CheckResult.OK, message)
    return check(CheckResult.WARNING, message, "check scales and filters")


def velocity_check(recording: Recording) -> Check:
    """Change of world velocity against rotated specific force and gravity: world frame of attitude and velocity."""
    channels = recording.channels
    accel, attitude, velocity = (channels.get(n) for n in ("accel", "attitude", "velocity"))
    if accel is None or attitude is None or velocity is None or min(map(len, (accel.t, attitude.t, velocity.t))) < 20:
        return Check("velocity_attitude", CheckResult.UNKNOWN, "needs accelerometer, attitude and velocity")
    gained, derived = _velocity_gains(accel, attitude, velocity)
    level = _level_velocity(gained, derived)
    if level.verdict is CheckResult.ERROR or len(gained) < 20 or not _upwards(gained[:, 2], derived[:, 2]):
        return level
    return Check(
        "velocity_attitude", CheckResult.ERROR, "vertical velocity rises where the force pushes down: it points up",
        "negate vz, and z if it points up too: the world is NED", {"vertical": -1.0},
    )  # fmt: skip


def _level_velocity(gained: FloatArray, derived: FloatArray) -> Check:
    """Horizontal axes of `velocity_check`."""
    if len(gained) < 20 or np.max(np.std(gained[:, :2], axis=0)) < 0.2:
        return Check("velocity_attitude", CheckResult.UNKNOWN, "too little horizontal acceleration to compare")
    fit = fit_axes(derived[:, :2], gained[:, :2])
    check = partial(Check, "velocity_attitude", numbers={"scale": fit.scale, "r2": fit.r2})
    if fit.r2 < _CLEAR:
        return check(CheckResult.UNKNOWN, f"velocity does not follow tilt and thrust clearly (R^2 {fit.r2:.2f})")
    if not fit.straight:
        message = f"world axes of velocity differ from the attitude's: {fit} (R^2 {fit.r2:.2f})"
        return check(CheckResult.ERROR, message, "use NED for both; ROS' ENU swaps x and y")
    return check(CheckResult.OK, f"velocity follows tilt and thrust (scale {fit.scale:.3g}, R^2 {fit.r2:.2f})")


def _upwards(gained: FloatArray, derived: FloatArray) -> bool:
    """Whether vertical changes (n,) are clearly the reverse of what force makes (n,)."""
    return bool(min(np.std(gained), np.std(derived)) > 0.2 and np.corrcoef(gained, derived)[0, 1] < -_REVERSED)


def _attitude_readings(q: FloatArray) -> list[tuple[str, FloatArray]]:
    """Ways in which four numbers may have been meant."""
    return [
        ("as given", q),
        ("world to body", conjugate(q)),
        ("x y z w (scalar last)", q[:, [3, 0, 1, 2]]),
    ]


def _rates(gyro: Channel, t: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns mean gyro and rotation over each interval between attitudes [rad/s], both (m, 3)."""
    keep = usable_steps(t, gyro.t)
    mean = np.diff(running_integral(gyro, t), axis=0)[keep] / np.diff(t)[keep, None]
    return mean, turn(q[:-1], q[1:])[keep] / np.diff(t)[keep, None]


def _velocity_gains(accel: Channel, attitude: Channel, velocity: Channel) -> tuple[FloatArray, FloatArray]:
    """Returns mean acceleration [m/s^2] over steps of at least 0.2 s, of the velocity and from force, both (m, 3)."""
    force = _in_world(accel, attitude) + np.array([0.0, 0.0, GRAVITY])
    stride = max(1, round(0.2 / sample_period(velocity.t)))
    t, speed = velocity.t[::stride], velocity.values[::stride]
    keep = usable_steps(t, accel.t) & usable_steps(t, attitude.t)
    world = Channel("accel", accel.t, force)
    derived = np.diff(running_integral(world, t), axis=0)[keep] / np.diff(t)[keep, None]
    return np.diff(speed, axis=0)[keep] / np.diff(t)[keep, None], derived


def _in_world(accel: Channel, attitude: Channel) -> FloatArray:
    """Specific force in the attitude's world [m/s^2], shape (n, 3), at the accelerometer's times."""
    q = linear(attitude.t, attitude.values, accel.t)
    return rotated(q / np.linalg.norm(q, axis=1, keepdims=True), accel.values)


def usable_steps(t: FloatArray, other: FloatArray) -> BoolArray:
    """Tells which steps of `t` have no gap, neither in `t` nor in the other channel's times."""
    steps = np.diff(t)
    longest = GAP * sample_period(other)
    holes = np.flatnonzero(np.diff(other) > longest)
    following = np.searchsorted(other[holes + 1], t[:-1], "right")
    spoiled = np.append(other[holes], np.inf)[following] < t[1:]
    inside = (t[:-1] >= other[0]) & (t[1:] <= other[-1])
    return np.asarray(inside & ~spoiled & (steps < GAP * np.median(steps)))


def running_integral(channel: Channel, at: FloatArray) -> FloatArray:
    """Running integral (trapezoidal) of a channel, read at times `at`, shape (m, columns)."""
    area = 0.5 * (channel.values[1:] + channel.values[:-1]) * np.diff(channel.t)[:, None]
    total = np.concatenate([np.zeros((1, area.shape[1])), np.cumsum(area, axis=0)])
    return linear(channel.t, total, at)
