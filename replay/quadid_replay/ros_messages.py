"""ROS 2 messages: numbers of each type, and the signals in them."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from mcap.exceptions import McapError

from quadid.types import BoolArray, FloatArray, IndexArray, IntArray
from quadid_replay.columns import Columns, LogClock
from quadid_replay.frames import cross, flip_attitude, flip_body, flip_world, from_euler, to_euler
from quadid_replay.mcap_file import Message, Topic
from quadid_replay.motors import RPM, motor_columns

# --- Fast reading and writing of messages whose numbers stand in the same places each time
#
# The library (`mcap_ros2`) decodes or encodes the first message of a topic; where its runs of doubles stand is found
# by looking for them in the bytes.  As long as nothing else in the message but stamp and numbers changes, later
# messages are read and written at those places; any other message goes the library's way.  No layout is assumed that
# the library did not show.


Blocks = list[Sequence[float]]
_LITTLE_ENDIAN = b"\x00\x01"
_STAMP = struct.Struct("<iI")
_STAMP_AT, _AFTER_STAMP = 4, 12


class Read(NamedTuple):
    """A message: stamp of its header as seconds and nanoseconds, its runs of numbers, and what else was noted of it."""

    seconds: int
    nanoseconds: int
    blocks: Blocks
    extra: Any


class ReadMany(NamedTuple):
    """Messages: stamps (n,) as seconds and nanoseconds, runs of numbers (n, size), and what else was noted of all."""

    seconds: IntArray
    nanoseconds: IntArray
    blocks: list[FloatArray]
    extra: Any


class BlockReader:
    """Reads the messages of one topic.

    Args:
        decode: the library's decoder: bytes to message.
        blocks: runs of doubles of a decoded message, in the order in which they stand.
        extra: what else to note of a message (constant while nothing but numbers changes).
    """

    def __init__(
        self,
        decode: Callable[[bytes], Any],
        blocks: Callable[[Any], Blocks],
        extra: Callable[[Any], Any] = lambda message: None,
    ) -> None:
        self._decode, self._blocks, self._extra = decode, blocks, extra
        self._places: list[tuple[struct.Struct, int, int]] | None = None
        self._frame: list[tuple[int, int | None, bytes]] = []
        self._many: np.dtype[np.void] = np.dtype([])
        self._noted: Any = None
        self._size = 0

    def read(self, data: bytes) -> Read:
        """Reads one message; raises what the library raises on damaged data."""
        if self._places is not None and all(data[a:b] == same for a, b, same in self._frame):
            seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_AT)
            return Read(seconds, nanoseconds, [s.unpack_from(data, at) for s, at, _ in self._places], self._noted)
        message = self._decode(data)
        blocks = self._blocks(message)
        extra = self._extra(message)
        self._learn(data, blocks, extra)
        stamp = message.header.stamp
        return Read(stamp.sec, stamp.nanosec, blocks, extra)

    def read_many(self, messages: Sequence[bytes]) -> ReadMany | None:
        """Reads messages as `read` does one after the other; None when not all of them have the layout last learnt."""
        if self._places is None or {*map(len, messages)} != {self._size}:
            return None
        data = b"".join(messages)
        rows = np.frombuffer(data, dtype=np.uint8).reshape(len(messages), self._size)
        for begin, end, same in self._frame:
            if same and rows[:, begin:end].tobytes() != same * len(messages):
                return None
        read = np.frombuffer(data, dtype=self._many)
        blocks = [read[f"block {k}"].astype(np.float64) for k in range(len(self._places))]
        return ReadMany(
            read["seconds"].astype(np.int64), read["nanoseconds"].astype(np.int64), blocks, self._noted
        )  # fmt: skip

    def _learn(self, data: bytes, blocks: Blocks, extra: Any) -> None:
        self._places, self._frame = None, []
        if data[:2] != _LITTLE_ENDIAN:
            return
        places, begin = [], _AFTER_STAMP
        frame: list[tuple[int, int | None, bytes]] = []
        for block in blocks:
            packed = struct.pack(f"<{len(block)}d", *block)
            at = data.find(packed, begin)
            if at < 0:
                return
            places.append((struct.Struct(f"<{len(block)}d"), at, at + len(packed)))
            frame.append((begin, at, data[begin:at]))
            begin = at + len(packed)
        self._frame = [*frame, (begin, None, data[begin:])]
        self._places, self._noted, self._size = places, extra, len(data)
        self._many = np.dtype({
            "names": ["seconds", "nanoseconds", *(f"block {k}" for k in range(len(places)))],
            "formats": ["<i4", "<u4", *(("<f8", ((b - a) // 8,)) for _, a, b in places)],
            "offsets": [_STAMP_AT, _STAMP_AT + 4, *(a for _, a, _ in places)],
            "itemsize": len(data),
        })  # fmt: skip


class BlockWriter:
    """Writes messages of one topic that differ in stamp and numbers only.

    Args:
        encode: the library's encoder: message to bytes.
        build: makes a message of runs of doubles; its stamp does not matter.
        sizes: lengths of the runs.
    """

    def __init__(
        self, encode: Callable[[Any], bytes], build: Callable[[list[list[float]]], Any], sizes: Sequence[int]
    ) -> None:
        marks = [[1.0 + 0.001 * (100 * i + k) for k in range(n)] for i, n in enumerate(sizes)]
        self._bytes = bytearray(encode(build(marks)))
        self._places = []
        begin = _AFTER_STAMP
        for block in marks:
            packed = struct.pack(f"<{len(block)}d", *block)
            at = self._bytes.find(packed, begin)
            if at < 0:
                raise ValueError("the numbers do not stand together in this message")
            self._places.append((struct.Struct(f"<{len(block)}d"), at))
            begin = at + len(packed)

    def write(self, nanoseconds: int, *blocks: Sequence[float]) -> bytes:
        """Returns the message with this stamp [ns] and these numbers."""
        _STAMP.pack_into(self._bytes, _STAMP_AT, nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)
        for (layout, at), block in zip(self._places, blocks, strict=True):
            layout.pack_into(self._bytes, at, *block)
        return bytes(self._bytes)


# --- What each ROS 2 message type tells: runs of numbers, the signals in them, and how those become the core's


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


# --- Signals of many messages at once: which columns of their numbers are which signal
#
# The type's own `signals` says so of one message.  It holds for all that have runs of the same lengths, as long as the
# numbers that decide which signals a message tells say the same.


Places = tuple[str, list[tuple[int, int]]]
"""A signal, and where each of its numbers stands: run and place in it."""
UNDECODABLE = (
    McapError, struct.error, ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError,
)  # fmt: skip
"""What the library and the types' functions raise on damaged data."""


