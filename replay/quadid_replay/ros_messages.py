"""ROS 2 messages: topics, numbers of each type, and the signals in them."""

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from mcap.exceptions import McapError

from quadid.errors import LogError, nearest
from quadid.types import BoolArray, FloatArray, IndexArray, IntArray
from quadid_replay.columns import LogClock, cross, flip_attitude, flip_body, flip_world, from_euler, to_euler
from quadid_replay.mcap_file import Message, Topic
from quadid_replay.motors import RPM, motor_columns

# --- Fast reading of messages whose numbers stand in the same places each time
#
# The library (`mcap_ros2`) decodes the first message of a topic; where its runs of doubles stand is found by looking
# for them in the bytes.  As long as nothing else in the message but stamp and numbers changes, later messages are read
# at those places, many at once; any other message goes the library's way.  No layout is assumed that the library did
# not show.


_LITTLE_ENDIAN = b"\x00\x01"
_STAMP_AT, _AFTER_STAMP = 4, 12


class Read(NamedTuple):
    """Contents of n messages: stamps [ns], zero for none, shape (n,); runs of numbers, shapes (n, size); and what else
    was noted of all of them."""

    ns: IntArray
    blocks: list[FloatArray]
    extra: Any


class MessageReader:
    """Reads the messages of one topic.

    Args:
        decode: the library's decoder: bytes to message.
    """

    def __init__(self, kind: "MessageType", decode: Callable[[bytes], Any]) -> None:
        self._kind, self._decode = kind, decode
        self._layout: np.dtype[np.void] | None = None
        self._same: list[tuple[int, int, bytes]] = []
        self._noted: Any = None

    def read(self, messages: Sequence[bytes]) -> Read | None:
        """Reads messages; None for several that are not alike, or not as the layout last learnt: then halves are to be.

        Raises:
            Exception: a single message that cannot be decoded: what the library raises, of `UNDECODABLE`.
        """
        if self._layout is not None and {*map(len, messages)} == {self._layout.itemsize}:
            data = b"".join(messages)
            rows = np.frombuffer(data, dtype=np.uint8).reshape(len(messages), -1)
            if all(rows[:, begin:end].tobytes() == same * len(messages) for begin, end, same in self._same):
                read = np.frombuffer(data, dtype=self._layout)
                ns = read["seconds"].astype(np.int64) * 10**9 + read["nanoseconds"]
                blocks = [read[f"block {k}"].astype(np.float64) for k in range(len(self._same) - 1)]
                return Read(ns, blocks, self._noted)
        if len(messages) > 1 and self._layout is not None:
            return None
        try:
            decoded = [self._decode(data) for data in messages]
            each = [[run(m) for run in self._kind.runs] for m in decoded]
            extras = [self._kind.extra(m) for m in decoded]
            ns = np.array([(self._kind.stamp or _header_stamp)(m) for m in decoded], dtype=np.int64)
        except Exception:
            if len(messages) > 1:
                return None
            raise
        if any(e != extras[0] for e in extras) or len({tuple(map(len, runs)) for runs in each}) > 1:
            return None
        if self._kind.stamp is None:
            self._learn(messages[-1], each[-1], extras[0])
        return Read(ns, [np.array(run, dtype=np.float64) for run in zip(*each, strict=True)], extras[0])

    def _learn(self, data: bytes, runs: Sequence[Sequence[float]], extra: Any) -> None:
        self._layout = None
        if data[:2] != _LITTLE_ENDIAN:
            return
        places: list[tuple[str, Any, int]] = []
        same: list[tuple[int, int, bytes]] = []
        begin = _AFTER_STAMP
        for run in runs:
            packed = struct.pack(f"<{len(run)}d", *run)
            at = data.find(packed, begin)
            if at < 0:
                return
            places.append((f"block {len(places)}", ("<f8", (len(run),)), at))
            same.append((begin, at, data[begin:at]))
            begin = at + len(packed)
        self._same, self._noted = [*same, (begin, len(data), data[begin:])], extra
        fields = [("seconds", "<i4", _STAMP_AT), ("nanoseconds", "<u4", _STAMP_AT + 4), *places]
        names, formats, offsets = zip(*fields, strict=True)
        self._layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": len(data)})


