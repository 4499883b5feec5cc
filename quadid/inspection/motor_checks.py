"""Rotor signals against weight and motion: unit of the speeds, order and spin of the motors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import permutations

import numpy as np
from scipy.optimize import nnls

from quadid.errors import QuadidError
from quadid.grid import to_windows
from quadid.inspection.airborne import Spans, within
from quadid.inspection.findings import Check, CheckResult
from quadid.model.supply import voltage_at
from quadid.model.thrust import ThrustModel
from quadid.resample import measured_period, moving_mean
from quadid.rotor_signal import rotor_signal
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from quadid.window import Recording, Window

_UNITS = (
    ("in rpm", 2.0 * np.pi / 60.0), ("in rev/s", 2.0 * np.pi), ("of the electrical field (14 poles)", 1.0 / 7.0),
    ("ten times too low", 10.0),
)  # fmt: skip
"""What speeds may be in instead of rad/s, and the factor that mends it."""
_RATE = 50.0
_SLOW_MOTION = 0.4
"""Motion slower than about 1/0.4 s is left out: there aerodynamics and the controller rule [s]."""
_LEAST_RATE = 30.0
"""Slower rotor readings [Hz] miss the motion that distinguishes orders."""
_LAGS = 5
"""Motors answer late: torque up to this many rows earlier is tried."""
_CLEAR, _MARGIN = 0.25, 0.15
"""Mean correlation that settles an order, and by how much another order must be better."""
_MOST_ROTORS = 6
"""Beyond this only turns and mirror images of the order are tried, not all permutations."""


def hover_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check:
    """Thrust by the vehicle file, with its effects, against weight in flight; separates rpm and rev/s from rad/s."""
    try:
        signal = rotor_signal(recording, vehicle)
    except QuadidError as error:
        return Check("hover", CheckResult.ERROR, error.found, error.fix or f"allowed: {error.allowed}")
    inside = within(signal.t, spans)
    if not inside.any():
        most = float(np.max(ThrustModel.stated(vehicle).total(signal.values))) / (vehicle.mass * GRAVITY)
        message = f"no flight in this log: its rotor speeds carry at most {most:.0%} of the weight"
        fix = "did it fly? Else check mass, the unit of the rotor speeds, and b"
        return Check("hover", CheckResult.WARNING, message, fix, {"most_load": most})
    speeds = signal.values[inside] * _supply(recording, vehicle, signal.t[inside])
    guess, thrust = vehicle.parameters["b"], float(np.mean(ThrustModel.stated(vehicle).total(speeds)))
    needed = guess.initial * vehicle.mass * GRAVITY / thrust if thrust > 0.0 else np.inf
    low, high = guess.limits
    speed = float(np.sqrt(np.mean(speeds**2)))
    check = partial(Check, "hover", numbers={"b_from_hover": needed, "speed_rad_s": speed})
    message = f"rotors turn at {speed:.4g} rad/s in flight (rms), so b would be {needed:.3g} N s^2/rad^2"
    if low <= needed <= high:
        return check(CheckResult.OK, f"{message}; bounds {low:.3g} to {high:.3g}")
    fitting = [(unit, factor) for unit, factor in _UNITS if low <= needed / factor**2 <= high]
    if fitting:
        units, factors = (" or ".join(parts) for parts in zip(*((u, f"{f:.6g}") for u, f in fitting), strict=True))
        slip = f"{message}, outside {low:.3g} to {high:.3g}: speeds seem to be {units}"
        return check(
            CheckResult.ERROR, slip, f"multiply rotor speeds by {factors}, or use the vehicle file of this log"
        )
    root = ThrustModel.stated(vehicle).total(np.sqrt(np.abs(speeds)))
    if low <= guess.initial * vehicle.mass * GRAVITY / max(float(np.mean(root)), 1e-300) <= high:
        return check(CheckResult.ERROR, f"{message}: speeds seem to be squared", "take their square roots")
    few = "did it fly? Else " if needed > high else ""
    fix = few + "check mass, the unit of the rotor speeds, max_speed of the command, or the bounds of b"
    return check(CheckResult.WARNING, f"{message}, outside its bounds {low:.3g} to {high:.3g}", fix)


def _supply(recording: Recording, vehicle: Vehicle, t: FloatArray) -> FloatArray:
    """Factor on the speeds at times `t` [s] by the supply voltage, shape (n, 1) or (1,); 1 where none is known."""
    exponent = vehicle.effects.get("supply_voltage", {}).get("exponent", 0.0)
    battery = recording.channels.get("battery")
    volts = voltage_at(t, battery.t, battery.values[:, 0]) if exponent and battery is not None else None
    if volts is None:
        return np.ones(1)
    return np.asarray((volts / (vehicle.reference_voltage or float(volts.mean()))) ** exponent)[:, None]


Lagged = list[tuple[FloatArray, FloatArray, FloatArray]]
"""Thrust over b (n, rotors), angular acceleration (n, 3) and rotors' own (n, rotors), for each lag of the motors."""


