"""Writers of recordings: MCAP, CSV, MAVLink telemetry."""

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache, partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import Any, BinaryIO, NamedTuple, TypeAlias

import numpy as np
import yaml
from mcap.writer import CompressionType, Writer
from mcap_ros2._dynamic import serialize_dynamic

from quadid.data.grid import linear
from quadid.data.window import Channel, Recording, Window, as_recording
from quadid.errors import LogError
from quadid.files import unwaited, written_whole
from quadid.rotation import conjugate, rotated
from quadid.types import FloatArray
from quadid_replay.columns import flip_attitude, flip_body, flip_world, from_euler, to_euler
from quadid_replay.csv_reader import EULER, GROUPS
from quadid_replay.mavlink_messages import extend_dialect
from quadid_replay.motors import MULTIROTORS, RPM
from quadid_replay.schemas import has_definition, schema_text

# --- What the writers share: recordings of windows, samples in time order, files that can be written


Source: TypeAlias = Recording | Window | Sequence[Window]
"""Sources that can be written: a recording, or windows of one log."""


def recording_of(source: Source) -> Recording:
    """The recording that a source is, or that its windows make; raises LogError as `as_recording`."""
    if isinstance(source, Recording):
        return source
    return as_recording([source] if isinstance(source, Window) else source)


def in_time_order(times: Sequence[FloatArray]) -> Iterator[tuple[int, int]]:
    """Yields (series, row) over several rising series of times, in time order; at equal times earlier series first."""
    if not times:
        return
    series = np.concatenate([np.full(len(t), i) for i, t in enumerate(times)])
    rows = np.concatenate([np.arange(len(t)) for t in times])
    order = np.argsort(np.concatenate(times), kind="stable")
    yield from zip(series[order].tolist(), rows[order].tolist(), strict=True)


def union_rows(channels: Sequence[Channel | None]) -> tuple[FloatArray, list[FloatArray | None]]:
    """Puts channels on the union of their times, shape (n,); rows without a sample are NaN, absent channels None."""
    present = [c.t for c in channels if c is not None]
    if not present:
        return np.empty(0), [None for _ in channels]
    t = present[0]
    if any(len(other) != len(t) or np.any(other != t) for other in present[1:]):
        t = np.unique(np.concatenate(present))
    out: list[FloatArray | None] = []
    for channel in channels:
        if channel is None:
            out.append(None)
            continue
        rows = np.full((len(t), channel.values.shape[1]), np.nan)
        rows[np.searchsorted(t, channel.t)] = channel.values
        out.append(rows)
    return t, out


def open_for_writing(path: str | Path) -> BinaryIO:
    """Opens a file for writing, in place of a link that stands there; raises LogError where it cannot be."""
    try:
        if Path(path).is_symlink():
            with written_whole(Path(path)) as fresh:
                fresh.touch()
        return open(path, "wb", opener=unwaited)
    except OSError as error:
        raise LogError(
            f"cannot write {path} ({error.strerror})", "a file in a folder that exists", "create the folder first"
        ) from error


def _stream(file: str | Path | BinaryIO) -> AbstractContextManager[BinaryIO]:
    """A file opened here is closed, one of the caller's stays open."""
    return open_for_writing(file) if isinstance(file, str | Path) else nullcontext(file)


# --- Writes ROS 2 messages of any type to MCAP without ROS: profile ros2, schemas ros2msg, CDR, zstd chunks with CRC


CHUNK_BYTES = 1 << 20
"""Compresses well; a caller who must not be held up for ten milliseconds takes less."""

LATCHED = ("quadid/parameters", "quadid/diagnosis", "quadid/health")
"""Ends of topics that the node offers transient local, depth 1: `ros2 bag play` offers them likewise."""


def offered_qos(topic: str) -> str:
    """QoS of a topic's publisher in the form of rosbag2 that all its versions read: numbers of rmw's policies.

    Jazzy writes names, and reads both; before Iron, names are an error.
    """
    latched = topic.endswith(LATCHED)
    forever = {"sec": 9223372036, "nsec": 854775807}
    return yaml.safe_dump([{
        "history": 1, "depth": 1 if latched else 10, "reliability": 1,
        "durability": 1 if latched else 2, "deadline": forever, "lifespan": forever,
        "liveliness": 1, "liveliness_lease_duration": forever, "avoid_ros_namespace_conventions": False,
    }], sort_keys=False)  # fmt: skip