class _Number(float):
    """A number of a message that knows where it stands: run of numbers and place in it."""

    at: tuple[int, int]

    @classmethod
    def placed(cls, value: float, at: tuple[int, int]) -> _Number:
        """A number and where it stands."""
        number = cls(value)
        number.at = at
        return number


class SignalColumns:
    """The columns of one message type; what the type's `signals` says is asked once for each kind of message met."""

    def __init__(self, kind: MessageType) -> None:
        self._kind = kind
        self._known: dict[Hashable, list[Places] | None] = {}

    def pick(self, blocks: list[FloatArray], extra: Hashable) -> list[tuple[str, FloatArray]] | None:
        """Names and values (n, size) of the signals; None where the messages must be looked at one by one.

        Args:
            blocks: runs of numbers of n messages, shapes (n, length).
            extra: what was noted of all of them.
        """
        told = []
        for run, column in self._kind.deciding:
            values = blocks[run][:, column]
            if (values == values[0]).all():  # as nearly always
                told.append((bool(values[0] == -1.0), False))
                continue
            absent, unknown = values == -1.0, np.isnan(values)
            if (absent != absent[0]).any() or (unknown != unknown[0]).any():
                return None
            told.append((bool(absent[0]), bool(unknown[0])))
        met = (*(block.shape[1] for block in blocks), extra, *told)
        if met not in self._known:
            self._known[met] = self._places(blocks, extra)
        places = self._known[met]
        return None if places is None else [(name, _taken(blocks, at)) for name, at in places]

    def _places(self, blocks: list[FloatArray], extra: Hashable) -> list[Places] | None:
        """Where the first message's signals stand; None where they are not simply numbers of the message."""
        first: Blocks = [
            [_Number.placed(value, (run, column)) for column, value in enumerate(block[0])]
            for run, block in enumerate(blocks)
        ]
        try:
            told = self._kind.signals(first, extra)
        except UNDECODABLE:
            return None
        out: list[Places] = []
        for name, picked in told:
            at = [one.at for one in picked if isinstance(one, _Number)]
            if len(at) != len(picked):
                return None
            out.append((name, at))
        return out