def motor_order_check(lagged: Lagged | str, vehicle: Vehicle) -> Check:
    """Correlates roll, pitch and yaw torque of every motor order with angular acceleration (of `lagged_motion`)."""
    if isinstance(lagged, str):
        return Check("motor_order", CheckResult.UNKNOWN, lagged)
    return _judge_order(lagged, vehicle)


def lagged_motion(recording: Recording, vehicle: Vehicle, spans: Spans) -> Lagged | str:
    """Thrust over b by the vehicle file, angular acceleration and that of the rotors in flight, slow parts left out.

    One entry for each lag of 0, 1, 2 … rows by which the motors may answer late; or why there is none.
    """
    if "gyro" not in recording.channels or not spans:
        return "needs gyro and rotor signal in flight"
    try:
        signal = rotor_signal(recording, vehicle)
        windows = to_windows(recording, vehicle, _RATE, spans[0][0], spans[-1][1])
    except QuadidError as error:
        return error.found
    return lagged_of(windows, vehicle, 1.0 / measured_period(signal.t, signal.values))


def lagged_of(windows: Sequence[Window], vehicle: Vehicle, rate: float) -> Lagged | str:
    """As `lagged_motion`, of windows in flight, with rotor readings at `rate` [Hz]."""
    if rate < _LEAST_RATE:
        return f"rotor signal at {rate:.3g} Hz is too slow to check the motor order"
    thrust, b = ThrustModel.stated(vehicle), vehicle.parameters["b"].initial
    acted = [thrust.single(w.rotor_speed) / b for w in windows]
    lagged = [_fast_motion(windows, acted, lag) for lag in range(_LAGS)]
    return lagged if len(lagged[0][0]) >= 100 else "too little flight to check the motor order"