class TopicWriter:
    """An MCAP file being written.  Use as a context manager; the file is complete only after `close`.

    Args:
        file: path, or a binary stream that stays open.
        metadata: records by name, for `quadid_replay.mcap_file`; they stand at the beginning.
        chunk_bytes: what is compressed and written at once, `CHUNK_BYTES` unless given; the caller waits for it.

    Raises:
        LogError: the file cannot be written.
    """

    def __init__(
        self,
        file: str | Path | BinaryIO,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        chunk_bytes: int | None = None,
    ) -> None:
        self._owned = open_for_writing(file) if isinstance(file, str | Path) else None
        self._writer = Writer(
            self._owned or file,  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES if chunk_bytes is None else chunk_bytes,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
        )
        self._writer.start(profile="ros2", library="quadid")
        for name, data in (metadata or {}).items():
            self._writer.add_metadata(name, dict(data))
        self._definitions: dict[str, str] = {}
        self._encoders: dict[str, Callable[[Any], bytes]] = {}
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, Iterator[int]]] = {}
        self._open = True
        self._flushed = 0

    def write(self, topic: str, kind: str, message: Any, stamp_ns: int) -> None:
        """Writes one message.

        Args:
            topic: name, such as ``quadid/parameters``.
            kind: ``package/msg/Type``, one of `quadid_replay.schemas`.
            message: object or dict with the message's fields, nested likewise; absent fields take their defaults.
            stamp_ns: log and publish time [ns].

        Raises:
            LogError: no definition of this type, or a message that does not fit it.
        """
        try:
            data = self.encoder(kind)(_namespace(message))
        except (ValueError, TypeError, AttributeError, LookupError) as error:
            raise LogError(
                f"message for {topic} does not fit {kind}: {error}", "the fields of its definition"
            ) from error
        self.write_cdr(topic, kind, data, stamp_ns)

    def write_cdr(self, topic: str, kind: str, data: bytes, stamp_ns: int) -> None:
        """Writes one message that is CDR already."""
        if topic not in self._channels:
            qos = {"offered_qos_profiles": offered_qos(topic)}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schema(kind), qos), count()
        channel, numbers = self._channels[topic]
        self._writer.add_message(channel, stamp_ns, data, stamp_ns, next(numbers))
        if self._owned is not None and self._owned.tell() != self._flushed:
            # A chunk was written: its end must not wait in a buffer, or a killed process would lose two chunks.
            self._owned.flush()
            self._flushed = self._owned.tell()

    def define(self, kind: str, text: str) -> None:
        """Gives the definition of a type that `quadid_replay.schemas` does not hold (form ros2msg)."""
        self._definitions[kind] = text

    def encoder(self, kind: str) -> Callable[[Any], bytes]:
        """Returns the function that makes CDR of a message of this type."""
        if kind not in self._encoders:
            self._encoders[kind] = serialize_dynamic(kind, _definition(kind))[kind]
        return self._encoders[kind]

    def close(self) -> None:
        """Writes index and footer; the file is readable without `close` too, but as a damaged one."""
        if self._open:
            self._open = False
            self._writer.finish()  # type: ignore[no-untyped-call]
            if self._owned is not None:
                self._owned.close()

    def _schema(self, kind: str) -> int:
        if kind not in self._schemas:
            text = self._definitions.get(kind) or _definition(kind)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
        return self._schemas[kind]

    def __enter__(self) -> "TopicWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _namespace(message: Any) -> Any:
    """Turns dicts into objects, throughout: the library takes an absent key ``values`` for the dict's own method."""
    if isinstance(message, Mapping):
        return SimpleNamespace(**{str(name): _namespace(value) for name, value in message.items()})
    if isinstance(message, list | tuple):
        return [_namespace(value) for value in message]
    return message


def _definition(kind: str) -> str:
    if not has_definition(kind):
        raise LogError(
            f"no definition of message type {kind}", "the types in quadid_replay/schemas", "add its .msg there"
        )
    return schema_text(kind)


# --- Writes a recording as the canonical MCAP: topics, types, frames and units of the contract (ENU, FLU, SI)


_ABSENT = -1.0
_STAMP, _STAMP_AT, _AFTER_STAMP = struct.Struct("<iI"), 4, 12
"""Stamp of a header in CDR, and its place."""