def _header_stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


# --- Contents of each ROS 2 message type: runs of numbers, the signals in them, and how those become the core's


Signals = list[tuple[str, FloatArray, Any]]
"""Names, values (n, size), and whether the messages hold the signal: of each a mask (n,), or of all one truth."""
_LAST_NUMBER = re.compile(r"(\d{1,9})\D*$", re.ASCII)
UNDECODABLE = (
    McapError,
    struct.error,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    RecursionError,
    OverflowError,
)
"""Errors that the library and the types' functions raise on damaged data."""


@dataclass(frozen=True)
class MessageType:
    """Reader of one type.

    Attributes:
        runs: each of a run of doubles of a decoded message, in the order in which they stand.
        signals: the signals of n messages, of their runs (n, size) and what `extra` noted.
        extra: what else to note of a message (constant while nothing but numbers changes).
        stamp: nanoseconds, for types without a header, which have no layout to be learnt.
    """

    runs: tuple[Callable[[Any], Sequence[float]], ...]
    signals: Callable[[list[FloatArray], Any], Signals]
    extra: Callable[[Any], Any] = lambda message: None
    stamp: Callable[[Any], int] | None = None


def _runs(*names: str, some: bool = False) -> Callable[[list[FloatArray], Any], Signals]:
    """Signals that are whole runs; where a type may hold `some` of them only, an empty one is absent."""
    return lambda runs, extra: [(n, run, run.shape[1] > 0 or not some) for n, run in zip(names, runs, strict=True)]


def _run(*paths: str) -> tuple[Callable[[Any], list[float]]]:
    """One run: the numbers in fields of these names, arrays whole; ``.xyzw`` stands for four fields."""
    fields: list[str] = []
    for stem, dot, axes in (path.rpartition(".") for path in paths):
        fields += [f"{stem}.{axis}" for axis in axes] if axes in ("xyz", "xyzw") else [stem + dot + axes]
    getters = [attrgetter(field) for field in fields]

    def numbers(message: Any) -> list[float]:
        out: list[float] = []
        for value in (get(message) for get in getters):
            if hasattr(value, "__len__"):
                out.extend(value)  # not +=, which adds an array of ROS' own messages to the numbers themselves
            else:
                out.append(value)
        return out

    return (numbers,)


def _wxyz(q: FloatArray) -> FloatArray:
    return q[:, [3, 0, 1, 2]]


def _imu_signals(runs: list[FloatArray], extra: Any) -> Signals:
    """REP-145: a covariance that begins with -1 marks the quantity as absent."""
    (v,) = runs
    return [
        ("body_rate", v[:, 13:16], v[:, 16] != -1.0),
        ("body_force", v[:, 25:28], v[:, 28] != -1.0),
        ("attitude", _wxyz(v[:, :4]), v[:, 4] != -1.0),
    ]


def _odometry_signals(runs: list[FloatArray], in_world: Any) -> Signals:
    (v,) = runs
    q, velocity = _wxyz(v[:, 3:7]), v[:, 43:46]
    if not in_world:
        velocity = np.hstack([q, velocity])
    return [
        ("pose_attitude", q, True),
        ("position", v[:, :3], ~np.isnan(v[:, 0])),  # NaN: it tells no position; likewise
        ("velocity" if in_world else "body_velocity", velocity, ~np.isnan(v[:, 43])),
    ]


def _joint_order(m: Any) -> tuple[int, ...] | None:
    """Places of the joints in the order of the numbers that end their names (`rotor_1` ...); None where names say none.

    A publisher may list joints in any order (joint_state_publisher sorts them as words: 1, 10, 2).
    """
    ends = [_LAST_NUMBER.search(name) for name in m.name]
    numbers = [int(end[1]) for end in ends if end]
    if len(numbers) < len(ends) or len({*numbers}) < len(numbers) or numbers == sorted(numbers):
        return None
    return tuple(sorted(range(len(numbers)), key=numbers.__getitem__))


