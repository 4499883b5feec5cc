"""Is this window fit to be learned from?  Stuck, saturated or mis-scaled sensors, and whether the vehicle flies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.inspection.conventions import attitude_check, gravity_check, velocity_check
from quadid.inspection.findings import CheckResult
from quadid.inspection.motor_checks import lagged_of, motor_order_check
from quadid.model.thrust import ThrustModel
from quadid.online.grid_buffer import Cut
from quadid.resample import copied, true_runs
from quadid.rotation import down
from quadid.saturation import at_limit
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from quadid.window import Window, as_recording

STUCK_SECONDS = 1.0
"""A sensor that repeats itself to the bit for longer than this [s] is stuck."""
THRUST_KNOWN = (0.4, 4.0)
"""Mean thrust over weight of a flying vehicle whose thrust coefficient is known."""
THRUST_GUESSED = (0.2, 5.0)
"""... and while it is only the vehicle file's guess."""
RPM_SQUARED = (30.0 / np.pi) ** 2
"""Thrust that speeds in rpm would give, over that of the same speeds in rad/s."""
TUMBLED = 0.0
"""Cosine of the tilt [1] below which the vehicle has tumbled or lies on its side."""
IMPACT = 8.0 * GRAVITY
"""Specific force [m/s^2] that only a crash brings."""
FLOOR_SLOPE = 0.2
"""Specific force must follow thrust at least with this slope [1]; on the ground it does not follow at all."""


@dataclass(frozen=True)
class Quality:
    """Verdict on one window: `fault` names a broken sensor, `grounded` why it is not flight; both empty when good.

    `carried`: it is not flight only because the specific force does not follow the thrust.  A load that is taken up in
    hover looks alike: there the thrust follows the weight.
    """

    fault: str = ""
    grounded: str = ""
    carried: bool = False


def judge(cut: Cut, vehicle: Vehicle, thrust: ThrustModel, known: bool) -> Quality:
    """Judges the windows of one fit.

    Args:
        cut: stretches on the grid.
        vehicle: the vehicle.
        thrust: of the rotors, by the best estimate at hand.
        known: whether it was identified or is a guess.
    """
    # First whether the rotors lift: at rest sensors and rotors may well repeat themselves.
    for window in cut.windows:
        lift = _lift(_weight_share(window, vehicle, thrust), window.dt, known)
        if lift != Quality():
            return lift
        if fault := _broken(window):
            return Quality(fault=fault)
    if fault := mistake(cut, vehicle, known):
        return Quality(fault=fault)
    if why := next((why for w in cut.windows if (why := _not_flying(w))), ""):
        return Quality(grounded=why)
    carried = next((why for w in cut.windows if (why := _floor(w, _weight_share(w, vehicle, thrust)))), "")
    return Quality(grounded=carried, carried=bool(carried))


def _broken(window: Window) -> str:
    still = round(STUCK_SECONDS / window.dt)
    for name in ("gyro", "accel", "attitude", "rotor_speed"):
        values = getattr(window, name)
        if values is None:
            continue
        rows = values[np.isfinite(values).all(axis=1)]
        first, end = true_runs(copied(rows))
        if np.max(end - first, initial=0) > still:
            return f"{name} is stuck: it repeated the same value for more than {STUCK_SECONDS:g} s"
        if name in ("gyro", "accel") and (ends := at_limit(rows)):
            return f"{name} axis {'xyz'[ends[0].axis]} is saturated at {ends[0].level:.4g}: widen its range"
    return ""


def mistake(cut: Cut, vehicle: Vehicle, known: bool) -> str:
    """Names the wrong unit or frame, or the wrong order of rotors, that would be fitted into the parameters.

    Args:
        cut: stretches on the grid.
        vehicle: the vehicle.
        known: whether it was identified: then its rotors are in order.

    Returns:
        What is wrong and how to mend it; empty for nothing.
    """
    units = next((why for window in cut.windows if (why := _wrong_unit(window))), "")
    return units or ("" if known else _wrong_order(cut, vehicle))


def _wrong_unit(window: Window) -> str:
    recording, spans = as_recording([window]), ((window.t0, window.t0 + window.dt * len(window)),)
    for check in (gravity_check(recording, spans), attitude_check(recording), velocity_check(recording)):
        if check.verdict is CheckResult.ERROR:
            return f"{check.message}; {check.fix}; on ROS topics FLU and ENU: PX4 has FRD and NED"
    return ""


def _wrong_order(cut: Cut, vehicle: Vehicle) -> str:
    rate = min((1.0 / (cut.spacing * window.dt) for window in cut.windows), default=0.0)
    check = motor_order_check(lagged_of(cut.windows, vehicle, rate), vehicle)
    return f"motor order: {check.message}; {check.fix}" if check.verdict is CheckResult.ERROR else ""


def _weight_share(window: Window, vehicle: Vehicle, thrust: ThrustModel) -> FloatArray:
    """Thrust over weight, shape (n,)."""
    return np.asarray(thrust.total(window.rotor_speed) / (vehicle.mass * GRAVITY))


def _lift(share: FloatArray, dt: float, known: bool) -> Quality:
    """Whether the rotors carry the vehicle; judged second by second, back from the end."""
    low, high = THRUST_KNOWN if known else THRUST_GUESSED
    second = max(round(1.0 / dt), 1)
    first = len(share) % second or second
    means = [float(part.mean()) for part in np.split(share, np.arange(first, len(share), second))]
    if not min(means) > low:
        return Quality(grounded=f"rotors carry {min(means):.0%} of the weight: on the ground")
    if not max(means) < high and low < float(np.mean(means)) / RPM_SQUARED < high:
        return Quality(fault="rotor speeds look like rpm, wanted rad/s")
    if not max(means) < high:
        return Quality(grounded=f"rotors carry {max(means):.0%} of the weight: not this vehicle, or not flying")
    return Quality()


def _not_flying(window: Window) -> str:
    """Says why a window with turning rotors is not flight, whatever they give, or returns an empty string."""
    if window.attitude is not None and np.any(down(window.attitude)[:, 2] < TUMBLED):
        return "tumbled, or lying on its side"
    if window.accel is None or not np.isfinite(window.accel).any():
        return ""
    if float(np.nanmax(np.linalg.norm(window.accel, axis=1))) > IMPACT:
        return f"a knock of more than {IMPACT / GRAVITY:.0f} g: landing or crash"
    return ""


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
    if len(x) < 10:
        return ""
    x, y = x - x.mean(), y - y.mean()
    power = float(x @ x)
    if power == 0.0:
        return ""
    slope = float(x @ y) / power
    error = float(np.sqrt(np.sum((y - slope * x) ** 2) / max(len(x) - 2, 1) / power))
    if slope + 3.0 * error < FLOOR_SLOPE and error < 0.2:
        return f"specific force follows thrust with slope {slope:.2f} only: something carries the vehicle"
    return ""