class _Series(NamedTuple):
    """Messages of one topic: type, times [s] (n,), rows of numbers (n, k), and what makes a message of such a row."""

    topic: str
    kind: str
    t: FloatArray
    rows: FloatArray
    build: Callable[[list[float]], dict[str, Any]]


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


def write_recordings(
    writer: TopicWriter,
    recordings: Mapping[str, Recording],
    epoch_ns: int = 0,
    wrenches: Mapping[str, tuple[FloatArray, FloatArray]] | None = None,
) -> None:
    """Writes recordings to an open writer, in time order, each with its name before its topics; see `write_mcap`.

    Args:
        recordings: by name.
        epoch_ns: added to recording time [ns].
        wrenches: by topic, times [s] and force [N] and moment [N m] in FRD, shapes (n,) and (n, 6).
    """
    each = [
        s._replace(topic=f"{name}/{s.topic}" if name else s.topic)
        for name, recording in recordings.items()
        for s in _all_series(recording, epoch_ns)
    ]
    for topic, (times, rows) in (wrenches or {}).items():
        both = np.hstack([flip_body(rows[:, :3]), flip_body(rows[:, 3:])])
        each.append(_Series(topic, "geometry_msgs/msg/WrenchStamped", times, both, _wrench))
    encoders = [_encoder(writer.encoder(s.kind), s.build, s.rows.shape[1]) for s in each]
    for which, row in in_time_order([s.t for s in each]):
        s = each[which]
        ns = epoch_ns + round(float(s.t[row]) * 1e9)
        writer.write_cdr(s.topic, s.kind, encoders[which](ns, s.rows[row].tolist()), ns)


def _encoder(
    encode: Callable[[Any], bytes], build: Callable[[list[float]], dict[str, Any]], size: int
) -> Callable[[int, list[float]], bytes]:
    """Encodes messages of one topic that differ in stamp [ns] and `size` numbers only.

    The library encodes one; the stamp and numbers of others are put where those of this one are found.  A type whose
    numbers are no doubles goes the library's way each time.
    """
    marks = [1.0 + 0.001 * k for k in range(size)]
    data, numbers = bytearray(encode(build(marks))), struct.Struct(f"<{size}d")
    at = data.find(numbers.pack(*marks), _AFTER_STAMP)

    def encoded(ns: int, values: list[float]) -> bytes:
        stamp = divmod(ns, 10**9)
        if at < 0:
            message = build(values)
            header = {**message["header"], "stamp": _named(("sec", "nanosec"), stamp)}
            return encode({**message, "header": header})
        _STAMP.pack_into(data, _STAMP_AT, *stamp)
        numbers.pack_into(data, at, *values)
        return bytes(data)

    return encoded