def _joint_signals(runs: list[FloatArray], order: Any) -> Signals:
    ordered = [run[:, order] if order and run.shape[1] else run for run in runs]
    return _runs("rotor_speed", "motor_command", some=True)(ordered, None)


def _px4_stamp(m: Any) -> int:
    return int(getattr(m, "timestamp_sample", 0) or m.timestamp) * 1000


def _px4(name: str, runs: tuple[Callable[[Any], Sequence[float]], ...], published: bool = False) -> MessageType:
    stamp = (lambda m: int(m.timestamp) * 1000) if published else _px4_stamp
    return MessageType(runs, _runs(name), stamp=stamp)


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
    return MessageType((lambda m: [abs(e.rpm) * RPM for e in getattr(m, name)],), _runs("rotor_speed"))


def _actuators(speed: str) -> MessageType:
    """mav_msgs (RotorS: angular_velocities) and actuator_msgs (Gazebo: velocity), both with `normalized`."""
    return MessageType(_run(speed) + _run("normalized"), _runs("rotor_speed", "motor_command", some=True))


def _set_if(valid: bool, values: list[float]) -> list[float]:
    return values if valid else [float("nan")] * len(values)


_IMU = (
    *("orientation.xyzw", "orientation_covariance"),
    *("angular_velocity.xyz", "angular_velocity_covariance"),
    *("linear_acceleration.xyz", "linear_acceleration_covariance"),
)
_ODOMETRY = (
    *("pose.pose.position.xyz", "pose.pose.orientation.xyzw", "pose.covariance"),
    *("twist.twist.linear.xyz", "twist.twist.angular.xyz", "twist.covariance"),
)
TYPES: dict[str, MessageType] = {
    "sensor_msgs/Imu": MessageType(_run(*_IMU), _imu_signals),
    "geometry_msgs/QuaternionStamped": MessageType(
        _run("quaternion.xyzw"), lambda runs, extra: [("attitude", _wxyz(runs[0]), True)]
    ),
    "sensor_msgs/JointState": MessageType(_run("velocity") + _run("effort"), _joint_signals, _joint_order),
    "nav_msgs/Odometry": MessageType(
        _run(*_ODOMETRY), _odometry_signals, lambda m: m.child_frame_id == m.header.frame_id
    ),
    "geometry_msgs/PoseStamped": MessageType(
        _run("pose.position.xyz", "pose.orientation.xyzw"),
        lambda runs, extra: [("position", runs[0][:, :3], True), ("pose_attitude", _wxyz(runs[0][:, 3:]), True)],
    ),
    "geometry_msgs/TwistStamped": MessageType(
        _run("twist.linear.xyz", "twist.angular.xyz"), lambda runs, extra: [("velocity", runs[0][:, :3], True)]
    ),
    "sensor_msgs/BatteryState": MessageType(_run("voltage"), _runs("battery")),
    "quadid_msgs/AttitudeCommand": MessageType(_run("roll", "pitch", "yaw", "throttle"), _runs("euler_reference")),
    "quadid_msgs/MotorCommand": MessageType(_run("values"), _runs("motor_command")),
    "mavros_msgs/RCOut": MessageType(_run("channels"), _runs("outputs")),
    "mavros_msgs/ESCStatus": _escs("esc_status"),
    "mavros_msgs/ESCTelemetry": _escs("esc_telemetry"),
    "mavros_msgs/AttitudeTarget": MessageType(
        _run("orientation.w", "orientation.xyz", "thrust"), _runs("quaternion_reference")
    ),
    "mav_msgs/Actuators": _actuators("angular_velocities"),
    "actuator_msgs/Actuators": _actuators("velocity"),
    "px4_msgs/SensorCombined": MessageType(
        _run("gyro_rad") + _run("accelerometer_m_s2"),
        _runs("gyro", "accel"),
        stamp=lambda m: int(m.timestamp - 0.5 * m.gyro_integral_dt) * 1000,  # a mean counts at its middle
    ),
    "px4_msgs/VehicleAttitude": _px4("frd_attitude", _run("q")),
    "px4_msgs/VehicleAttitudeSetpoint": _px4("frd_reference", (lambda m: [*m.q_d, -m.thrust_body[2]],), True),
    "px4_msgs/VehicleLocalPosition": MessageType(
        (lambda m: _set_if(m.xy_valid, [m.x, m.y, m.z]), lambda m: _set_if(m.v_xy_valid, [m.vx, m.vy, m.vz])),
        _runs("ned_position", "ned_velocity"),
        stamp=_px4_stamp,
    ),
    "px4_msgs/BatteryStatus": _px4("battery", _run("voltage_v"), True),
    "px4_msgs/ActuatorMotors": _px4("actuator_motors", _run("control"), True),
    "px4_msgs/ActuatorOutputs": _px4("outputs", _run("output"), True),
    "px4_msgs/EscStatus": _px4("rotor_speed", (_px4_speeds,), True),
    "px4_msgs/VehicleStatus": _px4("vehicle_kind", _run("system_type"), True),
}
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
    "vehicle_kind": ("vehicle_kind", _as_is),
    "frd_reference": ("attitude_reference", lambda c: np.column_stack([to_euler(c[:, :4]), c[:, 4]])),
}
"""Signals: the channel each belongs to, and what turns its columns into core units and frames; the MAV_TYPE of a
vehicle, which is no channel, tells whether its outputs are rotors."""


