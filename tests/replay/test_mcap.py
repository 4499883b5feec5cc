"""MCAP: topics and presets of the stacks, stamps of several clocks, limits, damage, and readers that are not ours."""

import struct
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as RosWriter
from quadid_replay import TopicWriter, open_log, write_mcap
from quadid_replay.motors import RPM
from quadid_replay.ros_messages import TYPES, MessageReader
from quadid_replay.schemas import schema_text
from quadid_replay.writers import offered_qos
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability

from quadid.errors import LogError
from tests.replay.synthetic import full_recording

EPOCH = 1_700_000_000_000_000_000
PX4 = {
    "px4_msgs/msg/SensorCombined": "uint64 timestamp\nfloat32[3] gyro_rad\nuint32 gyro_integral_dt\n"
    "float32[3] accelerometer_m_s2\n",
    "px4_msgs/msg/VehicleAttitude": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[4] q\n",
    "px4_msgs/msg/ActuatorMotors": "uint64 timestamp\nfloat32[12] control\n",
}
MAVROS = {
    "mavros_msgs/msg/RCOut": "std_msgs/Header header\nuint16[] channels\n",
    "mavros_msgs/msg/ESCStatusItem": "int32 rpm\n",
}


def with_parts(text: str, *parts: str) -> str:
    return text + "".join(f"{'=' * 80}\nMSG: {p}\n{schema_text(p)}" for p in parts)


def header(ns: int) -> dict[str, Any]:
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": "base_link"}


def imu(ns: int, rate: float = 0.1, force: float = 9.8, orientation: float = -1.0) -> dict[str, Any]:
    return {
        "header": header(ns),
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "orientation_covariance": [orientation] + [0.0] * 8,
        "angular_velocity": {"x": rate, "y": 0.2, "z": 0.3},
        "linear_acceleration": {"x": 0.0, "y": 0.0, "z": force},
    }