def _all_series(recording: Recording, epoch_ns: int) -> Iterator[_Series]:
    channels = recording.channels
    first = min((float(c.t[0]) for c in channels.values()), default=0.0)
    if epoch_ns + round(first * 1e9) < 0:
        raise LogError(f"times begin at {first:.3f} s", "times from 0 s on", "give an epoch that makes stamps positive")
    # One IMU message a stamp; a covariance marks what was not measured there (REP-145).
    t, measured = union_rows([channels.get("gyro"), channels.get("accel")])
    if len(t):
        rows = np.zeros((len(t), 37))
        rows[:, 3] = 1.0
        rows[:, [4, 16, 28]] = _ABSENT
        for at, values in zip((13, 25), measured, strict=True):
            if values is not None:
                there = np.isfinite(values).all(axis=1)
                rows[there, at + 3] = 0.0
                rows[there, at : at + 3] = flip_body(values[there])
        yield _Series("imu", "sensor_msgs/msg/Imu", t, rows, _imu)
    if (c := channels.get("attitude")) is not None:
        rows = flip_attitude(c.values)[:, [1, 2, 3, 0]]
        yield _Series("attitude", "geometry_msgs/msg/QuaternionStamped", c.t, rows, _attitude)
    if (c := channels.get("rotor_speed")) is not None:
        yield _Series("rotor_speeds", "sensor_msgs/msg/JointState", c.t, c.values, _rotor_speeds)
    if (c := channels.get("motor_command")) is not None:
        kind = 1 if _are_pulses(c) else 0  # KIND_PWM, KIND_NORMALIZED

        def motor_command(v: list[float]) -> dict[str, Any]:
            return {"header": _header("base_link"), "kind": kind, "values": v}

        yield _Series("motor_command", "quadid_msgs/msg/MotorCommand", c.t, c.values, motor_command)
    if (c := channels.get("attitude_reference")) is not None:
        rows = np.column_stack([to_euler(flip_attitude(from_euler(c.values[:, :3]))), c.values[:, 3]])
        yield _Series("command", "quadid_msgs/msg/AttitudeCommand", c.t, rows, _command)
    # Pose in the world; twist in the body where there is an attitude, else in the world (child frame = frame).
    t, (position, velocity) = union_rows([channels.get("position"), channels.get("velocity")])
    if len(t):
        rows = np.zeros((len(t), 85))
        rows[:, :3] = np.nan if position is None else flip_world(position)
        rows[:, 6] = 1.0
        world = np.full((len(t), 3), np.nan) if velocity is None else flip_world(velocity)
        child = "map"
        if (c := channels.get("attitude")) is not None:
            child, q = "base_link", linear(c.t, c.values, t)
            q = flip_attitude(q / np.linalg.norm(q, axis=1, keepdims=True))
            rows[:, 3:7] = q[:, [1, 2, 3, 0]]
            world = rotated(conjugate(q), world)
        rows[:, 43:46] = world
        yield _Series("odom", "nav_msgs/msg/Odometry", t, rows, partial(_odometry, child=child))
    if (c := channels.get("battery")) is not None:
        yield _Series("battery", "sensor_msgs/msg/BatteryState", c.t, c.values, _battery)


def _named(names: Iterable[str], values: Sequence[float]) -> dict[str, float]:
    return dict(zip(names, values, strict=True))


def _header(frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame}


def _imu(v: list[float]) -> dict[str, Any]:
    return {
        "header": _header("base_link"),
        "orientation": _named("xyzw", v[:4]),
        "orientation_covariance": v[4:13],
        "angular_velocity": _named("xyz", v[13:16]),
        "angular_velocity_covariance": v[16:25],
        "linear_acceleration": _named("xyz", v[25:28]),
        "linear_acceleration_covariance": v[28:37],
    }


def _attitude(v: list[float]) -> dict[str, Any]:
    return {"header": _header("map"), "quaternion": _named("xyzw", v)}


def _rotor_speeds(v: list[float]) -> dict[str, Any]:
    names = [f"rotor_{k + 1}" for k in range(len(v))]
    return {"header": _header("base_link"), "name": names, "position": [], "velocity": v, "effort": []}


def _command(v: list[float]) -> dict[str, Any]:
    return {"header": _header("map"), **_named(("roll", "pitch", "yaw", "throttle"), v)}


def _battery(v: list[float]) -> dict[str, Any]:
    unknown = ("temperature", "current", "charge", "capacity", "design_capacity", "percentage")
    return {"header": _header("base_link"), "voltage": v[0], **dict.fromkeys(unknown, math.nan), "present": True}


def _wrench(v: list[float]) -> dict[str, Any]:
    wrench = {"force": _named("xyz", v[:3]), "torque": _named("xyz", v[3:])}
    return {"header": _header("base_link"), "wrench": wrench}


def _odometry(v: list[float], child: str) -> dict[str, Any]:
    pose = {"position": _named("xyz", v[:3]), "orientation": _named("xyzw", v[3:7])}
    twist = {"linear": _named("xyz", v[43:46]), "angular": _named("xyz", v[46:49])}
    return {
        "header": _header("map"),
        "child_frame_id": child,
        "pose": {"pose": pose, "covariance": v[7:43]},
        "twist": {"twist": twist, "covariance": v[49:85]},
    }


# --- Writes a recording as CSV of the contract; every number is written so that it reads back to the same bits


_ROWS = 4096


def write_csv(file: str | Path | BinaryIO, source: Source) -> None:
    """Writes a recording or windows to CSV: one row a time, cells empty where a channel has no sample.

    Raises:
        LogError: nothing to write, or a file that cannot be written.
    """
    recording = recording_of(source)
    if not recording.channels:
        raise LogError(f"{recording.name}: no channel to write", "at least one")
    layout = column_names(recording)
    t, columns = union_rows([recording.channels[name] for name in layout])
    table = np.column_stack([t, *(c for c in columns if c is not None)])
    write_table(file, ["t", *(column for names in layout.values() for column in names)], table)