def _fast_motion(
    windows: Sequence[Window], thrust: list[FloatArray], lag: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns thrust over b and rotor acceleration `lag` rows earlier, and angular acceleration, no slow parts."""
    parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for w, acted in zip(windows, thrust, strict=True):
        width = max(3, round(_SLOW_MOTION / w.dt))
        if w.gyro is None or len(w) < 2 * width + lag or np.isnan(w.gyro).any():
            continue
        # The change over two steps against what acted in between: the row itself and its neighbours' halves.
        acted = (
            0.5 * (acted[:-2] + acted[1:-1])
            if w.sampling == "held"
            else 0.25 * (acted[:-2] + 2 * acted[1:-1] + acted[2:])
        )
        gained, spun = ((rows[2:] - rows[:-2]) / (2.0 * w.dt) for rows in (w.gyro, w.rotor_speed))
        rows = acted[: len(acted) - lag], gained[lag:], spun[: len(spun) - lag]
        acted, gained, spun = (r - moving_mean(r, width, mirrored=True) for r in rows)
        parts.append((acted, gained, spun))
    if not parts:
        return np.empty((0, 0)), np.empty((0, 3)), np.empty((0, 0))
    acted, gained, spun = (np.concatenate(column) for column in zip(*parts, strict=True))
    return acted, gained, spun


def better_order(lagged: Lagged | str, vehicle: Vehicle) -> tuple[int, ...] | None:
    """The order of the log's columns with which torque follows the motion much better; None for none."""
    if isinstance(lagged, str) or _still(lagged):
        return None
    orders = _orders(len(vehicle.rotors))
    means = _correlations(lagged, vehicle, orders).mean(axis=1)
    best = int(np.argmax(means))
    own = float(means[orders.index(tuple(range(len(vehicle.rotors))))])
    return orders[best] if means[best] - own > _MARGIN and means[best] > _CLEAR else None


def reordered(vehicle: Vehicle, order: tuple[int, ...]) -> Vehicle:
    """The vehicle whose rotor k is on column `order[k]` of the log, written for the log's columns."""
    return vehicle.model_copy(update={"rotors": tuple(vehicle.rotors[order.index(k)] for k in range(len(order)))})


def _still(lagged: Lagged) -> bool:
    return float(np.max(np.std(lagged[0][1], axis=0))) < 0.05


def _judge_order(lagged: Lagged, vehicle: Vehicle) -> Check:
    if _still(lagged):
        return Check("motor_order", CheckResult.UNKNOWN, "too little rotation to check the motor order")
    own = _correlations(lagged, vehicle, [tuple(range(len(vehicle.rotors)))])[0]
    numbers = {f"correlation_{axis}": float(c) for axis, c in zip(("roll", "pitch", "yaw"), own, strict=True)}
    check = partial(Check, "motor_order", numbers=numbers)
    text = f"correlation of torque and angular acceleration: roll {own[0]:.2f}, pitch {own[1]:.2f}, yaw {own[2]:.2f}"
    if found := better_order(lagged, vehicle):
        mean = float(_correlations(lagged, vehicle, [found]).mean())
        order = ", ".join(str(i + 1) for i in found)
        better = f"{text}; much better ({mean:.2f} on average) with the log's columns in the order {order}"
        return check(CheckResult.ERROR, better, f"reorder the rotors of the vehicle file to take columns {order}")
    right, reversed_ = (_yaw_explained(lagged, vehicle, sign) for sign in (1.0, -1.0))
    if own[2] < -_CLEAR or (own[2] < _CLEAR < reversed_ and reversed_ - right > _MARGIN):
        turned = f"{text}: yaw is reversed (with the other spins {reversed_:.2f}, drag and spin-up of the rotors)"
        return check(CheckResult.ERROR, turned, "negate the spins in the vehicle file")
    if min(own[0], own[1]) > _CLEAR:
        return check(CheckResult.OK, text)
    return check(CheckResult.UNKNOWN, f"{text}: too weak to judge")


def _yaw_explained(lagged: Lagged, vehicle: Vehicle, sign: float) -> float:
    """Correlation of yaw acceleration with drag and spin-up torque of the rotors, of spins times `sign`.

    Each has a factor that cannot be negative: fast motion shows spin-up, slow motion drag.  The lag is that of roll and
    pitch: spin-up at another one looks like drag.
    """
    arms, inertia = vehicle.torque_arms[:, :2], vehicle.initial[2:4]
    tilt = [np.sum((squares @ arms) * motion[:, :2] * inertia) for squares, motion, _ in lagged]
    squares, motion, spun = lagged[int(np.argmax(tilt))]
    causes = sign * np.column_stack([squares @ vehicle.torque_arms[:, 2], spun @ vehicle.spins])
    scale = np.linalg.norm(causes, axis=0) + 1e-300
    torque = causes / scale @ nnls(causes / scale, motion[:, 2])[0]
    norm = np.linalg.norm(torque) * np.linalg.norm(motion[:, 2])
    return float(torque @ motion[:, 2] / max(norm, 1e-300))


def _orders(rotors: int) -> list[tuple[int, ...]]:
    own = tuple(range(rotors))
    if rotors <= _MOST_ROTORS:
        return list(permutations(own))
    turns = [own[i:] + own[:i] for i in range(rotors)]
    return turns + [turn[::-1] for turn in turns]


def _correlations(lagged: Lagged, vehicle: Vehicle, orders: list[tuple[int, ...]]) -> FloatArray:
    """Correlation of torque and angular acceleration at each order's best lag, shape (orders, 3)."""
    arms = vehicle.torque_arms[np.argsort(orders, axis=1)]
    found = []
    for squares, motion, _ in lagged:
        torque = np.einsum("nr,ora->noa", squares, arms, optimize=True)
        norm = np.linalg.norm(torque, axis=0) * np.linalg.norm(motion, axis=0)
        found.append(np.einsum("noa,na->oa", torque, motion) / np.maximum(norm, 1e-300))
    at_lag = np.array(found)
    return np.asarray(at_lag[at_lag.mean(axis=2).argmax(axis=0), np.arange(len(orders))])