def mavros_log(path: Path) -> None:
    with path.open("wb") as stream, RosWriter(stream) as writer:
        kinds = {
            "sensor_msgs/msg/Imu": schema_text("sensor_msgs/Imu"),
            "mavros_msgs/msg/RCOut": with_parts(
                MAVROS["mavros_msgs/msg/RCOut"], "std_msgs/Header", "builtin_interfaces/Time"
            ),
        }
        schemas = {name: writer.register_msgdef(name, text) for name, text in kinds.items()}
        for k in range(200):
            ns = EPOCH + k * 10_000_000
            repeated = imu(ns, 0.1 + k, 9.8 + 0.01 * (k // 4), 0.01)
            writer.write_message("/uas1/mavros/imu/data", schemas["sensor_msgs/msg/Imu"], repeated, ns)
            writer.write_message(
                "/uas1/mavros/imu/data_raw", schemas["sensor_msgs/msg/Imu"], imu(ns, k, 9.8 + 0.01 * k), ns
            )
            out = {"header": header(ns), "channels": [1100 + k, 1200 + k, 1300 + k, 1400 + k, 0, 0, 0, 0]}
            writer.write_message("/uas1/mavros/rc/out", schemas["mavros_msgs/msg/RCOut"], out, ns)


@pytest.mark.parametrize("preset", ["auto", "mavros"])
def test_mavros_raw_before_repeated(tmp_path: Path, preset: str) -> None:
    mavros_log(tmp_path / "log")
    recording = open_log(tmp_path / "log", preset)
    assert recording.channels["accel"].source == "/uas1/mavros/imu/data_raw (sensor_msgs/Imu)"
    np.testing.assert_allclose(recording.channels["gyro"].values[3], [3.0, -0.2, -0.3])
    assert recording.channels["motor_command"].values.shape == (200, 4)
    assert recording.channels["gyro"].t[0] == 0.0
    assert any("UNIX time 1700000000" in w for w in recording.warnings)


def test_unknown_and_unfitting_presets(tmp_path: Path) -> None:
    mavros_log(tmp_path / "log")
    with pytest.raises(LogError, match="unknown preset 'mavro'.*did you mean 'mavros'"):
        open_log(tmp_path / "log", "mavro")
    with pytest.raises(LogError, match="no topic to read with preset 'px4'.*imu/data"):
        open_log(tmp_path / "log", "px4")


@pytest.mark.parametrize("suffix", ["", "_v1"])
def test_px4_topics_on_their_own_boot_clock(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / "log"
    with path.open("wb") as stream, RosWriter(stream) as writer:
        schemas = {name: writer.register_msgdef(name, text) for name, text in PX4.items()}
        for k in range(100):
            us, ns = 5_000_000 + k * 10_000, EPOCH + k * 10_000_000
            sensor = {
                "timestamp": us,
                "gyro_rad": [0.1, 0.2, 0.3],
                "gyro_integral_dt": 4000,
                "accelerometer_m_s2": [0, 0, -9.8],
            }
            attitude = {"timestamp": us, "timestamp_sample": us - 1000, "q": [1.0, 0.0, 0.0, 0.0]}
            motors = {"timestamp": us, "control": [0.5, 0.6, 0.7, 0.8] + [float("nan")] * 8}
            for topic, kind, message in (
                ("sensor_combined", "SensorCombined", sensor),
                ("vehicle_attitude", "VehicleAttitude", attitude),
                ("actuator_motors", "ActuatorMotors", motors),
            ):
                name = f"/drone1/fmu/out/{topic}{suffix}"
                writer.write_message(name, schemas[f"px4_msgs/msg/{kind}"], message, ns)
    recording = open_log(path, "px4")
    np.testing.assert_allclose(recording.channels["gyro"].values[0], [0.1, 0.2, 0.3], rtol=1e-6)  # FRD already
    np.testing.assert_allclose(recording.channels["motor_command"].values[0], [0.5, 0.6, 0.7, 0.8], rtol=1e-6)
    apart = recording.channels["gyro"].t[0] - recording.channels["attitude"].t[0]
    assert apart == pytest.approx(0.001 - 0.002, abs=1e-6)
    assert len(recording.channels["attitude"].t) == 100


@pytest.mark.parametrize(("kind", "motors"), [(2, True), (1, False), (22, False), (0, True)])
def test_outputs_of_a_plane_are_no_rotors_in_a_ros_log_either(tmp_path: Path, kind: int, motors: bool) -> None:
    """The test of the other formats, by the MAV_TYPE of VehicleStatus."""
    path, nan = tmp_path / "log", float("nan")
    status = {"px4_msgs/msg/VehicleStatus": "uint64 timestamp\nuint8 nav_state\nuint8 system_type\n"}
    with path.open("wb") as stream, RosWriter(stream) as writer:
        schemas = {name: writer.register_msgdef(name, text) for name, text in {**PX4, **status}.items()}
        for k in range(60):
            us, ns = 5_000_000 + k * 10_000, EPOCH + k * 10_000_000
            for topic, of, message in (
                ("vehicle_attitude", "VehicleAttitude", {"timestamp": us, "q": [1.0, 0.0, 0.0, 0.0]}),
                ("actuator_motors", "ActuatorMotors", {"timestamp": us, "control": [0.5] * 4 + [nan] * 8}),
                ("vehicle_status", "VehicleStatus", {"timestamp": us, "nav_state": 2, "system_type": kind}),
            ):
                writer.write_message(f"/fmu/out/{topic}", schemas[f"px4_msgs/msg/{of}"], message, ns)
    for preset in ("auto", "px4"):
        recording = open_log(path, preset)
        assert set(recording.channels) == {"attitude"} | ({"motor_command"} if motors else set())
        assert any(f"MAV_TYPE {kind}, no multirotor" in w for w in recording.warnings) is not motors


def test_stamps_of_zero_fall_back_to_log_time_and_another_clock_is_shifted(tmp_path: Path) -> None:
    for name, stamp in (("zero", lambda k: 0), ("simulated", lambda k: 2_000_000_000 + k * 10_000_000)):
        with TopicWriter(tmp_path / name) as writer:
            for k in range(100):
                writer.write("imu", "sensor_msgs/msg/Imu", imu(stamp(k)), EPOCH + k * 10_000_000)
        t = open_log(tmp_path / name).channels["gyro"].t
        np.testing.assert_allclose(t, 0.01 * np.arange(100), atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("names", "order"),
    [
        (["rotor_10", "rotor_1", "rotor_3", "rotor_2"], [1, 3, 2, 0]),
        (["motor2_joint", "motor0_joint", "motor3_joint", "motor1_joint"], [1, 3, 0, 2]),
        (["front", "left", "rear", "right"], [0, 1, 2, 3]),
        ([], [0, 1, 2, 3]),
    ],
)
def test_joints_are_rotors_in_the_order_of_their_numbers(tmp_path: Path, names: list[str], order: list[int]) -> None:
    with TopicWriter(tmp_path / "log") as writer:
        for k in range(60):
            ns = EPOCH + k * 10_000_000
            speeds = [100.0 + k, 200.0 + k, 300.0 + k, 400.0 + k]
            message = {"header": header(ns), "name": names, "position": [], "velocity": speeds, "effort": []}
            writer.write("rotor_speeds", "sensor_msgs/msg/JointState", message, ns)
    values = open_log(tmp_path / "log").channels["rotor_speed"].values
    np.testing.assert_array_equal(values, (100.0 * (np.array(order) + 1.0)) + np.arange(60.0)[:, None])


def test_actuators_of_rotors_and_gazebo(tmp_path: Path) -> None:
    text = with_parts(
        "std_msgs/Header header\nfloat64[] position\nfloat64[] velocity\nfloat64[] normalized\n",
        "std_msgs/Header",
        "builtin_interfaces/Time",
    )
    with (tmp_path / "log").open("wb") as stream, RosWriter(stream) as writer:
        schema = writer.register_msgdef("actuator_msgs/msg/Actuators", text)
        for k in range(50):
            ns = k * 10_000_000
            message = {"header": header(ns), "position": [], "velocity": [400.0 + k] * 6, "normalized": []}
            writer.write_message("/firefly/motor_speed", schema, message, ns)
    speed = open_log(tmp_path / "log", "rotors").channels["rotor_speed"]
    assert speed.values.shape == (50, 6)


def test_esc_status_counts_in_rpm(tmp_path: Path) -> None:
    text = "std_msgs/Header header\nESCStatusItem[] esc_status\n"
    item = f"{'=' * 80}\nMSG: mavros_msgs/ESCStatusItem\n{MAVROS['mavros_msgs/msg/ESCStatusItem']}"
    with (tmp_path / "log").open("wb") as stream, RosWriter(stream) as writer:
        schema = writer.register_msgdef(
            "mavros_msgs/msg/ESCStatus", with_parts(text, "std_msgs/Header", "builtin_interfaces/Time") + item
        )
        for k in range(50):
            ns = k * 10_000_000
            message = {"header": header(ns), "esc_status": [{"rpm": 6000 + i} for i in range(4)]}
            writer.write_message("/mavros/esc_status/status", schema, message, ns)
    speed = open_log(tmp_path / "log").channels["rotor_speed"]
    np.testing.assert_allclose(speed.values[0], RPM * (6000 + np.arange(4)))


def test_real_flights_in_their_frames(data_dir: Path) -> None:
    """The same flight as MCAP (FLU, ENU) and as CSV (FRD, NED)."""
    mcap = open_log(data_dir / "mcap" / "crazyflie_figure8_35.mcap")
    csv = open_log(data_dir / "crazyflie_rpm" / "figure8_35.csv")
    for name, factor in (("gyro", 1.0), ("accel", 9.81 / 9.80665), ("rotor_speed", 1.0)):  # made with two values of g
        np.testing.assert_allclose(factor * mcap.channels[name].values, csv.channels[name].values, rtol=2e-5, atol=2e-5)
    dots = np.abs(np.sum(mcap.channels["attitude"].values * csv.channels["attitude"].values, axis=1))
    np.testing.assert_allclose(dots, 1.0, atol=1e-5)
    commands = open_log(data_dir / "crazyflie_rpm" / "figure8_35_pwm.csv").channels["motor_command"]
    np.testing.assert_allclose(mcap.channels["motor_command"].values, commands.values, atol=1e-5)


def test_fast_reading_is_what_the_library_decodes(data_dir: Path) -> None:
    path = data_dir / "mcap" / "crazyflie_figure8_35.mcap"
    ours = open_log(path).channels
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        theirs = [m.decoded_message for m in reader.iter_decoded_messages(topics=["/imu/data_raw"])]
    rates = np.array([[m.angular_velocity.x, -m.angular_velocity.y, -m.angular_velocity.z] for m in theirs])
    np.testing.assert_array_equal(ours["gyro"].values, rates)


def test_messages_without_a_layout_are_read_together_as_one_by_one() -> None:
    """PX4's have no header: each was a block of its own, which took half of the time in which the node took them in."""

    def decode(data: bytes) -> SimpleNamespace:
        t, *q = struct.unpack("<Q4f", data)
        return SimpleNamespace(timestamp=t, timestamp_sample=t, q=q)

    kind, rng = TYPES["px4_msgs/VehicleAttitude"], np.random.default_rng(0)
    data = [struct.pack("<Q4f", 1000 + k, *rng.normal(size=4)) for k in range(20)]
    together = MessageReader(kind, decode).read(data)
    each = [MessageReader(kind, decode).read([one]) for one in data]
    assert together is not None
    assert together.ns.tolist() == [one.ns[0] for one in each if one is not None]
    assert together.blocks[0].tobytes() == b"".join(one.blocks[0].tobytes() for one in each if one is not None)
    assert MessageReader(kind, decode).read([*data, b"short"]) is None, "its halves tell which one it is"
    with pytest.raises(struct.error):
        MessageReader(kind, decode).read([b"short"])


def test_other_readers_open_our_files(tmp_path: Path) -> None:
    recording = full_recording()
    path = tmp_path / "ours.mcap"
    write_mcap(path, recording, EPOCH)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
        assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
        assert {c.compression for c in summary.chunk_indexes} == {"zstd"}
        topics = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
        assert len(list(reader.iter_decoded_messages())) == summary.statistics.message_count  # type: ignore[union-attr]
    assert topics == {
        "imu": "sensor_msgs/msg/Imu",
        "attitude": "geometry_msgs/msg/QuaternionStamped",
        "rotor_speeds": "sensor_msgs/msg/JointState",
        "motor_command": "quadid_msgs/msg/MotorCommand",
        "command": "quadid_msgs/msg/AttitudeCommand",
        "odom": "nav_msgs/msg/Odometry",
        "battery": "sensor_msgs/msg/BatteryState",
    }
    with AnyReader([path]) as bag:
        for connection, stamp, data in bag.messages():
            message: Any = bag.deserialize(data, connection.msgtype)
            assert stamp == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            if connection.topic == "rotor_speeds":
                assert list(message.name) == ["rotor_1", "rotor_2", "rotor_3", "rotor_4"]


def test_any_message_of_ours_can_be_written(tmp_path: Path) -> None:
    parameters = {
        "header": header(5),
        "schema_version": 1,
        "vehicle_id": "pelican",
        "sequence": 7,
        "state": 3,
        "names": ["b"],
        "units": ["N s^2/rad^2"],
        "values": [2e-5],
        "covariance": [1e-12],
        "status": [0],
        "relative_to": [""],
        "mse_held_out": float("nan"),
    }
    with TopicWriter(tmp_path / "log") as writer:
        writer.write("quadid/parameters", "quadid_msgs/msg/ParameterSet", parameters, 5)
        finding = {"effect": "motor_lag", "parameter_names": ["tau"], "parameter_values": [0.05]}
        writer.write("quadid/diagnosis", "quadid_msgs/msg/Diagnosis", {"findings": [finding]}, 6)
        writer.write("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", {"status": [{"name": "quadid"}]}, 7)
        with pytest.raises(LogError, match="no definition"):
            writer.write("x", "foo_msgs/msg/Bar", {}, 8)
        with pytest.raises(LogError, match="does not fit"):
            writer.write("quadid/parameters", "quadid_msgs/msg/ParameterSet", {"values": "many"}, 9)
    with (tmp_path / "log").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        messages = {m.channel.topic: m.decoded_message for m in reader.iter_decoded_messages()}
    assert messages["quadid/parameters"].names == ["b"]
    assert list(messages["quadid/parameters"].values) == [2e-5]
    assert messages["quadid/diagnosis"].findings[0].effect == "motor_lag"


@dataclass
class _Esc:
    esc_rpm: int
    actuator_function: int


def _escs_of(*functions: int) -> SimpleNamespace:
    """px4_msgs/EscStatus of eight ESCs, of which so many are connected; the ESC in place k turns k + 1 hundred rpm."""
    esc = [_Esc(100 * (k + 1), f) for k, f in enumerate([*functions, *[0] * (8 - len(functions))])]
    return SimpleNamespace(timestamp=1_000_000, esc_count=4, esc=esc)


@pytest.mark.parametrize(
    ("functions", "places"),
    [
        ((0, 0, 0, 0), (1, 2, 3, 4)),
        ((101, 102, 103, 104), (1, 2, 3, 4)),
        ((104, 103, 101, 102), (3, 4, 2, 1)),
        ((0, 0, 102, 101, 0, 104, 103), (4, 3, 7, 6)),
        ((101, 201, 102, 103, 104), (1, 3, 4, 5)),
    ],
)
def test_px4_escs_go_to_the_motors_that_they_name(functions: tuple[int, ...], places: tuple[int, ...]) -> None:
    kind = TYPES["px4_msgs/EscStatus"]
    row = kind.runs[0](_escs_of(*functions))
    np.testing.assert_allclose(row, [100 * place * RPM for place in places])


def test_px4_escs_that_name_no_complete_row_of_motors_are_refused() -> None:
    with pytest.raises(ValueError, match="no complete row of motors"):
        TYPES["px4_msgs/EscStatus"].runs[0](_escs_of(101, 103, 104, 0))


def test_written_topics_say_how_they_are_offered_so_that_a_bag_is_played_latched(tmp_path: Path) -> None:
    path = tmp_path / "sets.mcap"
    with TopicWriter(path) as writer:
        for topic, kind in (("quad1/quadid/parameters", "ParameterSet"), ("quadid/candidate", "ParameterSet")):
            writer.write(topic, f"quadid_msgs/msg/{kind}", {"sequence": 1}, EPOCH)
    with AnyReader([path]) as reader:
        told = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}  # type: ignore[union-attr]
    latched, plain = told["quad1/quadid/parameters"], told["quadid/candidate"]
    assert (latched.durability, latched.depth) == (QosDurability.TRANSIENT_LOCAL, 1)
    assert (plain.durability, plain.depth) == (QosDurability.VOLATILE, 10)
    assert latched.reliability == plain.reliability == QosReliability.RELIABLE


RECORDED = """- history: 3
  depth: 0
  reliability: 1
  durability: 2
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""
"""What `ros2 bag record` wrote of /parameter_events: a bag of rosbag2's own tests (topics_and_services.mcap)."""


def test_the_qos_of_a_topic_has_the_form_of_a_real_bag() -> None:
    (real,), (ours,) = yaml.safe_load(RECORDED), yaml.safe_load(offered_qos("quadid/candidate"))
    assert list(ours) == list(real)
    assert {**ours, "history": 3, "depth": 0} == real, "a recorder does not know how much a publisher keeps"