def column_names(recording: Recording) -> dict[str, tuple[str, ...]]:
    """Names of the columns of every channel that a recording has."""
    layout = {name: GROUPS[name] for name in GROUPS if name in recording.channels}
    for name, letter in (("rotor_speed", "w"), ("motor_command", "u")):
        if name in recording.channels:
            width = recording.channels[name].values.shape[1]
            layout[name] = tuple(f"{letter}{i + 1}" for i in range(width))
    return layout


def write_table(file: str | Path | BinaryIO, header: Sequence[str], table: FloatArray) -> None:
    """Writes numbers (rows, columns) under their names; cells of NaN stay empty."""
    with _stream(file) as stream:
        stream.write((",".join(header) + "\n").encode())
        for begin in range(0, len(table), _ROWS):
            lines = (",".join("" if v != v else repr(v) for v in row) for row in table[begin : begin + _ROWS].tolist())
            stream.write(("\n".join(lines) + "\n").encode())


# --- Writes a recording as MAVLink 2 messages: a telemetry log, or one by one for a live link
#
# HIGHRES_IMU and ESC_STATUS carry microseconds and single precision, ATTITUDE_QUATERNION, LOCAL_POSITION_NED and
# ATTITUDE_TARGET milliseconds, ESC_STATUS whole rpm, SERVO_OUTPUT_RAW whole microseconds: the format's resolution.


SYSTEM, COMPONENT = 1, 1
_UNIX_START_US = 1_600_000_000_000_000  # receive time at recording time 0
_TYPES = {rotors: kind for kind, rotors in MULTIROTORS.items()}
_GENERIC_AUTOPILOT, _ACTIVE = 0, 4
_LONGEST_MS = 2**32
_GYRO_BITS, _ACCEL_BITS = 0x38, 0x07


@cache
def _dialect() -> Any:
    from pymavlink.dialects.v20 import ardupilotmega  # a second to import and 80 MB, and many write other formats only

    return extend_dialect(ardupilotmega)


def write_tlog(file: str | Path | BinaryIO, source: Source) -> None:
    """Writes a recording or windows to a telemetry log.

    Raises:
        LogError: nothing to write, times that boot clocks cannot tell, or a file that cannot be written.
    """
    recording = recording_of(source)
    mav = _dialect().MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
    with _stream(file) as stream:
        for t, message in mavlink_messages(recording):
            frame = message.pack(mav)
            mav.seq = (mav.seq + 1) % 256
            stream.write(struct.pack(">Q", _UNIX_START_US + round(t * 1e6)) + frame)


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

    # Times, rows of numbers, and what they are in messages: name and fields of each.
    series: list[tuple[FloatArray, FloatArray, Callable[[float, list[float]], list[tuple[Any, ...]]]]] = []
    motors = channels.get("rotor_speed") or channels.get("motor_command")
    rotors = motors.values.shape[1] if motors is not None else 4
    seconds, escs = np.arange(first, last + 1.0, 1.0), range(0, rotors, 4) if "rotor_speed" in channels else ()
    beat = ("heartbeat", _TYPES.get(rotors, 2), _GENERIC_AUTOPILOT, 0, 0, _ACTIVE, 3)
    zeros = [0, 0, 0, 0]
    series.append(
        (
            seconds,
            np.empty((len(seconds), 0)),
            lambda t, v: [beat, *(("esc_info", i, _us(t), 0, rotors, 0, 0, zeros, zeros, zeros) for i in escs)],
        )
    )
    for names, messages in (
        (("accel", "gyro"), _highres_imu),
        (("attitude",), lambda t, v: [("attitude_quaternion", _ms(t), *v, 0.0, 0.0, 0.0)]),
        (("rotor_speed",), _esc_status),
        (("motor_command",), _outputs),
        (("attitude_reference",), _attitude_target),
        (("battery",), _battery_status),
        (("position", "velocity"), lambda t, v: [("local_position_ned", _ms(t), *v)]),
    ):
        # One message a time; NaN stands for what was not measured there.
        t, parts = union_rows([channels.get(name) for name in names])
        if names == ("motor_command",) and t.size and not _are_pulses(channels["motor_command"]):
            messages = _actuator_output_status
        if len(t):
            absent = np.full((len(t), 3), np.nan)
            series.append((t, np.hstack([absent if part is None else part for part in parts]), messages))
    for which, row in in_time_order([t for t, _, _ in series]):
        times, rows, messages = series[which]
        at = float(times[row])
        for name, *fields in messages(at, rows[row].tolist()):
            yield at, getattr(_dialect(), f"MAVLink_{name}_message")(*fields)


