"""Mass and rotor positions against what the flight shows, as far as physics reveals them.

Mass and thrust coefficient only ever show as their ratio, arm and inertia likewise.  So a wrong mass is seen when the
thrust coefficient is known (thrust stand, or a sigma of its own), a wrong arm when the inertias are known too; that the
whole frame is turned is seen always.
"""

from __future__ import annotations

import math

import numpy as np

from quadid.inspection.airborne import Spans, within
from quadid.inspection.findings import Check, CheckResult
from quadid.inspection.motor_checks import Lagged
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from quadid.window import Recording

_KNOWN = 0.1
"""Relative standard deviation up to which a parameter counts as known."""
_MASS_OFF, _ARM_OFF = 0.08, 0.2
"""Relative differences that are reported: of mass; of arm, whose effect slow motors weaken."""
_TURNED = math.radians(20.0)
_CLEAR = 0.1
"""Share of the variance of roll, and of pitch, that rotor torques must explain before geometry is judged by them."""


def mass_check(recording: Recording, vehicle: Vehicle, spans: Spans, b_from_hover: float | None) -> Check | None:
    """Weighs the vehicle by its known thrust coefficient; None where that is not known or nothing flew.

    Args:
        recording: the log.
        vehicle: with `thrust_stand`, or a sigma of b.
        spans: when it flew [s].
        b_from_hover: thrust coefficient that would carry the weight [N s^2/rad^2], of `hover_check`.
    """
    known = _known_thrust(vehicle)
    if known is None or b_from_hover is None or b_from_hover <= 0.0:
        return None
    b, sigma = known
    factor = b / b_from_hover / _load(recording, spans)
    mass = factor * vehicle.mass
    numbers = {"mass_factor": factor, "mass_kg": mass}
    message = (
        f"the known thrust coefficient {b:.3g} N s^2/rad^2 carries {mass:.3g} kg, {factor:.3f} times the stated mass"
    )
    if abs(factor - 1.0) <= max(_MASS_OFF, 3.0 * sigma):
        return Check("mass", CheckResult.OK, message, numbers=numbers)
    fix = f"weigh the vehicle: {mass:.3g} kg would fit; or check the thrust stand and the unit of the rotor speeds"
    return Check("mass", CheckResult.WARNING, message, fix, numbers)


def _known_thrust(vehicle: Vehicle) -> tuple[float, float] | None:
    """Thrust coefficient and its relative standard deviation, where it rests on more than a guess."""
    if vehicle.stand_thrust is not None:
        return vehicle.stand_thrust
    return _known(vehicle, "b")


def _known(vehicle: Vehicle, name: str) -> tuple[float, float] | None:
    prior = vehicle.parameters[name]
    if prior.sigma is None or prior.sigma > _KNOWN * prior.initial:
        return None
    return prior.initial, prior.sigma / prior.initial


def _load(recording: Recording, spans: Spans) -> float:
    """Mean thrust over weight in flight, by the accelerometer; 1 where that is implausible."""
    accel = recording.channels.get("accel")
    if accel is None:
        return 1.0
    inside = within(accel.t, spans)
    load = -float(np.mean(accel.values[inside, 2])) / GRAVITY if inside.any() else 1.0
    return load if 0.8 < load < 1.5 else 1.0


def geometry_check(lagged: Lagged | str, vehicle: Vehicle) -> Check:
    """Roll and pitch acceleration (of `lagged_motion`) against the torque that the stated rotor positions give.

    With A the least-squares map from torque over b to inertia times acceleration, A = k R(alpha): the frame is turned
    by alpha about z, and k is b times the factor by which arms (or inertias) are wrong.
    """
    name = "geometry"
    if isinstance(lagged, str):
        return Check(name, CheckResult.UNKNOWN, lagged)
    arms, inertia = vehicle.torque_arms[:, :2], vehicle.initial[2:4]
    fits = [_map(squares @ arms, motion[:, :2] * inertia) for squares, motion, _ in lagged]
    share, a = max(fits, key=lambda fit: float(np.min(fit[0])))
    if float(np.min(share)) < _CLEAR:
        axis = ("roll", "pitch")[int(np.argmin(share))]
        return Check(
            name, CheckResult.UNKNOWN,
            f"rotor torques explain only {np.min(share):.0%} of the {axis} motion: too little to judge positions",
        )  # fmt: skip
    angle = math.atan2(a[0, 1] - a[1, 0], a[0, 0] + a[1, 1])
    scale = 0.5 * math.hypot(a[0, 1] - a[1, 0], a[0, 0] + a[1, 1])
    numbers = {"turned_rad": angle, "explained": float(np.min(share))}
    if abs(angle) > _TURNED:
        degrees = math.degrees(angle)
        return Check(
            name, CheckResult.ERROR, f"the vehicle answers as if its rotors stood {degrees:+.0f} deg further about z",
            f"turn the rotor positions of the vehicle file by {degrees:+.0f} deg (x towards y)", numbers,
        )  # fmt: skip
    return _judge_scale(vehicle, scale, numbers)


def _map(torque: FloatArray, answer: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least-squares map (2, 2) from torque (n, 2) to answer (n, 2), and the share of variance it explains per axis."""
    a = np.asarray(np.linalg.lstsq(torque, answer, rcond=None)[0], dtype=np.float64)
    total = np.maximum(np.sum(answer**2, axis=0), 1e-300)
    return np.asarray(1.0 - np.sum((answer - torque @ a) ** 2, axis=0) / total), a


def _judge_scale(vehicle: Vehicle, scale: float, numbers: dict[str, float]) -> Check:
    thrust, inertias = _known_thrust(vehicle), [_known(vehicle, n) for n in ("J_xx", "J_yy")]
    turned = f"rotor positions agree with the motion within {abs(math.degrees(numbers['turned_rad'])):.0f} deg"
    if thrust is None or not all(inertias):
        return Check(
            "geometry", CheckResult.OK, f"{turned}; the arm itself shows only relative to the inertia", numbers=numbers
        )
    factor = scale / thrust[0]
    numbers = {**numbers, "arm_factor": factor}
    if abs(factor - 1.0) <= _ARM_OFF:
        return Check("geometry", CheckResult.OK, f"{turned}, the arm within {abs(factor - 1.0):.0%}", numbers=numbers)
    message = (
        f"roll and pitch answer {factor:.2f} times as strongly as the stated arm of {vehicle.arm:.3g} m lets expect"
    )
    fix = f"measure the arm: {factor * vehicle.arm:.3g} m, {factor:.2f} times it, would fit; or the inertias are wrong"
    return Check("geometry", CheckResult.WARNING, message, fix, numbers)
