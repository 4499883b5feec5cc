"""Rate controllers of autopilots: their parameters, their units, and what a unit of their output does to the motors.

    moment = sum_i arm_i (change of thrust i with its command) mix_i output

so that one controller written in SI has the same loop in each.  Facts and sources:

    PX4         torque = K (P e + I Int e - D d(rate)/dt), e in rad/s (rate_control.cpp); motors = scaled pseudo-inverse
                of CA_ROTOR* times torque (ControlAllocationPseudoInverse.cpp), sent to the ESCs as they are with
                THR_MDL_FAC 0; D on the rate behind IMU_GYRO_CUTOFF and IMU_DGYRO_CUTOFF.
    ArduPilot   output = P e + I Int e + D de/dt, e in rad/s, from a target behind a low-pass (AC_PID.cpp); thrust of
                motor i += factor_i output with factors of largest size 0.5 (AP_MotorsMatrix.cpp,
                normalise_rpy_factors); thrust to command by MOT_THST_EXPO between MOT_SPIN_MIN and MOT_SPIN_MAX
                (AP_Motors_Thrust_Linearization.cpp).
    Betaflight  sum = 0.032029 P e + 0.244381 I Int e - 0.000529 D d(rate)/dt, e in deg/s (pid.h); motor i +=
                mix_i sum / 1000 of the range above motor_idle (mixer.c); QUADX mixes +-1, QUADP +-1 and 0
                (mixer_init.c); angle_p_gain / 10 is the gain of Angle mode [1/s].
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from quadid.data.rotor_signal import px4_allocation
from quadid.errors import ParameterError
from quadid.model.layout import ThrustModel
from quadid.report.programs import SITL_FRAMES, Facts, sitl_frame
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY

AXES = ("roll", "pitch", "yaw")
Known = Mapping[str, float]
"""Parameters of an autopilot by name, as far as they are given."""


class Hover(NamedTuple):
    """Rotors about hover, by command 0..1 of full speed.

    Attributes:
        lever: change of the moment about each axis with the command of each rotor [N m], shape (rotors, 3).
        most: thrust of each rotor at full command [N], shape (rotors,).
    """

    command: float
    lever: FloatArray
    most: FloatArray


class Autopilot(NamedTuple):
    """Rate and attitude loops of an autopilot.

    Attributes:
        names: parameters of P, I, D of the rates and of the attitude gain, an axis each; empty for none.
        units: what one of each stands for: output per rad/s, rad, rad/s^2; and 1/s.
        digits: after the decimal point that it stores; None for any.
        gyro, derivative, rate: parameter and default of the gyro's filter [Hz], the derivative's [Hz], the loop [Hz].
        yaw_error: parameter and default of a filter of the error of the yaw rate [Hz].
        target: parameter and default of a filter of the rates asked for [Hz].
        on_error: the derivative acts on the error.
        outputs: command of each rotor for a unit of output about each axis, shape (rotors, 3).
    """

    program: str
    names: tuple[tuple[str, ...], ...]
    units: tuple[float, float, float, float]
    digits: int | None
    gyro: tuple[str, float]
    derivative: tuple[str, float]
    rate: tuple[str, float]
    yaw_error: tuple[str, float]
    target: tuple[str, float]
    on_error: bool
    outputs: Callable[[Facts, Known, Hover], FloatArray]


def hover(facts: Facts) -> Hover:
    """Rotors about hover; raises ParameterError where full command is not known."""
    full, command = facts.max_speed, facts.hover_command
    if full is None or command is None or facts.full_thrust is None:
        raise ParameterError(
            f"{facts.vehicle.name}: no command.max_speed",
            "the rotor speed at full command [rad/s]",
            "add it to the vehicle file: gains of an autopilot act on its motor command",
        )
    if not command < 1.0:
        raise ParameterError(f"{facts.vehicle.name} hovers at {command:.0%} of full command", "below 100 %")
    model, weight = ThrustModel.stated(facts.vehicle), facts.vehicle.mass * GRAVITY
    speed, most = model.hover_speed(weight), facts.full_thrust
    # The flight controller undoes the curve of its motors (kind thrust): thrust is linear in the command.
    turn = most / model.slope(weight) if facts.vehicle.command.kind == "thrust" else np.full(len(most), full)
    thrust, drag = model.slope(weight) * turn, 2.0 * facts.value("d") * speed * turn
    x, y, _ = facts.arms.T
    return Hover(command, np.column_stack([-y * thrust, x * thrust, facts.vehicle.spins * drag]), most)


def moments(at: Hover, outputs: FloatArray) -> FloatArray:
    """Moment about each axis of a unit of output about it [N m], shape (3,).

    Raises:
        ParameterError: an axis that the outputs do not turn, or turn the wrong way.
    """
    out = np.einsum("ra,ra->a", at.lever, outputs)
    if not np.all(out > 0.0):
        raise ParameterError(
            f"outputs turn the vehicle by {out} N m", "positive about each axis", "check rotors and spins"
        )
    return np.asarray(out)


def authority(at: Hover) -> FloatArray:
    """Largest moment from hover, up and down alike, at constant thrust [N m], shape (3,)."""
    return np.asarray(np.abs(at.lever).sum(axis=0) * min(at.command, 1.0 - at.command))


def _px4(facts: Facts, known: Known, at: Hover) -> FloatArray:
    """Allocation of what the CA_ROTOR* of `quadid export` say."""
    upwards = np.tile([0.0, 0.0, -1.0], (len(at.most), 1))
    mix = px4_allocation(facts.arms, upwards, at.most, facts.vehicle.spins * facts.torque_per_thrust)[:, :3]
    factor = known.get("THR_MDL_FAC", 0.0)
    bend = 1.0 if facts.vehicle.command.kind == "thrust" else 1.0 / ((1.0 - factor) + 2.0 * factor * at.command)
    return np.asarray(mix * bend * [known.get(f"MC_{a.upper()}RATE_K", 1.0) for a in AXES])


def _ardupilot(facts: Facts, known: Known, at: Hover) -> FloatArray:
    """Factors of the frame, through the curve from thrust to command."""
    frame, motors = sitl_frame(facts)
    if not frame:
        raise ParameterError(
            f"{facts.vehicle.name}: rotors in no known frame",
            f"as ArduPilot's {', '.join(SITL_FRAMES)}",
            "use another format",
        )
    angle = np.radians([a for a, _ in SITL_FRAMES[frame]])
    spin = np.array([float(s) for _, s in SITL_FRAMES[frame]])
    factors = np.column_stack([-np.sin(angle), np.cos(angle), spin])
    out = np.empty_like(factors)
    out[np.array(motors) - 1] = 0.5 * factors / np.abs(factors).max(axis=0)
    if facts.vehicle.command.kind == "thrust":
        return out
    low, high = known.get("MOT_SPIN_MIN", 0.15), known.get("MOT_SPIN_MAX", 0.95)
    expo = known.get("MOT_THST_EXPO", facts.thrust_expo or 1.0)
    command = (at.command - low) / (high - low)
    return np.asarray(out * (high - low) / ((1.0 - expo) + 2.0 * expo * command))


def _betaflight(facts: Facts, known: Known, at: Hover) -> FloatArray:
    """Mixer of a quad, above idle."""
    if len(facts.rotors) != 4:
        raise ParameterError(f"{facts.vehicle.name}: {len(facts.rotors)} rotors", "four", "use another format")
    x, y, _ = facts.vehicle.rotor_positions.T
    near = 1e-3 * facts.vehicle.arm
    sides = np.column_stack([np.where(np.abs(v) > near, np.sign(v), 0.0) for v in (-y, x, facts.vehicle.spins)])
    idle = known.get("motor_idle", known.get("dshot_idle_value", 550.0)) / 1e4
    return np.asarray(sides * (1.0 - idle))


_NONE = ("", math.inf)
_DEGREES = math.degrees(1.0) / 1000.0
AUTOPILOTS: dict[str, Autopilot] = {
    "px4": Autopilot(
        "PX4",
        tuple((*(f"MC_{axis}RATE_{term}" for term in "PID"), f"MC_{axis}_P") for axis in ("ROLL", "PITCH", "YAW")),
        (1.0, 1.0, 1.0, 1.0), None,
        ("IMU_GYRO_CUTOFF", 40.0), ("IMU_DGYRO_CUTOFF", 30.0), ("IMU_GYRO_RATEMAX", 400.0), _NONE, _NONE, False, _px4,
    ),
    "ardupilot": Autopilot(
        "ArduPilot",
        tuple((*(f"ATC_RAT_{axis}_{term}" for term in "PID"), f"ATC_ANG_{axis}_P") for axis in ("RLL", "PIT", "YAW")),
        (1.0, 1.0, 1.0, 1.0), None,
        ("INS_GYRO_FILTER", 20.0), ("ATC_RAT_RLL_FLTD", 20.0), ("SCHED_LOOP_RATE", 400.0),
        ("ATC_RAT_YAW_FLTE", 2.5), ("ATC_RAT_RLL_FLTT", 20.0), True, _ardupilot,
    ),
    "betaflight": Autopilot(
        "Betaflight",
        tuple((*(f"{term}_{axis}" for term in "pid"), "angle_p_gain" if axis != "yaw" else "") for axis in AXES),
        (0.032029 * _DEGREES, 0.244381 * _DEGREES, 0.000529 * _DEGREES, 0.1), 0,
        ("gyro_lpf1_static_hz", 250.0), ("dterm_lpf1_static_hz", 50.0), ("pid_rate", 4000.0), _NONE, _NONE,
        False, _betaflight,
    ),
}  # fmt: skip
"""Defaults are those of PX4 1.15, ArduCopter 4.5, Betaflight 4.5; there two filters in a row count as one: 50 Hz."""
