"""Writes a recording as the canonical MCAP: topics, types, frames and units of the contract (ENU, FLU, SI)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from quadid.errors import LogError
from quadid.resample import linear
from quadid.rotation import conjugate, rotated
from quadid.types import FloatArray
from quadid.window import Channel, Recording
from quadid_replay.frames import flip_attitude, flip_body, flip_world, from_euler, to_euler
from quadid_replay.topic_writer import TopicWriter
from quadid_replay.writing import Source, in_time_order, recording_of, union_rows

_Series = tuple[FloatArray, Callable[[int], tuple[str, str, bytes]]]
_ABSENT = -1.0
_STAMP = {"sec": 0, "nanosec": 0}
_MAP, _BODY = {"stamp": _STAMP, "frame_id": "map"}, {"stamp": _STAMP, "frame_id": "base_link"}


def write_mcap(file: str | Path | BinaryIO, source: Source, epoch_ns: int = 0) -> None:
    """Writes a recording or windows to MCAP.

    Args:
        file: path or binary stream.
        source: what to write.
        epoch_ns: added to recording time, so that stamps count from the UNIX epoch [ns].

    Raises:
        LogError: nothing to write, a file that cannot be written, or times before `epoch_ns` = 0.
    """
    recording = recording_of(source)
    with TopicWriter(file) as writer:
        write_recording(writer, recording, epoch_ns)


def write_recording(writer: TopicWriter, recording: Recording, epoch_ns: int = 0) -> None:
    """Writes all channels of a recording to an open writer, in time order; see `write_mcap`."""
    write_recordings(writer, {"": recording}, epoch_ns)


def write_recordings(writer: TopicWriter, recordings: Mapping[str, Recording], epoch_ns: int = 0) -> None:
    """Writes recordings to an open writer, in time order, each with its name before its topics; see `write_mcap`."""
    each = [(name, s) for name, recording in recordings.items() for s in _all_series(writer, recording, epoch_ns)]
    for which, row in in_time_order([t for _, (t, _) in each]):
        name, (t, message) = each[which]
        topic, kind, data = message(row)
        writer.write_cdr(f"{name}/{topic}" if name else topic, kind, data, _stamp(t[row], epoch_ns))


def _all_series(writer: TopicWriter, recording: Recording, epoch_ns: int) -> list[_Series]:
    channels = recording.channels
    first = min((float(c.t[0]) for c in channels.values()), default=0.0)
    if epoch_ns + round(first * 1e9) < 0:
        raise LogError(f"times begin at {first:.3f} s", "times from 0 s on", "give an epoch that makes stamps positive")
    return [
        *_imu(writer, channels.get("gyro"), channels.get("accel"), epoch_ns),
        *_attitude(writer, channels.get("attitude"), epoch_ns),
        *_rotor_speeds(writer, channels.get("rotor_speed"), epoch_ns),
        *_motor_command(writer, channels.get("motor_command"), epoch_ns),
        *_command(writer, channels.get("attitude_reference"), epoch_ns),
        *_odometry(writer, recording, epoch_ns),
        *_battery(writer, channels.get("battery"), epoch_ns),
    ]


def _stamp(t: float, epoch_ns: int) -> int:
    return epoch_ns + round(float(t) * 1e9)


def _blocks(
    writer: TopicWriter, topic: str, kind: str, t: FloatArray, rows: FloatArray, build: Callable[[Any], Any], epoch: int
) -> _Series:
    """One run of doubles a message."""
    layout = writer.blocks(kind, build, [rows.shape[1]])
    return t, lambda row: (topic, kind, layout.write(_stamp(t[row], epoch), rows[row].tolist()))


def _imu(writer: TopicWriter, gyro: Channel | None, accel: Channel | None, epoch: int) -> list[_Series]:
    """One message a stamp; what was not measured there says so in its covariance (REP-145)."""
    t, (rate, force) = union_rows([gyro, accel])
    if len(t) == 0:
        return []
    rows = np.zeros((len(t), 37))
    rows[:, 3] = 1.0
    rows[:, 4] = _ABSENT  # no orientation
    for at, values in ((13, rate), (25, force)):
        measured = np.zeros(len(t), dtype=np.bool_) if values is None else np.isfinite(values).all(axis=1)
        rows[~measured, at + 3] = _ABSENT
        if values is not None:
            rows[measured, at : at + 3] = flip_body(values[measured])
    return [_blocks(writer, "imu", "sensor_msgs/msg/Imu", t, rows, _imu_message, epoch)]


def _imu_message(blocks: list[list[float]]) -> dict[str, Any]:
    (v,) = blocks
    return {
        "header": _BODY,
        "orientation": dict(zip("xyzw", v[:4], strict=True)),
        "orientation_covariance": v[4:13],
        "angular_velocity": _xyz(v[13:16]),
        "angular_velocity_covariance": v[16:25],
        "linear_acceleration": _xyz(v[25:28]),
        "linear_acceleration_covariance": v[28:37],
    }


def _xyz(v: list[float]) -> dict[str, float]:
    return dict(zip("xyz", v, strict=True))


def _attitude(writer: TopicWriter, attitude: Channel | None, epoch: int) -> list[_Series]:
    if attitude is None:
        return []
    rows = flip_attitude(attitude.values)[:, [1, 2, 3, 0]]
    return [
        _blocks(
            writer, "attitude", "geometry_msgs/msg/QuaternionStamped", attitude.t, rows,
            lambda b: {"header": _MAP, "quaternion": dict(zip("xyzw", b[0], strict=True))}, epoch,
        )
    ]  # fmt: skip


def _rotor_speeds(writer: TopicWriter, speed: Channel | None, epoch: int) -> list[_Series]:
    if speed is None:
        return []
    names = [f"rotor_{i + 1}" for i in range(speed.values.shape[1])]
    return [
        _blocks(
            writer, "rotor_speeds", "sensor_msgs/msg/JointState", speed.t, speed.values,
            lambda b: {"header": _BODY, "name": names, "position": [], "velocity": b[0], "effort": []}, epoch,
        )
    ]  # fmt: skip


def _motor_command(writer: TopicWriter, command: Channel | None, epoch: int) -> list[_Series]:
    if command is None:
        return []
    kind = 1 if np.nanmedian(np.abs(command.values)) > 100.0 else 0  # KIND_PWM, KIND_NORMALIZED
    return [
        _blocks(
            writer, "motor_command", "quadid_msgs/msg/MotorCommand", command.t, command.values,
            lambda b: {"header": _BODY, "kind": kind, "values": b[0]}, epoch,
        )
    ]  # fmt: skip


def _command(writer: TopicWriter, reference: Channel | None, epoch: int) -> list[_Series]:
    if reference is None:
        return []
    angles = to_euler(flip_attitude(from_euler(reference.values[:, :3])))
    rows = np.column_stack([angles, reference.values[:, 3]])
    return [
        _blocks(
            writer, "command", "quadid_msgs/msg/AttitudeCommand", reference.t, rows,
            lambda b: {"header": _MAP, **dict(zip(("roll", "pitch", "yaw", "throttle"), b[0], strict=True))}, epoch,
        )
    ]  # fmt: skip


def _odometry(writer: TopicWriter, recording: Recording, epoch: int) -> list[_Series]:
    """Pose in the world; twist in the body where there is an attitude, else in the world (child frame = frame)."""
    channels = recording.channels
    t, (position, velocity) = union_rows([channels.get("position"), channels.get("velocity")])
    attitude = channels.get("attitude")
    if len(t) == 0:
        return []
    rows = np.zeros((len(t), 85))
    rows[:, :3] = np.nan if position is None else flip_world(position)
    rows[:, 6] = 1.0
    world = np.full((len(t), 3), np.nan) if velocity is None else flip_world(velocity)
    if attitude is not None:
        q = linear(attitude.t, attitude.values, t)
        q = flip_attitude(q / np.linalg.norm(q, axis=1, keepdims=True))
        rows[:, 3:7] = q[:, [1, 2, 3, 0]]
        world = rotated(conjugate(q), world)
    rows[:, 43:46] = world
    child = "base_link" if attitude is not None else "map"
    return [
        _blocks(writer, "odom", "nav_msgs/msg/Odometry", t, rows, lambda b: _odometry_message(b, child), epoch)
    ]  # fmt: skip


def _odometry_message(blocks: list[list[float]], child: str) -> dict[str, Any]:
    (v,) = blocks
    orientation = dict(zip("xyzw", v[3:7], strict=True))
    return {
        "header": _MAP,
        "child_frame_id": child,
        "pose": {"pose": {"position": _xyz(v[:3]), "orientation": orientation}, "covariance": v[7:43]},
        "twist": {"twist": {"linear": _xyz(v[43:46]), "angular": _xyz(v[46:49])}, "covariance": v[49:85]},
    }


def _battery(writer: TopicWriter, battery: Channel | None, epoch: int) -> list[_Series]:
    if battery is None:
        return []
    encode = writer.encoder("sensor_msgs/msg/BatteryState")
    nan = float("nan")

    def message(row: int) -> tuple[str, str, bytes]:
        ns = _stamp(battery.t[row], epoch)
        fields = {
            "header": {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": "base_link"},
            "voltage": float(battery.values[row, 0]), "temperature": nan, "current": nan, "charge": nan,
            "capacity": nan, "design_capacity": nan, "percentage": nan, "present": True,
        }  # fmt: skip
        return "battery", "sensor_msgs/msg/BatteryState", encode(fields)

    return [(battery.t, message)]
