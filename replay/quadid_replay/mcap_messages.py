"""What each ROS 2 message type tells: runs of numbers, the signals in them, and how those become the core's."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadid.types import FloatArray
from quadid_replay.cdr_blocks import Blocks
from quadid_replay.frames import cross, flip_attitude, flip_body, flip_world, from_euler, to_euler
from quadid_replay.motors import RPM, motor_columns

Signals = list[tuple[str, Sequence[float]]]
_LAST_NUMBER = re.compile(r"(\d{1,9})\D*$", re.ASCII)


@dataclass(frozen=True)
class MessageType:
    """How to read one type.

    Attributes:
        blocks: runs of doubles of a decoded message.
        signals: names and values in those runs; the second argument is what `extra` noted.
        extra: what else to note of a message.
        stamp: seconds and nanoseconds, for types without a header.
        deciding: run and place of the numbers that decide, by being -1 or NaN, which signals a message has.
    """

    blocks: Callable[[Any], Blocks]
    signals: Callable[[Blocks, Any], Signals]
    extra: Callable[[Any], Any] = lambda message: None
    stamp: Callable[[Any], tuple[int, int]] | None = None
    deciding: tuple[tuple[int, int], ...] = ()


def _vector(v: Any) -> list[float]:
    return [v.x, v.y, v.z]


def _quaternion(q: Any) -> list[float]:
    return [q.x, q.y, q.z, q.w]


def _wxyz(q: Sequence[float]) -> tuple[float, ...]:
    return (q[3], q[0], q[1], q[2])


def _imu_block(m: Any) -> Blocks:
    return [
        [
            *_quaternion(m.orientation), *m.orientation_covariance,
            *_vector(m.angular_velocity), *m.angular_velocity_covariance,
            *_vector(m.linear_acceleration), *m.linear_acceleration_covariance,
        ]
    ]  # fmt: skip


def _imu_signals(blocks: Blocks, extra: Any) -> Signals:
    """REP-145: a covariance that begins with -1 says that the quantity is absent."""
    (v,) = blocks
    out: Signals = []
    if v[16] != -1.0:
        out.append(("body_rate", v[13:16]))
    if v[28] != -1.0:
        out.append(("body_force", v[25:28]))
    if v[4] != -1.0:
        out.append(("attitude", _wxyz(v[:4])))
    return out


def _pose(p: Any) -> list[float]:
    return [*_vector(p.position), *_quaternion(p.orientation)]


def _twist(t: Any) -> list[float]:
    return [*_vector(t.linear), *_vector(t.angular)]


def _odometry_block(m: Any) -> Blocks:
    return [[*_pose(m.pose.pose), *m.pose.covariance, *_twist(m.twist.twist), *m.twist.covariance]]


def _odometry_signals(blocks: Blocks, extra: Any) -> Signals:
    (v,) = blocks
    out: Signals = [("pose_attitude", _wxyz(v[3:7]))]
    if v[0] == v[0]:  # NaN: this message tells no position; likewise below
        out.append(("position", v[:3]))
    if v[43] != v[43]:
        return out
    if extra:
        out.append(("velocity", v[43:46]))
    else:
        out.append(("body_velocity", (*_wxyz(v[3:7]), *v[43:46])))
    return out


def _joint_order(m: Any) -> tuple[int, ...] | None:
    """Places of the joints in the order of the numbers that end their names (`rotor_1` ...); None where names say none.

    A publisher may list joints in any order (joint_state_publisher sorts them as words: 1, 10, 2).
    """
    ends = [_LAST_NUMBER.search(name) for name in m.name]
    numbers = [int(end[1]) for end in ends if end]
    if len(numbers) < len(ends) or len({*numbers}) < len(numbers) or numbers == sorted(numbers):
        return None
    return tuple(sorted(range(len(numbers)), key=numbers.__getitem__))


def _joint_signals(blocks: Blocks, extra: Any) -> Signals:
    named = zip(("rotor_speed", "motor_command"), blocks, strict=True)
    return [(name, [run[i] for i in extra] if extra else run) for name, run in named if len(run)]


def _microseconds(stamp: float) -> tuple[int, int]:
    return int(stamp) // 1_000_000, int(stamp) % 1_000_000 * 1000


def _px4_stamp(m: Any) -> tuple[int, int]:
    return _microseconds(getattr(m, "timestamp_sample", 0) or m.timestamp)


def _px4(name: str, values: Callable[[Any], Sequence[float]], published: bool = False) -> MessageType:
    stamp = (lambda m: _microseconds(m.timestamp)) if published else _px4_stamp
    return MessageType(lambda m: [values(m)], lambda blocks, extra: [(name, blocks[0])], stamp=stamp)


def _px4_speeds(m: Any) -> list[float]:
    """Speeds in the order of the motors, which each ESC names; in that of the ESCs where none does (older PX4).

    Raises:
        ValueError: some ESCs name a motor, and no order of all motors follows.
    """
    functions = [int(getattr(e, "actuator_function", 0)) for e in m.esc]
    columns = motor_columns(functions)
    if not columns and any(functions):
        raise ValueError(f"esc_status: actuator_function {functions} names no complete row of motors")
    return [abs(m.esc[k].esc_rpm) * RPM for k in columns or range(m.esc_count)]


def _escs(name: str) -> MessageType:
    return MessageType(
        lambda m: [[abs(e.rpm) * RPM for e in getattr(m, name)]], lambda blocks, extra: [("rotor_speed", blocks[0])]
    )


def _actuators(speed: str) -> MessageType:
    """mav_msgs (RotorS: angular_velocities) and actuator_msgs (Gazebo: velocity), both with `normalized`."""
    return MessageType(
        lambda m: [list(getattr(m, speed)), list(m.normalized)],
        lambda blocks, extra: [(n, b) for n, b in zip(("rotor_speed", "motor_command"), blocks, strict=True) if len(b)],
    )


def _set_if(valid: bool, values: list[float]) -> list[float]:
    return values if valid else [float("nan")] * len(values)


TYPES: dict[str, MessageType] = {
    "sensor_msgs/Imu": MessageType(_imu_block, _imu_signals, deciding=((0, 4), (0, 16), (0, 28))),
    "geometry_msgs/QuaternionStamped": MessageType(
        lambda m: [_quaternion(m.quaternion)], lambda b, extra: [("attitude", _wxyz(b[0]))]
    ),
    "sensor_msgs/JointState": MessageType(
        lambda m: [list(m.velocity), list(m.effort)], _joint_signals, _joint_order
    ),
    "nav_msgs/Odometry": MessageType(
        _odometry_block, _odometry_signals, extra=lambda m: m.child_frame_id == m.header.frame_id,
        deciding=((0, 0), (0, 43)),
    ),
    "geometry_msgs/PoseStamped": MessageType(
        lambda m: [_pose(m.pose)], lambda b, extra: [("position", b[0][:3]), ("pose_attitude", _wxyz(b[0][3:]))]
    ),
    "geometry_msgs/TwistStamped": MessageType(
        lambda m: [_twist(m.twist)], lambda b, extra: [("velocity", b[0][:3])]
    ),
    "sensor_msgs/BatteryState": MessageType(lambda m: [[m.voltage]], lambda b, extra: [("battery", b[0])]),
    "quadid_msgs/AttitudeCommand": MessageType(
        lambda m: [[m.roll, m.pitch, m.yaw, m.throttle]], lambda b, extra: [("euler_reference", b[0])]
    ),
    "quadid_msgs/MotorCommand": MessageType(lambda m: [list(m.values)], lambda b, extra: [("motor_command", b[0])]),
    "mavros_msgs/RCOut": MessageType(
        lambda m: [[float(c) for c in m.channels]], lambda b, extra: [("outputs", b[0])]
    ),
    "mavros_msgs/ESCStatus": _escs("esc_status"),
    "mavros_msgs/ESCTelemetry": _escs("esc_telemetry"),
    "mavros_msgs/AttitudeTarget": MessageType(
        lambda m: [[*_wxyz(_quaternion(m.orientation)), m.thrust]], lambda b, extra: [("quaternion_reference", b[0])]
    ),
    "mav_msgs/Actuators": _actuators("angular_velocities"),
    "actuator_msgs/Actuators": _actuators("velocity"),
    "px4_msgs/SensorCombined": MessageType(
        lambda m: [list(m.gyro_rad), list(m.accelerometer_m_s2)],
        lambda b, extra: [("gyro", b[0]), ("accel", b[1])],
        stamp=lambda m: _microseconds(m.timestamp - 0.5 * m.gyro_integral_dt),  # a mean counts at its middle
    ),
    "px4_msgs/VehicleAttitude": _px4("frd_attitude", lambda m: list(m.q)),
    "px4_msgs/VehicleAttitudeSetpoint": _px4("frd_reference", lambda m: [*m.q_d, -m.thrust_body[2]], True),
    "px4_msgs/VehicleLocalPosition": MessageType(
        lambda m: [_set_if(m.xy_valid, [m.x, m.y, m.z]), _set_if(m.v_xy_valid, [m.vx, m.vy, m.vz])],
        lambda b, extra: [("ned_position", b[0]), ("ned_velocity", b[1])],
        stamp=_px4_stamp,
    ),
    "px4_msgs/BatteryStatus": _px4("battery", lambda m: [m.voltage_v], True),
    "px4_msgs/ActuatorMotors": _px4("actuator_motors", lambda m: list(m.control), True),
    "px4_msgs/ActuatorOutputs": _px4("outputs", lambda m: list(m.output), True),
    "px4_msgs/EscStatus": _px4("rotor_speed", _px4_speeds, True),
}  # fmt: skip
"""Message types that are read, without the ``msg`` in the middle of their name."""


def _rotated_velocity(columns: FloatArray) -> FloatArray:
    """Turns attitude FLU->ENU (wxyz) and body velocity FLU, shape (n, 7), into world velocity NED, shape (n, 3)."""
    w, axis, v = columns[:, :1], columns[:, 1:4], columns[:, 4:]
    turned = v + 2.0 * cross(axis, cross(axis, v) + w * v)
    return flip_world(turned)


def _reference(columns: FloatArray) -> FloatArray:
    return np.column_stack([to_euler(flip_attitude(columns[:, :4])), columns[:, 4]])


def _euler_reference(columns: FloatArray) -> FloatArray:
    return np.column_stack([to_euler(flip_attitude(from_euler(columns[:, :3]))), columns[:, 3]])


def _as_is(columns: FloatArray) -> FloatArray:
    return columns


SIGNALS: dict[str, tuple[str, Callable[[FloatArray], FloatArray]]] = {
    "body_rate": ("gyro", flip_body),
    "body_force": ("accel", flip_body),
    "attitude": ("attitude", flip_attitude),
    "pose_attitude": ("attitude", flip_attitude),
    "position": ("position", flip_world),
    "velocity": ("velocity", flip_world),
    "body_velocity": ("velocity", _rotated_velocity),
    "rotor_speed": ("rotor_speed", _as_is),
    "motor_command": ("motor_command", _as_is),
    "outputs": ("motor_command", _as_is),
    "actuator_motors": ("motor_command", _as_is),
    "battery": ("battery", _as_is),
    "euler_reference": ("attitude_reference", _euler_reference),
    "quaternion_reference": ("attitude_reference", _reference),
    "gyro": ("gyro", _as_is),
    "accel": ("accel", _as_is),
    "frd_attitude": ("attitude", _as_is),
    "ned_position": ("position", _as_is),
    "ned_velocity": ("velocity", _as_is),
    "frd_reference": ("attitude_reference", lambda c: np.column_stack([to_euler(c[:, :4]), c[:, 4]])),
}
"""Signals: the channel each belongs to, and what turns its columns into core units and frames."""


def type_name(schema: str) -> str:
    """Returns ``package/Type`` of ``package/msg/Type``."""
    return schema.replace("/msg/", "/")