def _taken(blocks: list[FloatArray], at: list[tuple[int, int]]) -> FloatArray:
    if len({run for run, _ in at}) == 1:
        return blocks[at[0][0]][:, [column for _, column in at]]
    columns = [blocks[run][:, column] for run, column in at]
    return np.stack(columns, axis=1) if columns else np.empty((len(blocks[0]), 0))


# --- From the messages of an MCAP to columns of numbers
#
# Messages are taken in batches.  Those of a topic that keeps its layout (`BlockReader`) are read at once,
# column by column; where it changes within a batch, each half is read by itself, down to a single message, which the
# library decodes and the layout is learnt from.


ColumnsOf = dict[tuple[int, str], Columns]

BATCH, BATCH_BYTES = 8192, 8 << 20
"""Messages in a batch at most, and bytes of their payloads at which it ends."""
_EPOCH_NS = 10**17
"""Log times above this [ns, 1973] count from the UNIX epoch; recording time then counts from the log's first second."""
_OTHER_CLOCK = 3600.0
"""Stamps this far [s] from the log time belong to another clock (boot or simulation time)."""
_LARGEST_BASE = 1 << 62


class Source(NamedTuple):
    """A topic that is read: its description, its type, the library's decoder, the reader of its layout if any, and
    which columns of many messages are which signal."""

    topic: Topic
    kind: MessageType
    decode: Callable[[bytes], Any]
    layout: BlockReader | None
    columns: SignalColumns

    def read(self, data: bytes) -> Read:
        """Reads one message; raises what the library raises on damaged data."""
        if self.layout is not None:
            return self.layout.read(data)
        message = self.decode(data)
        assert self.kind.stamp is not None
        return Read(*self.kind.stamp(message), self.kind.blocks(message), self.kind.extra(message))


def source_of(topic: Topic, kind: MessageType, decode: Callable[[bytes], Any]) -> Source:
    """The reader of a topic; messages without a header have no layout that could be learnt."""
    layout = BlockReader(decode, kind.blocks, kind.extra) if kind.stamp is None else None
    return Source(topic, kind, decode, layout, SignalColumns(kind))


