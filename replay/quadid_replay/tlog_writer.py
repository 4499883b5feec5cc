"""Writes a recording as MAVLink 2 messages: a telemetry log, or one by one for a live link.

HIGHRES_IMU and ESC_STATUS carry microseconds and single precision, ATTITUDE_QUATERNION, LOCAL_POSITION_NED and
ATTITUDE_TARGET milliseconds, ESC_STATUS whole rpm, SERVO_OUTPUT_RAW whole microseconds: the format's resolution.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from quadid.errors import LogError
from quadid.types import FloatArray
from quadid.window import Channel, Recording
from quadid_replay.esc_messages import extend_dialect
from quadid_replay.frames import from_euler
from quadid_replay.motors import RPM
from quadid_replay.writing import Source, in_time_order, open_for_writing, recording_of, union_rows

dialect = extend_dialect(ardupilotmega)
SYSTEM, COMPONENT = 1, 1
_UNIX_START_US = 1_600_000_000_000_000  # receive time at recording time 0
_TYPES = {3: 15, 4: 2, 6: 13, 8: 14, 10: 35, 12: 29}  # rotors to MAV_TYPE
_GENERIC_AUTOPILOT, _ACTIVE = 0, 4
_LONGEST_MS = 2**32
_GYRO_BITS, _ACCEL_BITS = 0x38, 0x07
_Series = tuple[FloatArray, Callable[[int], list[Any]]]


def write_tlog(file: str | Path | BinaryIO, source: Source) -> None:
    """Writes a recording or windows to a telemetry log.

    Args:
        file: path or binary stream.
        source: what to write.

    Raises:
        LogError: nothing to write, times that boot clocks cannot tell, or a file that cannot be written.
    """
    recording = recording_of(source)
    mav = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    stream = open_for_writing(file) if isinstance(file, str | Path) else file
    try:
        for t, message in mavlink_messages(recording):
            frame = message.pack(mav)
            mav.seq = (mav.seq + 1) % 256
            stream.write(struct.pack(">Q", _UNIX_START_US + round(t * 1e6)) + frame)
    finally:
        if stream is not file:
            stream.close()


def mavlink_messages(recording: Recording) -> Iterator[tuple[float, Any]]:
    """Yields (time [s], message) of a recording in time order, with a HEARTBEAT and ESC_INFO every second.

    Raises:
        LogError: times below 0 or beyond what 32 bits of milliseconds hold, or nothing to write.
    """
    channels = recording.channels
    if not channels:
        raise LogError(f"{recording.name}: no channel to write", "at least one")
    first, last = min(c.t[0] for c in channels.values()), max(c.t[-1] for c in channels.values())
    if first < 0.0 or last * 1e3 >= _LONGEST_MS:
        raise LogError(f"times from {first:.3f} to {last:.3f} s", "0 to 49 days, as boot clocks count")
    motors = channels.get("rotor_speed") or channels.get("motor_command")
    rotors = motors.values.shape[1] if motors is not None else 4
    series = [
        _heartbeats(float(first), float(last), rotors, channels.get("rotor_speed") is not None),
        *_imu(channels.get("gyro"), channels.get("accel")),
        *_attitude(channels.get("attitude")),
        *_escs(channels.get("rotor_speed")),
        *_outputs(channels.get("motor_command")),
        *_reference(channels.get("attitude_reference")),
        *_local_position(channels.get("position"), channels.get("velocity")),
        *_battery(channels.get("battery")),
    ]
    for which, row in in_time_order([t for t, _ in series]):
        t, messages = series[which]
        for message in messages(row):
            yield float(t[row]), message


def _ms(t: float) -> int:
    return round(float(t) * 1e3)


def _us(t: float) -> int:
    return round(float(t) * 1e6)


def _heartbeats(first: float, last: float, rotors: int, escs: bool) -> _Series:
    t = np.arange(first, last + 1.0, 1.0)
    kind = _TYPES.get(rotors, 2)

    def messages(row: int) -> list[Any]:
        out = [dialect.MAVLink_heartbeat_message(kind, _GENERIC_AUTOPILOT, 0, 0, _ACTIVE, 3)]
        if escs:
            zeros = [0, 0, 0, 0]
            for index in range(0, rotors, 4):
                out.append(dialect.MAVLink_esc_info_message(index, _us(t[row]), 0, rotors, 0, 0, zeros, zeros, zeros))
        return out

    return t, messages


def _imu(gyro: Channel | None, accel: Channel | None) -> list[_Series]:
    t, (rate, force) = union_rows([gyro, accel])
    if len(t) == 0:
        return []

    def messages(row: int) -> list[Any]:
        updated, fields = 0, [0.0] * 6
        for values, place, bits in ((force, 0, _ACCEL_BITS), (rate, 3, _GYRO_BITS)):
            if values is not None and np.isfinite(values[row]).all():
                updated |= bits
                fields[place : place + 3] = values[row].tolist()
        rest = [0.0] * 7
        return [dialect.MAVLink_highres_imu_message(_us(t[row]), *fields, *rest, updated)]

    return [(t, messages)]


def _attitude(attitude: Channel | None) -> list[_Series]:
    if attitude is None:
        return []
    return [
        (attitude.t, lambda row: [_quaternion_message(_ms(attitude.t[row]), attitude.values[row].tolist())])
    ]  # fmt: skip


def _quaternion_message(ms: int, q: list[float]) -> Any:
    return dialect.MAVLink_attitude_quaternion_message(ms, *q, 0.0, 0.0, 0.0)


def _escs(speed: Channel | None) -> list[_Series]:
    if speed is None:
        return []
    width = speed.values.shape[1]

    def messages(row: int) -> list[Any]:
        rpm = [round(w / RPM) for w in speed.values[row].tolist()] + [0] * (-width % 4)
        zeros = [0.0, 0.0, 0.0, 0.0]
        return [
            dialect.MAVLink_esc_status_message(i, _us(speed.t[row]), rpm[i : i + 4], zeros, zeros)
            for i in range(0, width, 4)
        ]

    return [(speed.t, messages)]


def _outputs(command: Channel | None) -> list[_Series]:
    """Pulse widths as SERVO_OUTPUT_RAW, normalized commands as ACTUATOR_OUTPUT_STATUS."""
    if command is None:
        return []
    width = command.values.shape[1]
    pwm = bool(np.nanmedian(np.abs(command.values)) > 100.0)

    def messages(row: int) -> list[Any]:
        values = command.values[row].tolist()
        if pwm:
            pulses = [round(v) for v in values] + [0] * (16 - width)
            return [dialect.MAVLink_servo_output_raw_message(_us(command.t[row]) % 2**32, 0, *pulses)]
        padded = values + [0.0] * (32 - width)
        return [dialect.MAVLink_actuator_output_status_message(_us(command.t[row]), width, padded)]

    return [(command.t, messages)]


def _reference(reference: Channel | None) -> list[_Series]:
    if reference is None:
        return []
    q = from_euler(reference.values[:, :3])

    def messages(row: int) -> list[Any]:
        throttle = float(reference.values[row, 3])
        return [
            dialect.MAVLink_attitude_target_message(_ms(reference.t[row]), 0, q[row].tolist(), 0.0, 0.0, 0.0, throttle)
        ]

    return [(reference.t, messages)]


def _local_position(position: Channel | None, velocity: Channel | None) -> list[_Series]:
    """One LOCAL_POSITION_NED a time; NaN stands for what was not measured there."""
    t, (place, speed) = union_rows([position, velocity])
    if len(t) == 0:
        return []
    nan = [float("nan")] * 3

    def messages(row: int) -> list[Any]:
        xyz = nan if place is None else place[row].tolist()
        v = nan if speed is None else speed[row].tolist()
        return [dialect.MAVLink_local_position_ned_message(_ms(t[row]), *xyz, *v)]

    return [(t, messages)]


def _battery(battery: Channel | None) -> list[_Series]:
    """The whole pack's voltage as if of one cell [mV]."""
    if battery is None:
        return []

    def messages(row: int) -> list[Any]:
        cells = [min(round(float(battery.values[row, 0]) * 1e3), 65534)] + [65535] * 9
        return [dialect.MAVLink_battery_status_message(0, 0, 0, 32767, cells, -1, -1, -1, -1)]

    return [(battery.t, messages)]
