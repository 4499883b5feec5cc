"""What each MAVLink message tells: channel, values in core units and frames, and its own stamp.

MAVLink bodies are FRD and worlds NED, as the core's; only units differ (mG, mrad/s, rpm, mV, cm/s).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadid_replay.clocks import WrapCounter
from quadid_replay.frames import GRAVITY, from_euler, to_euler
from quadid_replay.motors import RPM

MILLI = 1e-3
_SERVO_TURN = 2.0**32 * 1e-6
"""SERVO_OUTPUT_RAW counts microseconds in 32 bits: [s] until it starts over."""
_UNIX_US = 1e14
"""Stamps above this [us] count from the UNIX epoch."""


class Reading(NamedTuple):
    """Values of one signal.

    Attributes:
        signal: channel name, or a name of the reader's own (``esc``, ``servo``, ``actuator``).
        values: in core units.
        source: message name.
        place: first column, for signals that come in several messages.
    """

    signal: str
    values: Sequence[float]
    source: str
    place: int = 0


def _imu(m: Any, rate: float, force: float, name: str) -> list[Reading]:
    return [
        Reading("gyro", (m.xgyro * rate, m.ygyro * rate, m.zgyro * rate), name),
        Reading("accel", (m.xacc * force, m.yacc * force, m.zacc * force), name),
    ]


def _highres_imu(m: Any) -> list[Reading]:
    readings = _imu(m, 1.0, 1.0, "HIGHRES_IMU")
    updated = (0x38, 0x07)  # bits of fields_updated: gyro, accel
    return [
        r for r, bits in zip(readings, updated, strict=True) if m.fields_updated & bits == bits or not m.fields_updated
    ]


def _attitude(m: Any) -> list[Reading]:
    q = from_euler(np.array([[m.roll, m.pitch, m.yaw]]))[0]
    return [
        Reading("attitude", [float(v) for v in q], "ATTITUDE"),
        Reading("gyro", (m.rollspeed, m.pitchspeed, m.yawspeed), "ATTITUDE (filtered on board)"),
    ]


def _attitude_quaternion(m: Any) -> list[Reading]:
    return [
        Reading("attitude", (m.q1, m.q2, m.q3, m.q4), "ATTITUDE_QUATERNION"),
        Reading("gyro", (m.rollspeed, m.pitchspeed, m.yawspeed), "ATTITUDE_QUATERNION (filtered on board)"),
    ]


def _attitude_target(m: Any) -> list[Reading]:
    angles = to_euler(np.array([m.q], dtype=np.float64))[0]
    return [Reading("attitude_reference", (*(float(a) for a in angles), m.thrust), "ATTITUDE_TARGET")]


def _local_position(m: Any) -> list[Reading]:
    return [
        Reading("position", (m.x, m.y, m.z), "LOCAL_POSITION_NED"),
        Reading("velocity", (m.vx, m.vy, m.vz), "LOCAL_POSITION_NED"),
    ]


def _servo_output(m: Any) -> list[Reading]:
    if m.port:
        return []
    return [Reading("servo", [float(getattr(m, f"servo{i}_raw", 0)) for i in range(1, 17)], "SERVO_OUTPUT_RAW")]


def _battery_status(m: Any) -> list[Reading]:
    cells = [v for v in m.voltages if v not in (0, 65535)]
    return [Reading("battery", (sum(cells) * MILLI,), "BATTERY_STATUS")] if m.id == 0 and cells else []


def _system_status(m: Any) -> list[Reading]:
    if m.voltage_battery in (0, 65535):
        return []
    return [Reading("battery", (m.voltage_battery * MILLI,), "SYS_STATUS")]


def _escs(m: Any, place: int, name: str) -> list[Reading]:
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
    "ESC_TELEMETRY_1_TO_4": lambda m: _escs(m, 0, "ESC_TELEMETRY"),
    "ESC_TELEMETRY_5_TO_8": lambda m: _escs(m, 4, "ESC_TELEMETRY"),
    "BATTERY_STATUS": _battery_status,
    "SYS_STATUS": _system_status,
}
"""Messages with measurements, each with the function that reads it."""

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


def boot_seconds(m: Any) -> float | None:
    """Returns the message's own stamp [s] since boot, or None when it has none or counts UNIX time."""
    stamp = getattr(m, "time_boot_ms", None)
    if stamp is not None:
        return float(stamp) * MILLI
    stamp = getattr(m, "time_usec", None)
    if stamp is None or stamp > _UNIX_US:
        return None
    return float(stamp) * 1e-6


def boot_stamp(m: Any, newest: float | None) -> float | None:
    """Returns the message's own stamp [s] since boot, with whole turns of a 32-bit counter added; None without one.

    Args:
        m: a message.
        newest: newest stamp known of this vehicle [s].
    """
    boot = boot_seconds(m)
    if newest is None or boot is None:
        return boot
    raw = boot
    if m.get_type() == "SERVO_OUTPUT_RAW":
        boot = WrapCounter(_SERVO_TURN).unwrap_near(raw, newest)
    return None if raw == 0.0 and abs(boot - newest) > 1.0 else boot  # zero stands for unknown


def unix_seconds(m: Any) -> float | None:
    """Returns the message's own stamp as UNIX time [s], or None when it does not count that."""
    stamp = getattr(m, "time_usec", None)
    return float(stamp) * 1e-6 if stamp is not None and stamp > _UNIX_US else None
