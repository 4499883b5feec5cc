"""Checks of grid rows and windows of a stream before anything is learned from them."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.checks import LIVE
from quadid.checks.findings import ERROR
from quadid.checks.motion import (
    ALLOWED,
    AXES,
    FEWEST,
    MOVING,
    STUCK,
    TURN,
    TURN_FACTOR,
    Factor,
    Log,
    changes_of_turn,
    factors,
    turn_moments,
)
from quadid.checks.rotors import better_description, lagged_of, motor_order_check
from quadid.data.grid import moving_mean
from quadid.data.window import Window, as_recording, at_limit, copied, true_runs
from quadid.model.layout import ThrustModel
from quadid.online.grid_buffer import Rows, WindowCut
from quadid.rotation import down, turn
from quadid.types import FloatArray, IndexArray
from quadid.vehicle import GRAVITY, Vehicle

# --- Do the sensors agree?  Factors of channels against each other, from physics that needs no model of the vehicle
#
# * Gyro against attitude: `quadid.checks.motion`.
# * Accelerometer against gravity: the vertical specific force of a flight is g on average, because velocity stays
#   small.
#
# Every factor is estimated from the last data that tell it, with its standard deviation; it ought to be 1, what leaks
# 0. One that is not has two channels that may be to blame: both are named.  Data fade, and in the end are dropped: a
# channel that was wrong by a thousand would outweigh for minutes all that is right after it.


MEMORY, GONE = 30.0, 45.0
"""Data that tell a factor fade with this time constant, and are gone at this age [s of such data]."""
LEAD = 2.0 * TURN
"""A change of turn needs so much of the past [s]."""
GRAVITY_FACTOR = "accelerometer over gravity by the attitude"


class _Fading:
    """Moments of data that tell a factor, fading; what is older than `GONE` leaves no trace."""

    def __init__(self, *shape: int) -> None:
        self._parts: deque[tuple[float, FloatArray]] = deque()
        self.seconds, self.sum = 0.0, np.zeros(shape)

    def add(self, seconds: float, moments: FloatArray) -> None:
        """Takes in the moments of some seconds of data."""
        self._parts.appendleft((seconds, moments))
        lengths = np.array([length for length, _ in self._parts])
        ages = np.cumsum(lengths) - lengths
        while ages[-1] > GONE - 0.5 * seconds:
            self._parts.pop()
            ages = ages[:-1]
        fade = np.exp(-ages / MEMORY)
        self.seconds = float(fade @ lengths[: len(ages)])
        self.sum = np.asarray(sum(f * part for f, (_, part) in zip(fade, self._parts, strict=True)))


class Consistency:
    """Factors of the channels of one stream."""

    def __init__(self) -> None:
        """Starts empty."""
        self.restart()

    def restart(self) -> None:
        """Begins anew: another stream."""
        # Moments of (changes of turn by the gyro about x, y, z, of rate, of turn by the attitude), for each axis.
        self._turns = [_Fading(5, 5) for _ in AXES]
        self._force = _Fading()
        self._compared = False

    def add(self, rows: Rows | None, seconds: float) -> None:
        """Takes in the last `seconds` of the rows, before which there should be `LEAD` that were taken in earlier."""
        if rows is None or len(rows.t) < 2 or "attitude" not in rows.columns:
            return
        step, q, self._compared = float(rows.t[1] - rows.t[0]), rows.columns["attitude"], True
        if "gyro" in rows.columns:
            gyro = rows.columns["gyro"]
            changes = changes_of_turn(gyro, q, step)
            moving = np.sqrt(np.mean(gyro[np.isfinite(gyro).all(axis=1)] ** 2, axis=0)) > MOVING
            for axis in np.flatnonzero(moving).tolist() if len(changes[0]) else ():
                self._turns[axis].add(len(changes[0]) * step, turn_moments(changes, axis, step))
        if "accel" in rows.columns:
            new = round(seconds / step)
            force = -np.sum(down(q[-new:]) * rows.columns["accel"][-new:], axis=1)
            force = force[np.isfinite(force)]
            if len(force):
                self._force.add(len(force) * step, np.asarray(force.sum() * step))

    def factors(self) -> tuple[Factor, ...]:
        """Every factor of which there are data: of the gyro by axis, what leaks into it, of the accelerometer."""
        told = [(axis, t) for axis, t in enumerate(self._turns) if t.seconds > FEWEST * TURN]
        found = [f for axis, t in told for f in factors(axis, t.seconds, t.sum)]
        if (seconds := self._force.seconds) > 0.0:
            # The mean of an acceleration is a change of velocity, which stays within 1.5 m/s, over a time.
            sigma = math.sqrt(2.0) * 1.5 / seconds / GRAVITY
            found.append(Factor(GRAVITY_FACTOR, float(self._force.sum) / seconds / GRAVITY, sigma))
        return tuple(found)

    @property
    def fault(self) -> str:
        """Channels that contradict each other, and what is waited for; empty where none do."""
        wrong = [f for f in self.factors() if f.disagrees]
        if not wrong:
            return ""
        worst = max(wrong, key=lambda f: abs(f.off))
        return f"sensors disagree: {worst}, allowed {worst.ideal:g} +- {ALLOWED:g}; nothing is learned until they agree"

    def doubts(self) -> tuple[Factor, ...]:
        """Products that b, J_xx and J_yy are off by: of the accelerometer alone, and of it and the gyro about an axis.

        Each channel may be within its own limit and all together not; so may what leaks into an axis, beyond its
        standard error and by its share of that axis' turns.  Yaw may turn too little for ever; a stream without an
        attitude allows no comparison at all.
        """
        if not self._compared:
            return ()
        force = next((f for f in self.factors() if f.what == GRAVITY_FACTOR), None)
        found = [force] if force is not None else []
        for axis, told in enumerate(self._turns[:2]):
            turns, leaked = Factor(f"{AXES[axis]} {TURN_FACTOR}", 1.0, math.inf), 0.0
            if told.seconds > FEWEST * TURN:
                (turns, *leaks), size = factors(axis, told.seconds, told.sum), np.sqrt(np.diag(told.sum))
                beyond = [max(abs(f.value) - f.sigma, 0.0) for f in leaks]
                leaked = float(np.array(beyond) @ np.delete(size[:3], axis) / size[axis])
            what, value, sigma = turns.what, turns.value, turns.sigma
            if force is not None:
                what, value, sigma = f"{force.what} times {what}", force.value * value, math.hypot(force.sigma, sigma)
            found.append(Factor(what, value + math.copysign(leaked, value - 1.0), sigma))
        return tuple(found)


# --- Is this window fit to be learned from?  Stuck, saturated or mis-scaled sensors, and whether the vehicle flies


IMPACT = 8.0 * GRAVITY
"""Specific force [m/s^2] that only a crash brings."""


@dataclass(frozen=True)
class Quality:
    """Verdict on one window: `fault` names a broken sensor, `grounded` why it is not flight; both empty when good.

    `carried`: it is not flight only because the specific force does not follow the thrust.  A load that is taken up in
    hover looks alike: there the thrust follows the weight.
    `until`: end of the last second in which the rotors carry too little [s], where there is one.
    """

    fault: str = ""
    grounded: str = ""
    carried: bool = False
    until: float = -math.inf


def judge(cut: WindowCut, vehicle: Vehicle, thrust: ThrustModel, known: bool, units: bool = True) -> Quality:
    """Judges the windows of one fit.

    Args:
        thrust: of the rotors, by the best estimate at hand.
        known: whether it was identified or is a guess.
        units: False: units and frames of a good window are left to its fit.
    """
    # Mean thrust over weight of a flying vehicle; a thrust coefficient that is a guess leaves more room.
    low, high = (0.4, 4.0) if known else (0.2, 5.0)
    still = carried = ""
    for window in cut.windows:
        # First whether the rotors lift, second by second from the end: at rest sensors may repeat themselves.
        share, second = thrust.total(window.rotor_speed) / (vehicle.mass * GRAVITY), max(round(1.0 / window.dt), 1)
        first = len(share) % second or second
        means = [float(part.mean()) for part in np.split(share, np.arange(first, len(share), second))]
        if idle := [i for i, mean in enumerate(means) if not mean > low]:
            until = float(window.t[0]) + window.dt * (first + idle[-1] * second)
            return Quality(grounded=f"rotors carry {min(means):.0%} of the weight: on the ground", until=until)
        if not max(means) < high and low < float(np.mean(means)) / (30.0 / np.pi) ** 2 < high:
            return Quality(fault="rotor speeds look like rpm, wanted rad/s")
        if not max(means) < high:
            return Quality(grounded=f"rotors carry {max(means):.0%} of the weight: not this vehicle, or not flying")
        if fault := _broken(window):
            return Quality(fault=fault)
        # Then whether it is flight, whatever they give
        felt = window.accel
        if window.attitude is not None and np.any(down(window.attitude)[:, 2] < 0.0):
            still = still or "tumbled, or lying on its side"
        elif felt is not None and np.nanmax(np.linalg.norm(felt, axis=1), initial=0.0) > IMPACT:
            still = still or f"a knock of more than {IMPACT / GRAVITY:.0f} g: landing or crash"
        carried = carried or _floor(window, share)
    if (units or still or carried) and (fault := mistake(cut, vehicle, known)):
        return Quality(fault=fault)
    return Quality(grounded=still or carried, carried=not still and bool(carried))


def _broken(window: Window) -> str:
    """The sensor that is stuck or saturated; empty where none is."""
    for name in ("gyro", "accel", "attitude", "rotor_speed"):
        values = getattr(window, name)
        if values is None:
            continue
        here = np.flatnonzero(np.isfinite(values).all(axis=1))
        for first, end in zip(*true_runs(copied(values[here])), strict=True):
            if end - first > round(STUCK / window.dt) and _moves(window, name, here[first : end + 1]):
                return f"{name} is stuck: it repeated the same value for more than {STUCK:g} s"
        if name in ("gyro", "accel") and (ends := at_limit(values[here])):
            return f"{name} axis {'xyz'[ends[0].axis]} is saturated at {ends[0].level:.4g}: widen its range"
    return ""


def _moves(window: Window, name: str, rows: IndexArray) -> bool:
    """True if the others say that a sensor which repeats itself ought not to; coarse ones do so in a calm hover.

    They do by gyro and attitude beside its bias, or by the scatter of the thrust as a share of it.
    """
    gyro, q = (None if v is None else v[rows] for v in (window.gyro, window.attitude))
    if name in ("gyro", "attitude"):
        if gyro is None or q is None:
            return True
        turned = np.cumsum(gyro[:-1], axis=0) * window.dt
        apart = np.abs(turned - turn(np.broadcast_to(q[0], q[1:].shape), q[1:]))
        return bool(np.nanmax(apart) > 0.02 + 0.02 * window.dt * len(rows))  # [rad], beside the gyro's bias
    if gyro is not None and (name == "accel" and copied(gyro).mean() < 0.5 or np.nanstd(gyro, axis=0).max() > MOVING):
        return True  # one chip reads both: where one has noise, so has the other
    lift = np.sum(window.rotor_speed[rows] ** 2, axis=1)
    if name == "rotor_speed":
        if window.accel is None:
            return False
        lift = moving_mean(window.accel[rows, 2:], max(round(TURN / window.dt), 1))[:, 0]
    return bool(np.nanstd(lift) > 0.02 * abs(np.nanmean(lift)))


def _floor(window: Window, thrust: FloatArray) -> str:
    """The accelerometer must follow the thrust where the thrust varies enough to tell.

    On the ground the floor carries the rest, and the accelerometer reads gravity whatever the rotors do.
    """
    if window.accel is None:
        return ""
    width = max(round(0.1 / window.dt), 1)
    rows = len(thrust) // width * width
    force = -window.accel[:rows, 2].reshape(-1, width) / GRAVITY
    given = thrust[:rows].reshape(-1, width)
    both = np.isfinite(force).all(axis=1)
    x, y = given[both].mean(axis=1), force[both].mean(axis=1)
    if len(x) < 10 or np.ptp(x) == 0.0:
        return ""
    x, y = x - x.mean(), y - y.mean()
    power = float(x @ x)
    slope = float(x @ y) / power
    error = float(np.sqrt(np.sum((y - slope * x) ** 2) / max(len(x) - 2, 1) / power))
    # On the ground it does not follow at all.
    if slope + 3.0 * error < 0.2 and error < 0.2:
        return f"specific force follows thrust with slope {slope:.2f} only: something carries the vehicle"
    return ""


def mistake(cut: WindowCut, vehicle: Vehicle, known: bool) -> str:
    """Names the wrong unit or frame, or order of rotors, that would be fitted, and how to mend it; empty for nothing.

    Rotors of a vehicle that is `known`, for it was identified, are in order.
    """
    if (fault := wrong_unit(cut.windows)) or known:
        return fault
    lagged = lagged_of(cut.windows, vehicle, min((1.0 / (cut.spacing * w.dt) for w in cut.windows), default=0.0))
    check = motor_order_check(lagged, vehicle, better_description(lagged, vehicle))
    return f"motor order: {check.message}; {check.fix}" if check.verdict is ERROR else ""


def wrong_unit(windows: Sequence[Window]) -> str:
    """Names the wrong unit or frame of windows, and how to mend it; empty for nothing."""
    for window in windows:
        log = Log(as_recording([window]), spans=((window.t0, window.t0 + window.dt * len(window)),))
        for check in map(log.once, LIVE):
            if check is not None and check.verdict is ERROR:
                return f"{check.message}; {check.fix}; on ROS topics FLU and ENU: PX4 has FRD and NED"
    return ""