def type_name(schema: str) -> str:
    """Returns ``package/Type`` of ``package/msg/Type``."""
    return schema.replace("/msg/", "/")


# --- From the messages of a log to columns of numbers
#
# Messages are taken in batches.  Those of a topic that keeps its layout are read at once; where it changes within a
# batch, each half is read by itself, down to a single message, which the library decodes and the layout is learnt from.


BATCH, BATCH_BYTES = 8192, 8 << 20
"""Messages in a batch at most, and bytes of their payloads at which it ends."""
_EPOCH_NS = 10**17
"""Log times above this [ns, 1973] count from the UNIX epoch; recording time then counts from the log's first second."""
_OTHER_CLOCK = 3600.0
"""Stamps this far [s] from the log time belong to another clock (boot or simulation time)."""
_LARGEST_NS = 1 << 62


def _recording_times(clock: LogClock, headed: BoolArray, stamps: IntArray, logged: IntArray) -> tuple[FloatArray, int]:
    """Recording times [s] of n messages in file order, NaN for those refused, and the UNIX time [s] they count from.

    Args:
        headed: whether the stamp stands in a header; the others are PX4's, of a clock of their own, shape (n,).
        stamps: [ns], shape (n,); log time stands in for zero.
        logged: log times [ns], shape (n,).
    """
    epoch = int(logged[0]) // 10**9 if len(logged) and logged[0] > _EPOCH_NS else 0
    since, times = (logged - epoch * 10**9) * 1e-9, (stamps - epoch * 10**9) * 1e-9
    for group in (headed, ~headed):
        its = np.flatnonzero(group & (stamps != 0))
        if len(its):
            # Boot or simulation time beside a log on UNIX time: of those at its beginning the first message that is no
            # exception tells the distance.
            apart = (since[its] - times[its])[:BATCH]
            ahead = float(apart[np.abs(apart - np.sort(apart)[len(apart) // 2]) < _OTHER_CLOCK][0])
            times[its] += ahead if abs(ahead) > _OTHER_CLOCK else 0.0
    return clock.times(np.where(stamps == 0, since, times)), epoch


class TopicSource(NamedTuple):
    """A topic that is read: its description, its type, and what reads its messages."""

    topic: Topic
    kind: MessageType
    reader: MessageReader


class Decoded(NamedTuple):
    """Times (n,), NaN where refused, and values (n, size) by topic and signal; the clock, the UNIX time [s] from which
    times count (0: none), and how many messages could not be decoded."""

    columns: dict[tuple[int, str], tuple[FloatArray, FloatArray]]
    clock: LogClock
    epoch: int
    failed: int


def decode_messages(messages: Iterable[Message], sources: Mapping[int, TopicSource]) -> Decoded:
    """Streams through messages and keeps their numbers.

    Args:
        messages: of the topics in `sources`, in file order.
        sources: what reads them, by channel id.
    """
    # Numbers of each topic, batch by batch: which messages of the log, and their values; of each message its times.
    found: dict[tuple[int, str], list[tuple[IndexArray, FloatArray]]] = {}
    stamped: list[tuple[IndexArray, IntArray, IntArray, BoolArray]] = []
    count = failed = 0
    for batch in _batches(messages):
        rows_of: dict[int, list[int]] = {}
        for row, (number, _, _) in enumerate(batch):
            rows_of.setdefault(number, []).append(row)
        logged = np.array([max(min(t, _LARGEST_NS), -_LARGEST_NS) for _, t, _ in batch], dtype=np.int64)
        failed += len(batch)
        for number, rows in rows_of.items():
            kind = sources[number].kind
            for some, read in _read(sources[number].reader, np.array(rows), [batch[row][2] for row in rows]):
                failed -= len(some)
                stamped.append((count + some, read.ns, logged[some], np.full(len(some), kind.stamp is None)))
                for name, values, known in kind.signals(read.blocks, read.extra):
                    here = slice(None) if np.all(known) else np.broadcast_to(known, len(some))
                    kept = found.setdefault((number, name), [])
                    if values.shape[1] == 0 or (kept and kept[0][1].shape[1] != values.shape[1]):
                        failed += len(some[here])
                    elif len(some[here]):
                        kept.append((count + some[here], values[here].copy()))  # of the batch only what is kept
        count += len(batch)

    # Stamps of all topics, in file order, on one clock.
    clock, epoch, times = LogClock(), 0, np.full(count, np.nan)
    if stamped:
        places, stamps, logged, headed = (np.concatenate(column) for column in zip(*stamped, strict=True))
        order = np.argsort(places)
        times[places[order]], epoch = _recording_times(clock, headed[order], stamps[order], logged[order])
    columns = {}
    for key, kept in sorted(((k, v) for k, v in found.items() if v), key=lambda item: item[1][0][0][0]):
        columns[key] = times[np.concatenate([rows for rows, _ in kept])], np.concatenate([v for _, v in kept])
    return Decoded(columns, clock, epoch, failed)


def _batches(messages: Iterable[Message]) -> Iterator[list[Message]]:
    batch: list[Message] = []
    size = 0
    for message in messages:
        batch.append(message)
        size += len(message[2])
        if len(batch) >= BATCH or size >= BATCH_BYTES:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def _read(reader: MessageReader, rows: IndexArray, data: list[bytes]) -> Iterator[tuple[IndexArray, Read]]:
    """Reads messages of a topic, the `rows` of a batch; those that cannot be decoded do not come back."""
    try:
        read = reader.read(data)
    except UNDECODABLE:
        return
    if read is not None:
        yield rows, read
        return
    half = len(data) // 2
    yield from _read(reader, rows[:half], data[:half])
    yield from _read(reader, rows[half:], data[half:])


# --- Topics of the stacks that quadid reads from, with their types and the channels that they feed
#
# Names are relative: they match a topic that ends with them, so that a namespace before makes no difference.


TOPICS: dict[str, dict[str, tuple[str, str]]] = {
    "canonical": {
        "attitude": ("geometry_msgs/QuaternionStamped", "attitude"),
        "imu": ("sensor_msgs/Imu", "gyro accel attitude"),
        "rotor_speeds": ("sensor_msgs/JointState", "rotor_speed"),
        "motor_command": ("quadid_msgs/MotorCommand", "motor_command"),
        "command": ("quadid_msgs/AttitudeCommand", "attitude_reference"),
        "odom": ("nav_msgs/Odometry", "velocity position"),
        "battery": ("sensor_msgs/BatteryState", "battery"),
    },
    "mavros": {
        "imu/data_raw": ("sensor_msgs/Imu", "gyro accel"),
        "imu/data": ("sensor_msgs/Imu", "gyro accel attitude"),
        "esc_status/status": ("mavros_msgs/ESCStatus", "rotor_speed"),
        "esc_telemetry/telemetry": ("mavros_msgs/ESCTelemetry", "rotor_speed"),
        "rc/out": ("mavros_msgs/RCOut", "motor_command"),
        "setpoint_raw/target_attitude": ("mavros_msgs/AttitudeTarget", "attitude_reference"),
        "local_position/pose": ("", "attitude position"),
        "local_position/odom": ("nav_msgs/Odometry", "velocity position"),
        "local_position/velocity_local": ("", "velocity"),
        "battery": ("sensor_msgs/BatteryState", "battery"),
    },
    "px4": {
        "fmu/out/sensor_combined": ("px4_msgs/SensorCombined", "gyro accel"),
        "fmu/out/vehicle_attitude": ("px4_msgs/VehicleAttitude", "attitude"),
        "fmu/out/esc_status": ("px4_msgs/EscStatus", "rotor_speed"),
        "fmu/out/actuator_motors": ("px4_msgs/ActuatorMotors", "motor_command"),
        "fmu/out/actuator_outputs": ("", "motor_command"),
        "fmu/out/vehicle_attitude_setpoint": ("px4_msgs/VehicleAttitudeSetpoint", "attitude_reference"),
        "fmu/out/vehicle_local_position": ("px4_msgs/VehicleLocalPosition", "velocity position"),
        "fmu/out/vehicle_odometry": ("", "attitude velocity position"),
        "fmu/out/battery_status": ("px4_msgs/BatteryStatus", "battery"),
        "fmu/out/vehicle_status": ("px4_msgs/VehicleStatus", "vehicle_kind"),
    },
    "ardupilot": {
        "ap/imu/experimental/data": ("sensor_msgs/Imu", "gyro accel attitude"),
        "ap/pose/filtered": ("geometry_msgs/PoseStamped", "attitude position"),
        "ap/twist/filtered": ("", "velocity"),
        "ap/battery": ("sensor_msgs/BatteryState", "battery"),
    },
    "rotors": {
        "imu": ("sensor_msgs/Imu", "gyro accel attitude"),
        "imu/data_raw": ("", "gyro accel"),
        "motor_speed": ("actuator_msgs/Actuators", "rotor_speed"),
        "gazebo/command/motor_speed": ("", "motor_command"),
        "rotors": ("", "rotor_speed motor_command"),
        "odometry_sensor1/odometry": ("nav_msgs/Odometry", "attitude velocity position"),
        "ground_truth/odometry": ("", "attitude velocity position"),
    },
}
"""By preset and topic: the type for live subscription, empty where it is read from logs only, and channels.

Of several topics with one channel the first is the best.
"""


def sources(preset: str, channel: str) -> tuple[str, ...]:
    """Topics of a preset with a channel, the best first."""
    return tuple(topic for topic, (_, channels) in TOPICS[preset].items() if channel in channels.split())


AUTO = "auto"


@lru_cache(maxsize=1024)
def preset_rank(preset: str, channel: str, topic: str) -> int | None:
    """Returns the place of a topic in a preset's list for a channel; None when it is not in it.

    With ``auto`` every topic is in the list; those that any preset names come before others, raw ones first.

    Raises:
        LogError: unknown preset.
    """
    if preset == AUTO:
        known = [preset_rank(name, channel, topic) for name in TOPICS]
        ranks = [rank for rank in known if rank is not None]
        return (0 if "raw" in topic.rsplit("/", 1)[-1] else 1) + (min(ranks) if ranks else 10)
    if preset not in TOPICS:
        raise LogError(f"unknown preset '{preset}'", f"{AUTO}, {', '.join(TOPICS)}", nearest(preset, TOPICS))
    # A topic ends with the name, whole path elements only; PX4 may append its message version (_v1).
    stem, _, version = topic.rpartition("_v")
    ends = [f"/{topic}", *([f"/{stem}"] if stem and version.isdecimal() else [])]
    names = enumerate(sources(preset, channel))
    return next((rank for rank, name in names if any(end.endswith(f"/{name}") for end in ends)), None)
