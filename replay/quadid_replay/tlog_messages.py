"""What each MAVLink message tells: channel, values in core units and frames, and its own stamp.

MAVLink bodies are FRD and worlds NED, as the core's; only units differ (mG, mrad/s, rpm, mV, cm/s).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from quadid.types import FloatArray
from quadid_replay.clocks import WrapCounter
from quadid_replay.frames import GRAVITY, from_euler, to_euler
from quadid_replay.motors import ESCS, RPM

MILLI = 1e-3
SERVO_TURN = 2.0**32 * 1e-6
"""SERVO_OUTPUT_RAW counts microseconds in 32 bits: [s] until it starts over."""
ZERO_IS_BOOT = 1.0
"""A stamp of zero farther than this [s] from the newest one stands for unknown."""
_UNIX_US = 1e14
"""Stamps above this [us] count from the UNIX epoch."""
_NO_VOLTAGE = 65535
ESC_GROUPS = tuple(f"ESC_TELEMETRY_{k + 1}_TO_{k + 4}" for k in range(0, ESCS, 4))
"""ArduPilot's messages of four ESCs each."""


class Reading(NamedTuple):
    """Values of one signal, of one message or of many alike.

    Attributes:
        signal: channel name, or a name of the reader's own (``esc``, ``servo``, ``actuator``).
        values: a number a column, or an array of shape (n,); in core units.
        source: message name.
        place: first column, for signals that come in several messages.
        known: whether the message tells the signal.
    """

    signal: str
    values: Sequence[Any]
    source: str
    place: Any = 0
    known: Any = True


def _imu(m: Any, rate: float, force: float, name: str) -> list[Reading]:
    return [
        Reading("gyro", (m.xgyro * rate, m.ygyro * rate, m.zgyro * rate), name),
        Reading("accel", (m.xacc * force, m.yacc * force, m.zacc * force), name),
    ]


def _highres_imu(m: Any) -> list[Reading]:
    updated = (0x38, 0x07)  # bits of fields_updated: gyro, accel
    return [
        r._replace(known=(m.fields_updated & bits == bits) | (m.fields_updated == 0))
        for r, bits in zip(_imu(m, 1.0, 1.0, "HIGHRES_IMU"), updated, strict=True)
    ]


def _turned(turn: Callable[[FloatArray], FloatArray], columns: Sequence[Any]) -> tuple[Any, ...]:
    """Columns of what `turn` makes of rows."""
    rows = np.stack([np.asarray(c, dtype=np.float64) for c in columns], axis=-1)
    return tuple(turn(rows[None])[0]) if rows.ndim == 1 else tuple(turn(rows).T)


def _attitude(m: Any) -> list[Reading]:
    return [
        Reading("attitude", _turned(from_euler, (m.roll, m.pitch, m.yaw)), "ATTITUDE"),
        Reading("gyro", (m.rollspeed, m.pitchspeed, m.yawspeed), "ATTITUDE (filtered on board)"),
    ]


def _attitude_quaternion(m: Any) -> list[Reading]:
    return [
        Reading("attitude", (m.q1, m.q2, m.q3, m.q4), "ATTITUDE_QUATERNION"),
        Reading("gyro", (m.rollspeed, m.pitchspeed, m.yawspeed), "ATTITUDE_QUATERNION (filtered on board)"),
    ]


def _attitude_target(m: Any) -> list[Reading]:
    return [Reading("attitude_reference", (*_turned(to_euler, m.q), m.thrust), "ATTITUDE_TARGET")]


def _local_position(m: Any) -> list[Reading]:
    return [
        Reading("position", (m.x, m.y, m.z), "LOCAL_POSITION_NED"),
        Reading("velocity", (m.vx, m.vy, m.vz), "LOCAL_POSITION_NED"),
    ]


def _servo_output(m: Any) -> list[Reading]:
    outputs = [getattr(m, f"servo{i}_raw", 0) for i in range(1, 17)]
    return [Reading("servo", outputs, "SERVO_OUTPUT_RAW", 16 * m.port, known=m.port < 2)]