class Stamps:
    """Turns stamps of headers and of PX4 into recording time."""

    def __init__(self) -> None:
        self.clock = LogClock()
        self.base_ns: int | None = None
        self._offsets: dict[str, float] = {}

    def time(self, group: str, seconds: int, nanoseconds: int, log_time: int) -> float | None:
        """Returns recording time of a stamp; log time stands in for a stamp of zero."""
        if self.base_ns is None:
            self.base_ns = log_time // 10**9 * 10**9 if log_time > _EPOCH_NS else 0
        logged = (log_time - self.base_ns) * 1e-9
        if seconds == 0 and nanoseconds == 0:
            return self.clock.time(logged)
        stamped = (seconds * 10**9 + nanoseconds - self.base_ns) * 1e-9
        offset = self._offsets.get(group)
        if offset is None:
            # Boot or simulation time beside a log on UNIX time: the first message tells the distance.
            offset = logged - stamped if abs(logged - stamped) > _OTHER_CLOCK else 0.0
            self._offsets[group] = offset
        return self.clock.time(stamped + offset)

    def times(self, groups: Sequence[str], stamps: IntArray, logged: Sequence[int]) -> FloatArray:
        """As `time` for many stamps (n, 2), seconds and nanoseconds, in file order; NaN for those refused."""
        plain = self._plain_times(groups, stamps)
        if plain is not None:
            return plain
        pairs = stamps.tolist()
        each = [self.time(g, s, ns, log) for g, (s, ns), log in zip(groups, pairs, logged, strict=True)]
        return np.array([np.nan if t is None else t for t in each], dtype=np.float64)

    def _plain_times(self, groups: Sequence[str], stamps: IntArray) -> FloatArray | None:
        """None, and nothing has changed, unless every stamp follows plainly on a clock that is known."""
        if self.base_ns is None or self.base_ns > _LARGEST_BASE or not np.all(np.any(stamps != 0, axis=1)):
            return None
        known = set(groups)
        if not known <= self._offsets.keys() or np.any(np.abs(stamps[:, 0]) > _LARGEST_BASE // 10**9):
            return None
        offset = np.array([self._offsets[g] for g in groups]) if len(known) > 1 else self._offsets[groups[0]]
        stamped = (stamps[:, 0] * 10**9 + stamps[:, 1] - self.base_ns) * 1e-9
        return self.clock.plain_times(np.asarray(stamped + offset, dtype=np.float64))


class Decoded(NamedTuple):
    """Columns by topic and signal, the clock, and how many messages could not be decoded."""

    columns: ColumnsOf
    stamps: Stamps
    failed: int


def decode_messages(messages: Iterable[Message], sources: Mapping[int, Source]) -> Decoded:
    """Streams through messages and keeps their numbers.

    Args:
        messages: of the topics in `sources`, in file order.
        sources: readers by channel id.
    """
    columns: ColumnsOf = {}
    stamps, failed = Stamps(), 0
    for batch in _batches(messages):
        failed += _add_batch(batch, sources, columns, stamps)
    return Decoded(columns, stamps, failed)


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


class _Part(NamedTuple):
    """Samples of one signal in a batch: which messages, and values (n, size)."""

    key: tuple[int, str]
    order: int
    rows: IndexArray
    values: FloatArray


def _add_batch(batch: list[Message], sources: Mapping[int, Source], columns: ColumnsOf, stamps: Stamps) -> int:
    """Adds the numbers of a batch to the columns; returns how many messages could not be decoded."""
    numbers = np.array([number for number, _, _ in batch])
    stamped, decoded = np.zeros((len(batch), 2), np.int64), np.ones(len(batch), np.bool_)
    parts: list[_Part] = []
    for number in dict.fromkeys(numbers.tolist()):
        source, rows = sources[number], np.flatnonzero(numbers == number)
        parts += _read(number, source, rows, [batch[row][2] for row in rows], stamped, decoded)
    groups = ["header" if sources[number].layout is not None else "px4" for number in numbers[decoded].tolist()]
    times = np.full(len(batch), np.nan)
    if groups:
        logged = [batch[row][1] for row in np.flatnonzero(decoded)]
        times[decoded] = stamps.times(groups, stamped[decoded], logged)
    failed = len(batch) - int(np.count_nonzero(decoded))
    for part in sorted(parts, key=lambda p: (p.rows[0], p.order)):
        kept = columns.get(part.key)
        if part.values.shape[1] == 0 or (kept is not None and kept.width != part.values.shape[1]):
            failed += len(part.rows)
            continue
        if kept is None:
            kept = columns[part.key] = Columns(part.values.shape[1])
        kept.add_many(times[part.rows], part.values)
    return failed


def _read(
    number: int, source: Source, rows: IndexArray, data: list[bytes], stamped: IntArray, decoded: BoolArray
) -> list[_Part]:
    """Reads messages of a topic, the `rows` of a batch; `decoded` becomes False where that is not possible."""
    read = source.layout.read_many(data) if source.layout is not None else None
    signals = None if read is None else source.columns.pick(read.blocks, read.extra)
    if read is not None and signals is not None:
        stamped[rows, 0], stamped[rows, 1] = read.seconds, read.nanoseconds
    elif len(rows) > 1:
        half = len(rows) // 2
        first = _read(number, source, rows[:half], data[:half], stamped, decoded)
        return first + _read(number, source, rows[half:], data[half:], stamped, decoded)
    else:
        try:
            message = source.read(data[0])
            told = source.kind.signals(message.blocks, message.extra)
            signals = [(name, np.array(values, dtype=np.float64)[None]) for name, values in told]
            stamped[rows] = message.seconds, message.nanoseconds
        except UNDECODABLE:
            decoded[rows] = False
            return []
    return [_Part((number, name), order, rows, values) for order, (name, values) in enumerate(signals)]
