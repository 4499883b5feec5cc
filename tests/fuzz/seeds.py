"""Small whole logs that the fuzzer mutates: between them every kind of message that is read, a few samples of each."""

import struct
from collections.abc import Callable
from functools import lru_cache
from io import BytesIO
from typing import Any

from mcap.writer import CompressionType, Writer
from mcap_ros2._dynamic import serialize_dynamic
from quadid_replay.mavlink_messages import READERS
from quadid_replay.schemas import schema_text

from tests.fuzz import rosbag2_format
from tests.replay import blackbox_writer
from tests.replay.test_blackbox import rows as blackbox_rows
from tests.replay.test_dataflash import Dataflash
from tests.replay.test_mcap import EPOCH, MAVROS, PX4, header, imu, with_parts
from tests.replay.test_tlog import MAV, Tlog, attitude, heartbeat
from tests.replay.test_ulog import Ulog
from tests.replay.test_usd import controller_log, motor_log

ROWS = 4


def mcap_of(messages: list[tuple[str, str, str, Any]], summary: bool, chunks: bool = True, shown: str = "") -> bytes:
    """A log of (topic, type, definition, message), the messages `ROWS` times; `shown` replaces the definition in it."""
    buffer = BytesIO()
    writer = Writer(buffer, compression=CompressionType.NONE, enable_crcs=True, use_chunking=chunks)
    writer.start(profile="ros2")
    channels, encoders = [], []
    for topic, kind, text, _ in messages:
        schema = writer.register_schema(kind, "ros2msg", (shown or text).encode())
        channels.append(writer.register_channel(topic, "cdr", schema))
        encoders.append(serialize_dynamic(kind, text)[kind])
    for row in range(ROWS):
        for channel, encode, (*_, message) in zip(channels, encoders, messages, strict=True):
            ns = EPOCH + row * 20_000_000
            writer.add_message(channel, ns, encode(message(ns)), ns)
    writer.finish()  # type: ignore[no-untyped-call]
    data = buffer.getvalue()
    if summary:
        return data
    foot = len(data) - 37
    return data[: struct.unpack_from("<Q", data, foot + 9)[0]]


