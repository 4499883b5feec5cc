"""Rotor speeds of a recording: their channel, and the meaning of its numbers, readings or commands."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from quadid.data.window import Channel, Recording, Sampling, measured_period, sample_period
from quadid.errors import LogError, NotIdentifiableError
from quadid.types import FloatArray

if TYPE_CHECKING:  # readers of logs do without pydantic
    from quadid.vehicle import Vehicle

_COUNTS = (100.0, 255.0, 1000.0, 2047.0, 65535.0)
"""Full commands that programs count to."""
SLOWEST_RATE = 6.0
"""Below this rate [Hz] a rotor signal does not show what happened between its samples; it is refused."""
INERTIA_RATE = 30.0
"""Rotor signal and gyro below this rate [Hz] reveal no inertia, lag or delay: the rate loop acts faster."""
_HOW_TO_GET_MOTORS = (
    "log rotor speeds or motor outputs at 50 Hz or more: PX4 SDLOG_PROFILE high rate (actuator_motors, esc_status); "
    "ArduPilot LOG_BITMASK with RCOUT and FAST_ATTITUDE; ROS a rotor_speeds or motor_command topic; "
    "live, references suffice where the vehicle file holds the gains of the stabiliser"
)


class RotorSignal(NamedTuple):
    """Rotor speeds of a log: times [s], values (n, rotors) [rad/s], meaning in time, source, notes."""

    t: FloatArray
    values: FloatArray
    sampling: Sampling
    source: str
    notes: tuple[str, ...] = ()


def rotor_signal(recording: Recording, vehicle: Vehicle) -> RotorSignal:
    """Picks measured or commanded rotor speeds where there are any, else motor commands, and converts to rad/s.

    Measured speeds of a vehicle whose file describes a command (normalized, pwm) are readings, so ``instant``.  They
    are passed over when all are zero, when the file describes pulse widths and the log has them, and when they come
    at less than half the rate of the commands.

    Raises:
        NotIdentifiableError: slower than `SLOWEST_RATE`.
        LogError: neither channel; number or unit of the columns does not fit the vehicle.
    """
    channel, notes = rotor_channel(recording, vehicle)
    described = vehicle.command.kind != "rotor_speed"
    if channel is None:
        raise LogError(
            "; ".join((f"{recording.name}: no rotor speeds and no motor commands", *notes, *recording.warnings)),
            "either of them",
            _HOW_TO_GET_MOTORS,
        )
    source = channel.source or channel.name
    if channel.name == "rotor_speed":
        # Rotors that carry a vehicle turn at tens of rad/s at least; commands from 0 to 1 do not, nor signed speeds
        top = float(np.quantile(channel.values, 0.99))
        backwards = [str(k + 1) for k, middle in enumerate(np.median(channel.values, axis=0)) if middle < 0.0]
        if backwards:
            raise LogError(
                f"{recording.name}: rotor speeds below zero ({channel.source}, rotor {', '.join(backwards)})",
                "speeds without a sign",
                "write their sizes; which way a rotor turns is its `spin` in the vehicle file",
            )
        if 0.0 < top <= 1.5:
            raise LogError(
                f"{recording.name}: rotor speeds up to {top:.3g} ({channel.source}) are commands from 0 to 1, no rad/s",
                "rad/s",
                "name the columns u1 … uN, with command: {kind: normalized, max_speed: <rad/s>} in the vehicle file",
            )
        measured = described and recording.format != "csv"
        signal = RotorSignal(channel.t, channel.values, "instant" if measured else vehicle.command.sampling, source)
    else:
        if not described:
            raise _needs_command_kind(recording, channel, vehicle, notes)
        _check_unit(recording, channel, vehicle)
        values = vehicle.command.to_rotor_speed(channel.values)
        signal = RotorSignal(channel.t, values, vehicle.command.sampling, source, notes)
    found, wanted = signal.values.shape[1], len(vehicle.rotors)
    if found != wanted:
        raise LogError(
            f"{recording.name}: {found} rotor columns ({signal.source})",
            f"{wanted}, the rotors of '{vehicle.name}'",
            "choose the vehicle file that belongs to this log",
        )
    rate = 1.0 / measured_period(signal.t, signal.values)
    if rate < SLOWEST_RATE:
        raise NotIdentifiableError(
            f"{recording.name}: rotor signal ({signal.source}) at {rate:.2g} Hz is too slow",
            f"{SLOWEST_RATE:g} Hz or more, 50 Hz for inertias",
            _HOW_TO_GET_MOTORS,
        )
    return signal


def rotor_channel(recording: Recording, vehicle: Vehicle | None) -> tuple[Channel | None, tuple[str, ...]]:
    """Picks the channel that drives the rotors, as `rotor_signal` declares; None where there is none.

    Mixer inputs go through the vehicle's mixer where neither speeds nor commands of rotors are logged.

    Returns:
        ``rotor_speed`` or ``motor_command`` as logged, and why measured speeds were passed over, if they were.
    """
    speed, command, mixed = (_usable(recording, name) for name in ("rotor_speed", "motor_command", "mixer_input"))
    if command is None and mixed is not None and vehicle is not None:
        # Motor commands of logged mixer inputs, as the vehicle file's mixer makes them.
        if vehicle.mixer is None:
            raise LogError(
                f"{recording.name}: holds mixer inputs ({mixed.source}), but '{vehicle.name}' has no mixer",
                "a vehicle file with `mixer:`",
                "add it, for example mixer: crazyflie",
            )
        matrix = vehicle.mixing
        if mixed.values.shape[1] != matrix.shape[1]:
            raise LogError(
                f"{recording.name}: {mixed.values.shape[1]} mixer inputs ({mixed.source})",
                f"{matrix.shape[1]}, the columns of the mixer of '{vehicle.name}'",
                "correct `mixer:`",
            )
        command = Channel("motor_command", mixed.t, mixed.values @ matrix.T, f"{mixed.source}, mixed")
    why = "" if speed is None else _passed_over(speed, command, vehicle)
    if speed is not None and why:
        return command, (f"measured speeds ({speed.source}) {why}",)
    return speed or command, ()


def _passed_over(speed: Channel, command: Channel | None, vehicle: Vehicle | None) -> str:
    """Reason why measured speeds are not used; empty where they are."""
    if not np.any(speed.values):
        return "are all zero: the motors are off, or the ESCs do not report"
    if command is None or vehicle is None or vehicle.command.kind == "rotor_speed":
        return ""
    if vehicle.command.kind == "pwm" and _looks_like_pwm(command):
        return f"are not what '{vehicle.name}' describes; its pulse widths ({command.source}) used"
    period = sample_period(speed.t)
    if period > 2.0 * sample_period(command.t) or period > 1.0 / SLOWEST_RATE:
        return f"are too slow; motor commands ({command.source}) used"
    return ""


def _usable(recording: Recording, name: str) -> Channel | None:
    channel = recording.channels.get(name)
    return channel if channel is not None and len(channel.t) and channel.t[-1] > channel.t[0] else None


def _needs_command_kind(
    recording: Recording, command: Channel, vehicle: Vehicle, passed_over: tuple[str, ...]
) -> LogError:
    """Commands are there, but the vehicle file describes none; speeds that all are zero may be those of a stand."""
    kind = "pwm" if _looks_like_pwm(command) else "normalized"
    if passed_over:
        return LogError(
            f"{recording.name}: {'; '.join(passed_over)}",
            f"rotor speeds above zero, as '{vehicle.name}' expects them",
            "fly; if the ESCs never report, "
            f"write command: {{kind: {kind}, max_speed: <rad/s at full command>}} in the vehicle file",
        )
    return LogError(
        f"{recording.name}: holds motor commands ({command.source}) but '{vehicle.name}' expects rotor speeds",
        "a vehicle file whose `command` fits the log",
        f"write command: {{kind: {kind}, max_speed: <rad/s at full command>}} in the vehicle file",
    )


def _looks_like_pwm(command: Channel) -> bool:
    return bool(np.nanmedian(np.abs(command.values)) > 100.0)


def _check_unit(recording: Recording, command: Channel, vehicle: Vehicle) -> None:
    kind = vehicle.command.kind
    low, high = (float(end) for end in np.nanquantile(command.values, [0.01, 0.99]))
    whole = "motor_command" not in recording.channels or -0.02 <= low <= high <= 1.5  # a mixer's may exceed it
    if _looks_like_pwm(command) if kind == "pwm" else whole:
        return
    found = f"{recording.name}: motor commands from {low:.4g} to {high:.4g} ({command.source}) are"
    allowed = "0..1 for normalized, about 1000..2000 us for pwm"
    pulses = low > 500.0 and high < 2500.0
    if pulses or whole:
        fix = f"set command kind '{'pwm' if pulses else 'normalized'}' in '{vehicle.name}'"
        raise LogError(f"{found} not '{kind}'", allowed, fix)
    full = next((f"{count:g}" for count in _COUNTS if high <= count), "its value")
    fix = f"write shares of the full command: divide by {full}" if low > -0.1 * high else "write 0 for standing still"
    raise LogError(f"{found} neither shares of the full command nor pulses", allowed, fix)


def px4_allocation(place: FloatArray, axis: FloatArray, strength: FloatArray, drag: FloatArray) -> FloatArray:
    """PX4's matrix from torque and thrust setpoints (x, y, z each, FRD) to motors, shape (rotors, 6).

    The pseudo-inverse of what the rotors do, scaled (ControlAllocationPseudoInverse.cpp of its sources).

    Args:
        place: of the rotors [m], FRD, shape (rotors, 3).
        axis: of their thrusts, shape (rotors, 3), none zero.
        strength: thrusts at full command, shape (rotors,).
        drag: torque over thrust [m], positive for rotors of spin +1, shape (rotors,).
    """
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    mix = np.linalg.pinv((strength[:, None] * np.hstack([np.cross(place, axis) - drag[:, None] * axis, axis])).T)
    # Roll and pitch by the larger of their sizes, over the motors that have a part in the torque.
    taking_part = np.count_nonzero(np.abs(mix[:, :2]) > 1e-3, axis=0)
    mix[:, :2] /= np.sqrt(np.sum(mix[:, :2] ** 2, axis=0) / np.maximum(0.5 * taking_part, 1e-300)).max() or 1.0
    mix[:, 2] /= np.max(mix[:, 2]) or 1.0
    lifting = np.abs(mix[:, 5]) > np.finfo(np.float32).eps
    mix[:, 3:] /= np.mean(np.abs(mix[lifting, 5])) if lifting.any() else 1.0
    return np.asarray(mix)
