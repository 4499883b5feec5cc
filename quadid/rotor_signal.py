"""Which channel tells the rotor speeds, and what its numbers mean: readings, or commands as the vehicle file says."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadid.errors import LogError, NotIdentifiableError
from quadid.resample import sample_period
from quadid.vehicle import Vehicle
from quadid.window import Channel, Recording, Sampling

FloatArray = NDArray[np.float64]

SLOWEST_RATE = 6.0
"""Below this rate [Hz] a rotor signal says nothing about what happened between its samples; it is refused."""
_HOW_TO_GET_MOTORS = (
    "log rotor speeds or motor outputs at 50 Hz or more: PX4 SDLOG_PROFILE high rate (actuator_motors, esc_status); "
    "ArduPilot LOG_BITMASK with RCOUT and FAST_ATTITUDE; ROS a rotor_speeds or motor_command topic; "
    "live, references suffice where the vehicle file holds the gains of the stabiliser"
)


class RotorSignal(NamedTuple):
    """Rotor speeds as a log tells them: times [s], values (n, rotors) [rad/s], meaning in time, source, notes."""

    t: FloatArray
    values: FloatArray
    sampling: Sampling
    source: str
    notes: tuple[str, ...] = ()


def rotor_signal(recording: Recording, vehicle: Vehicle) -> RotorSignal:
    """Picks measured or commanded rotor speeds where there are any, else motor commands, and converts to rad/s.

    Measured speeds of a vehicle whose file describes a command (normalized, pwm) are readings, so ``instant``; they are
    passed over when they come at less than half the rate of the commands.

    Raises:
        NotIdentifiableError: slower than `SLOWEST_RATE`.
        LogError: neither channel; number or unit of the columns does not fit the vehicle.
    """
    speed, command = (_usable(recording, name) for name in ("rotor_speed", "motor_command"))
    described = vehicle.command.kind != "rotor_speed"
    if speed is None and command is None:
        raise LogError(
            f"{recording.name}: no rotor speeds and no motor commands", "either of them", fix=_HOW_TO_GET_MOTORS
        )
    notes: tuple[str, ...] = ()
    if speed is not None and command is not None and described:
        slow = sample_period(speed.t) > 2.0 * sample_period(command.t)
        if slow or sample_period(speed.t) > 1.0 / SLOWEST_RATE:
            notes = (f"measured speeds ({speed.source}) come too slowly; motor commands ({command.source}) used",)
            speed = None
    if speed is not None:
        measured = described and recording.format != "csv"
        signal = RotorSignal(
            speed.t, speed.values, "instant" if measured else vehicle.command.sampling, speed.source or "rotor_speed"
        )
    else:
        assert command is not None
        if not described:
            raise _needs_command_kind(recording, command, vehicle)
        _check_unit(recording, command, vehicle)
        values = vehicle.command.to_rotor_speed(command.values)
        signal = RotorSignal(command.t, values, vehicle.command.sampling, command.source or "motor_command", notes)
    _check_columns(recording, signal, vehicle)
    rate = 1.0 / sample_period(signal.t)
    if rate < SLOWEST_RATE:
        raise NotIdentifiableError(
            f"{recording.name}: rotor signal ({signal.source}) at {rate:.2g} Hz is too slow",
            f"{SLOWEST_RATE:g} Hz or more, 50 Hz for inertias", _HOW_TO_GET_MOTORS,
        )  # fmt: skip
    return signal


def _usable(recording: Recording, name: str) -> Channel | None:
    channel = recording.channels.get(name)
    return channel if channel is not None and len(channel.t) and channel.t[-1] > channel.t[0] else None


def _check_columns(recording: Recording, signal: RotorSignal, vehicle: Vehicle) -> None:
    found, wanted = signal.values.shape[1], len(vehicle.rotors)
    if found != wanted:
        raise LogError(
            f"{recording.name}: {found} rotor columns ({signal.source})", f"{wanted}, the rotors of '{vehicle.name}'",
            "choose the vehicle file that belongs to this log",
        )  # fmt: skip


def _needs_command_kind(recording: Recording, command: Channel, vehicle: Vehicle) -> LogError:
    kind = "pwm" if _looks_like_pwm(command) else "normalized"
    return LogError(
        f"{recording.name}: holds motor commands ({command.source}) but '{vehicle.name}' expects rotor speeds",
        "a vehicle file whose `command` fits the log",
        f"write command: {{kind: {kind}, max_speed: <rad/s at full command>}} in the vehicle file",
    )


def _looks_like_pwm(command: Channel) -> bool:
    return bool(np.nanmedian(np.abs(command.values)) > 100.0)


def _check_unit(recording: Recording, command: Channel, vehicle: Vehicle) -> None:
    kind = vehicle.command.kind
    pwm = _looks_like_pwm(command)
    if pwm == (kind == "pwm"):
        return
    low, high = float(np.nanmin(command.values)), float(np.nanmax(command.values))
    raise LogError(
        f"{recording.name}: motor commands from {low:.4g} to {high:.4g} ({command.source}) are not '{kind}'",
        "0..1 for normalized, about 1000..2000 us for pwm",
        f"set command kind '{'pwm' if pwm else 'normalized'}' in '{vehicle.name}'",
    )