def _ms(t: float) -> int:
    return round(t * 1e3)


def _us(t: float) -> int:
    return round(t * 1e6)


def _are_pulses(commands: Channel) -> bool:
    """True for pulse widths [us], false for normalized commands."""
    return bool(np.nanmedian(np.abs(commands.values)) > 100.0)


def _highres_imu(t: float, v: list[float]) -> list[tuple[Any, ...]]:
    force, rate = np.isfinite(v[:3]).all(), np.isfinite(v[3:]).all()
    fields = [*(v[:3] if force else [0.0] * 3), *(v[3:] if rate else [0.0] * 3)]
    return [("highres_imu", _us(t), *fields, *[0.0] * 7, _ACCEL_BITS * int(force) | _GYRO_BITS * int(rate))]


def _esc_status(t: float, v: list[float]) -> list[tuple[Any, ...]]:
    rpm, zeros = [round(w / RPM) for w in v] + [0] * (-len(v) % 4), [0.0] * 4
    return [("esc_status", i, _us(t), rpm[i : i + 4], zeros, zeros) for i in range(0, len(v), 4)]


def _outputs(t: float, v: list[float]) -> list[tuple[Any, ...]]:
    return [("servo_output_raw", _us(t) % 2**32, 0, *map(round, v), *[0] * (16 - len(v)))]


def _actuator_output_status(t: float, v: list[float]) -> list[tuple[Any, ...]]:
    return [("actuator_output_status", _us(t), len(v), v + [0.0] * (32 - len(v)))]


def _attitude_target(t: float, v: list[float]) -> list[tuple[Any, ...]]:
    return [("attitude_target", _ms(t), 0, from_euler(np.array([v[:3]]))[0].tolist(), 0.0, 0.0, 0.0, v[3])]


def _battery_status(t: float, v: list[float]) -> list[tuple[Any, ...]]:
    """The whole pack's voltage as if of one cell [mV]."""
    cells = [min(round(v[0] * 1e3), 65534)] + [65535] * 9
    return [("battery_status", 0, 0, 0, 32767, cells, -1, -1, -1, -1)]


# --- Writes recordings of one flight side by side, such as measured and simulated, for viewers that draw curves


def write_compared(
    path: str | Path,
    recordings: Mapping[str, Recording],
    epoch_ns: int = 0,
    wrenches: Mapping[str, tuple[FloatArray, FloatArray]] | None = None,
) -> None:
    """Writes recordings under their names: topics ``simulated/imu`` in MCAP, columns ``simulated/p`` in CSV.

    Args:
        path: ends in .mcap (ENU, FLU) or .csv (NED, FRD).
        recordings: by name.
        epoch_ns: added to recording time in MCAP, so that stamps count from the UNIX epoch [ns].
        wrenches: forces and moments beside them in MCAP, as `write_recordings` takes them.

    Raises:
        LogError: another suffix, nothing to write, or a file that cannot be written.
    """
    kind = Path(path).suffix.lower()
    if kind == ".mcap":
        with TopicWriter(path) as writer:
            write_recordings(writer, recordings, epoch_ns, wrenches)
        return
    if kind != ".csv":
        raise LogError(f"'{path}' has the suffix of no format", ".mcap, .csv")
    channels = [(name, layout) for name, r in recordings.items() for layout in column_names(r).items()]
    t, columns = union_rows([recordings[name].channels[channel] for name, (channel, _) in channels])
    header, table = ["t"], [t[:, None]]
    for (name, (channel, names)), values in zip(channels, columns, strict=True):
        assert values is not None
        # Angles show more in a picture than a quaternion does.
        header += [f"{name}/{column}" for column in (EULER if channel == "attitude" else names)]
        table.append(to_euler(values) if channel == "attitude" else values)
    write_table(path, header, np.concatenate(table, axis=1))