def _battery_status(m: Any) -> list[Reading]:
    millivolts = sum(v * ((v != 0) & (v != _NO_VOLTAGE)) for v in m.voltages)
    known = (m.id == 0) & (millivolts > 0)
    return [Reading("battery", (millivolts * MILLI,), "BATTERY_STATUS", known=known)]


def _system_status(m: Any) -> list[Reading]:
    known = (m.voltage_battery != 0) & (m.voltage_battery != _NO_VOLTAGE)
    return [Reading("battery", (m.voltage_battery * MILLI,), "SYS_STATUS", known=known)]


def _escs(m: Any, place: Any, name: str) -> list[Reading]:
    return [Reading("esc", [abs(rpm) * RPM for rpm in m.rpm], name, place)]


READERS: dict[str, Callable[[Any], list[Reading]]] = {
    "HIGHRES_IMU": _highres_imu,
    "SCALED_IMU": lambda m: _imu(m, MILLI, MILLI * GRAVITY, "SCALED_IMU (mG, mrad/s)"),
    "RAW_IMU": lambda m: _imu(m, MILLI, MILLI * GRAVITY, "RAW_IMU (ArduPilot: mG, mrad/s)"),
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "ATTITUDE_TARGET": _attitude_target,
    "LOCAL_POSITION_NED": _local_position,
    "GLOBAL_POSITION_INT": lambda m: [
        Reading("velocity", (m.vx * 0.01, m.vy * 0.01, m.vz * 0.01), "GLOBAL_POSITION_INT")
    ],
    "SERVO_OUTPUT_RAW": _servo_output,
    "ACTUATOR_OUTPUT_STATUS": lambda m: [Reading("actuator", list(m.actuator), "ACTUATOR_OUTPUT_STATUS")],
    "ESC_STATUS": lambda m: _escs(m, m.index, "ESC_STATUS"),
    **{name: partial(_escs, place=4 * k, name="ESC_TELEMETRY") for k, name in enumerate(ESC_GROUPS)},
    "BATTERY_STATUS": _battery_status,
    "SYS_STATUS": _system_status,
}
"""Messages with measurements, each with the function that reads one, or many whose fields are arrays."""

STATE_MESSAGES = ("HEARTBEAT", "PARAM_VALUE", "SYSTEM_TIME", "ESC_INFO")
"""Messages about the vehicle and its clock."""

PREFERENCE: dict[str, tuple[str, ...]] = {
    "gyro": ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU", "ATTITUDE_QUATERNION", "ATTITUDE"),
    "accel": ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU"),
    "attitude": ("ATTITUDE_QUATERNION", "ATTITUDE"),
    "attitude_reference": ("ATTITUDE_TARGET",),
    "velocity": ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"),
    "position": ("LOCAL_POSITION_NED",),
    "battery": ("BATTERY_STATUS", "SYS_STATUS"),
}
"""Which message a channel is taken from; a later one only when it comes twice as fast."""


def boot_seconds(m: Any) -> Any:
    """Returns the messages' own stamps [s] since boot, NaN where they have none or count UNIX time."""
    stamp = getattr(m, "time_boot_ms", None)
    if stamp is not None:
        return stamp * MILLI
    stamp = getattr(m, "time_usec", None)
    return math.nan if stamp is None else np.where(stamp > _UNIX_US, math.nan, stamp * 1e-6)


def unix_seconds(m: Any) -> Any:
    """Returns the messages' own stamps as UNIX time [s], NaN where they do not count that."""
    stamp = getattr(m, "time_usec", None)
    return math.nan if stamp is None else np.where(stamp > _UNIX_US, stamp * 1e-6, math.nan)


def boot_stamp(raw: float, servo: bool, newest: float | None) -> float | None:
    """Returns a message's own stamp [s] since boot, with whole turns of a 32-bit counter added; None without one.

    Args:
        raw: what `boot_seconds` says.
        servo: it is SERVO_OUTPUT_RAW, whose counter has 32 bits.
        newest: newest stamp known of this vehicle [s].
    """
    if raw != raw:
        return None
    if newest is None or (raw != 0.0 and not servo):
        return raw
    boot = WrapCounter(SERVO_TURN).unwrap_near(raw, newest) if servo else raw
    return None if raw == 0.0 and abs(boot - newest) > ZERO_IS_BOOT else boot