def _pulses(ns: int) -> dict[str, Any]:
    return {"header": header(ns), "channels": [1100 + ns // 20_000_000 % 4 * 20] * 4}


def _mcap_seeds() -> list[bytes]:
    def known(kind: str) -> str:
        return schema_text(kind)

    joints = {"name": ["rotor_1", "rotor_2", "rotor_3"], "velocity": [400.0, 410.0, 420.0]}
    pose = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    plain: dict[str, tuple[str, Callable[[int], Any]]] = {
        "imu": ("sensor_msgs/msg/Imu", imu),
        "rotor_speeds": ("sensor_msgs/msg/JointState", lambda ns: {"header": header(ns), **joints}),
        "odom": ("nav_msgs/msg/Odometry", lambda ns: {"header": header(ns), "pose": {"pose": pose}}),
        "battery": ("sensor_msgs/msg/BatteryState", lambda ns: {"header": header(ns), "voltage": 12.0}),
        "motor_command": ("quadid_msgs/msg/MotorCommand", lambda ns: {"header": header(ns), "values": [0.5] * 4}),
        "command": ("quadid_msgs/msg/AttitudeCommand", lambda ns: {"header": header(ns), "roll": 0.1}),
    }
    seeds = [
        mcap_of([(topic, kind, known(kind), message)], bool(i % 2))
        for i, (topic, (kind, message)) in enumerate(plain.items())
    ]
    us = [lambda ns: {"timestamp": ns // 1000 % 10**9, "q": [1.0, 0.0, 0.0, 0.0], "control": [0.5] * 12}]
    seeds += [mcap_of([(f"/fmu/out/{k.rsplit('/')[-1]}", k, text, us[0])], True) for k, text in PX4.items()]
    out = "mavros_msgs/msg/RCOut"
    text = with_parts(MAVROS[out], "std_msgs/Header", "builtin_interfaces/Time")
    seeds.append(mcap_of([("rc/out", out, text, _pulses)], False))
    kind, message = plain["imu"]
    seeds.append(mcap_of([("imu", kind, known(kind), message)], False, chunks=False))
    return seeds


def _tlog_seeds() -> list[bytes]:
    """One log a message type, zeros but for the stamps, and one that `write_tlog` made."""
    seeds = []
    for name in READERS:
        number = next(n for n, m in MAV.mavlink_map.items() if m.msgname == name)
        kind = MAV.mavlink_map[number]
        log = Tlog()
        log.add(0.0, heartbeat())
        if not {"time_usec", "time_boot_ms"} & set(kind.fieldnames):
            log.add(0.0, attitude(1.0))  # whose boot time the others lean on
        for row in range(ROWS):
            message = kind(*[_value(kind, field, row) for field in kind.fieldnames])
            log.add(0.02 * row, message, force_v1=name == "ATTITUDE")
        seeds.append(bytes(log.data))
    return seeds


def _value(kind: Any, field: str, row: int) -> Any:
    place = kind.ordered_fieldnames.index(field)
    length = kind.array_lengths[place]
    known = {"time_usec": 1_000_000 + 20_000 * row, "time_boot_ms": 1000 + 20 * row, "q1": 1.0}
    value = 0 if field in ("fields_updated", "port", "id", "index", "active") else known.get(field, 1 + row)
    if kind.fieldtypes[kind.fieldnames.index(field)] == "char":
        return b"x"
    return [value] * length if length else value


def _dataflash_seeds() -> list[bytes]:
    layouts = (
        ("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", (0, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8)),
        ("RCOU", "QHHHH", "TimeUS,C1,C2,C3,C4", (1100, 1200, 1300, 1400)),
        ("ATT", "Qcccccc", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", (100, 1000, -100, -500, 9000, 27000)),
        ("CTUN", "Qf", "TimeUS,ThO", (0.5,)),
        ("ESC", "QBf", "TimeUS,Instance,RPM", (0, 6000.0)),
        ("BAT", "Qf", "TimeUS,Volt", (12.0,)),
        ("XKQ1", "Qffff", "TimeUS,Q1,Q2,Q3,Q4", (1.0, 0.0, 0.0, 0.0)),
        ("XKF1", "Qffffff", "TimeUS,VN,VE,VD,PN,PE,PD", (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)),
        ("GYR", "QQfff", "TimeUS,SampleUS,GyrX,GyrY,GyrZ", (1000, 0.1, 0.2, 0.3)),
    )
    seeds = []
    for chosen in (layouts[:2], layouts[2:4], layouts[4:6], layouts[6:8], layouts[8:]):
        log = Dataflash()
        log.describe(1, "PARM", "QNf", "TimeUS,Name,Value")
        for number, (name, form, columns, _) in enumerate(chosen, 2):
            log.describe(number, name, form, columns)
        log.add("PARM", 0, b"SERVO1_FUNCTION", 33.0)
        for row in range(ROWS):
            for name, _, _, values in chosen:
                log.add(name, 1_000_000 + 20_000 * row, *values)
        seeds.append(bytes(log.data))
    return seeds


def _ulog_seeds() -> list[bytes]:
    layouts: tuple[tuple[str, str, str, tuple[float, ...]], ...] = (
        ("sensor_combined", "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
         "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;",
         "3fIi3fI", (0.1, 0.2, 0.3, 4000, 0, 0.0, 0.0, -9.8, 4000)),
        ("actuator_motors", "uint64_t timestamp;uint64_t timestamp_sample;float[12] control;", "Q12f",
         (1, *[0.5] * 12)),
        ("vehicle_attitude", "uint64_t timestamp;float[4] q;", "4f", (1.0, 0.0, 0.0, 0.0)),
        ("vehicle_attitude_setpoint", "uint64_t timestamp;float[4] q_d;float[3] thrust_body;", "7f",
         (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.5)),
        ("vehicle_local_position", "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;"
         "bool xy_valid;bool v_xy_valid;", "6f2B", (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1, 1)),
        ("battery_status", "uint64_t timestamp;float voltage_v;", "f", (12.0,)),
        ("actuator_outputs", "uint64_t timestamp;float[16] output;", "16f", (1100.0,) * 16),
    )  # fmt: skip
    seeds = []
    for chosen in (layouts[:1], layouts[1:2], layouts[2:4], layouts[4:6], layouts[6:]):
        log = Ulog()
        log.record("B", bytes(40))
        for name, fields, _, _ in chosen:
            log.format(name, fields)
        log.parameter("CA_ROTOR_COUNT", 4.0)
        for name, *_ in chosen:
            log.subscribe(name)
        for row in range(ROWS):
            for name, _, form, values in chosen:
                moved = [value + 20.0 * row for value in values] if name == "actuator_outputs" else values
                log.add(name, "Q" + form, 1_000_000 + 20_000 * row, *moved)
        seeds.append(bytes(log.data))
    nested = Ulog()
    nested.format("esc_report", "uint64_t timestamp;int32_t esc_rpm;uint8_t actuator_function;")
    nested.format("esc_status", "uint64_t timestamp;uint8_t esc_count;esc_report[8] esc;")
    nested.subscribe("esc_status")
    for row in range(ROWS):
        nested.add("esc_status", "QB" + "QiB" * 8, 1_000_000 + 20_000 * row, 8, *[1, 6000, 101] * 8)
    return [*seeds, bytes(nested.data)]


def _usd_seeds() -> list[bytes]:
    return [controller_log(ROWS).closed(), motor_log(ROWS).closed()]


def _rosbag2_seeds() -> list[bytes]:
    """The rows of `rosbag2_format`: an IMU and rotors with their definitions, and an IMU whose type is known."""
    kinds = ("sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState")
    messages: list[Callable[[int], Any]] = [
        imu,
        lambda ns: {"header": header(ns), "name": ["a", "b", "c", "d"], "velocity": [400.0] * 4},
    ]
    seeds = []
    for described in (True, False):
        rows = []
        for number, (kind, message) in enumerate(zip(kinds, messages, strict=True), 1):
            text = schema_text(kind)
            rows.append(rosbag2_format.row("topics", number, kind.rsplit("/")[-1].lower(), kind, "cdr", ""))
            if described:
                rows.append(rosbag2_format.row("message_definitions", number, kind, "ros2msg", text))
            encode = serialize_dynamic(kind, text)[kind]
            stamps = [EPOCH + k * 20_000_000 for k in range(ROWS)]
            rows += [
                rosbag2_format.row("messages", 100 * number + k, number, ns, encode(message(ns)))
                for k, ns in enumerate(stamps)
            ]
        seeds.append(b"".join(rows))
    return seeds


def _blackbox_seeds() -> list[bytes]:
    flown = blackbox_rows(24)
    head = blackbox_writer.header()
    return [head + b"".join(blackbox_writer.frames(flown, n)) + blackbox_writer.END for n in (8, 4)]


_MAKE = {
    "mcap": _mcap_seeds,
    "tlog": _tlog_seeds,
    "dataflash": _dataflash_seeds,
    "ulog": _ulog_seeds,
    "rosbag2": _rosbag2_seeds,
    "usdlog": _usd_seeds,
    "blackbox": _blackbox_seeds,
}


@lru_cache(maxsize=8)
def seeds(kind: str) -> tuple[bytes, ...]:
    """The seeds of a format, a key of `tests.fuzz.formats.FORMATS`."""
    return tuple(_MAKE[kind]())
