"""A short campaign over each reader, and what fuzzing has found, each as the smallest log that shows it."""

import sqlite3
import warnings
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from quadid_replay import open_log
from quadid_replay.columns import from_euler, to_euler
from quadid_replay.motors import motor_outputs, px4_motor_outputs, px4_rotor_count
from quadid_replay.schemas import schema_text

from quadid.data.rotor_signal import rotor_signal
from quadid.errors import LogError
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.fuzz import campaign, rosbag2_format
from tests.fuzz.formats import FORMATS
from tests.fuzz.seeds import mcap_of, seeds
from tests.replay.test_dataflash import Dataflash, add_flight, flight
from tests.replay.test_mcap import header
from tests.replay.test_tlog import MAV, Tlog, attitude, heartbeat, raw_imu, servo
from tests.replay.test_ulog import flight as ulog_flight

# --- A short campaign over each reader, and the guards themselves


COUNT = 400
FROM = 10**9
"""Numbers that `make fuzz` does not reach: these inputs are others than those of the page."""
ROW = {"mcap": 1, "rosbag2": 1, "tlog": 3, "dataflash": 3, "ulog": 4, "usdlog": 4, "blackbox": 4}


@pytest.mark.parametrize("kind", FORMATS)
def test_mutated_logs_are_read_or_refused_in_one_line(kind: str, happened: Happened) -> None:
    outcome = campaign.run(kind, FROM, COUNT)
    assert outcome.findings == ()
    assert outcome.read > 0.1 * COUNT
    assert outcome.refused > 0.05 * COUNT
    happened(
        ROW[kind],
        f"{COUNT} {kind} logs mutated in records, lengths and checksums: {outcome.read} read, {outcome.refused} "
        f"refused with a reason, {outcome.stopped} stopped by the guard of time or memory, nothing else",
    )


@pytest.mark.parametrize("kind", FORMATS)
def test_seeds_are_whole_logs_whose_records_are_known(kind: str) -> None:
    form = FORMATS[kind]
    for seed in seeds(kind):
        records = form.split(seed)
        assert b"".join(records) == seed
        assert any(form.define(Random(n), record) != record for n in range(20) for record in records)
    assert campaign.input_of(kind, 7) == campaign.input_of(kind, 7)
    assert len({campaign.input_of(kind, n) for n in range(50)}) > 40


# --- What fuzzing has found, each as the smallest log that shows it


def opened(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "log"
    path.write_bytes(data)
    return path


def test_a_message_whose_list_of_numbers_is_empty_is_no_sample(tmp_path: Path) -> None:
    kind = "quadid_msgs/msg/MotorCommand"
    empty = mcap_of([("motor_command", kind, schema_text(kind), lambda ns: {"header": header(ns), "values": []})], True)
    with pytest.raises(LogError, match="no usable flight data.*4 messages could not be decoded"):
        open_log(opened(tmp_path, empty))


def test_esc_records_without_a_stamp_are_not_used(tmp_path: Path) -> None:
    log = Dataflash()
    log.describe(2, "IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.describe(3, "ESC", "QBf", "TimeXS,Instance,RPM")
    for k in range(10):
        log.add("IMU", 1_000_000 + 20_000 * k, 0, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8)
        log.add("ESC", 1_000_000 + 20_000 * k, 0, 6000.0)
    assert set(open_log(opened(tmp_path, bytes(log.data))).channels) == {"gyro", "accel"}


def test_parameters_that_are_no_numbers_tell_nothing() -> None:
    damaged = {"SERVO1_FUNCTION": float("nan"), "PWM_MAIN_FUNC1": float("inf"), "MAV_TYPE": float("-inf")}
    assert motor_outputs(damaged, 0, 16, "RCOU") == ([], "", False)
    assert px4_motor_outputs(damaged, "PWM_MAIN") == []
    assert px4_rotor_count(damaged) == 0
    for count in (-3.0, 0.5, 1e9, 2.0**100, float("nan")):
        assert px4_rotor_count({"CA_ROTOR_COUNT": count, "MAV_TYPE": 13.0}) == 6


def test_attitudes_that_are_no_numbers_pass_without_a_warning() -> None:
    bad = np.array([[np.inf, np.nan, 0.0, 1e300], [1e200, 1e200, 1e200, 1e200]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not np.isfinite(to_euler(bad)[0]).all()
        assert not np.isfinite(from_euler(bad[:1, :3])).all()


def test_a_log_of_a_second_imu_only_has_no_gyro(tmp_path: Path) -> None:
    log = Dataflash()
    log.describe(2, "GYR", "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ")
    log.describe(4, "ATT", "Qcccccc", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw")
    for k in range(100):
        log.add("GYR", 10_000 * k, 1, 10_000 * k, 0.1, 0.2, 0.3)
        log.add("ATT", 10_000 * k, 100, 1000, -100, -500, 9000, 27000)
    assert "gyro" not in open_log(opened(tmp_path, bytes(log.data))).channels


def test_a_database_whose_schema_is_no_text_is_refused(tmp_path: Path) -> None:
    data = rosbag2_format.finish(rosbag2_format.row("topics", 1, "imu", "sensor_msgs/msg/Imu", "cdr", ""))
    damaged = data.replace(b"CREATE TABLE messages", b"CREATE TABLE\xff\xe5essages")
    with pytest.raises(LogError, match="damaged SQLite database"):
        open_log(opened(tmp_path, damaged))


def test_a_topic_without_a_number_is_passed_over(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "log") as bag:
        bag.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        bag.execute("CREATE TABLE messages (id, topic_id, timestamp, data)")
        bag.execute("INSERT INTO topics VALUES (NULL, 'imu', 'sensor_msgs/msg/Imu', 'cdr')")
    with pytest.raises(LogError, match="no topic to read"):
        open_log(tmp_path / "log")


@pytest.mark.parametrize("index", [12, 13, 255])
def test_speeds_of_escs_that_no_vehicle_has_are_left_out(tmp_path: Path, index: int, happened: Happened) -> None:
    log, zeros = Tlog(), [0.0] * 4
    log.add(0.0, heartbeat())
    for k in range(6):
        for place in (0, index):
            speeds = MAV.MAVLink_esc_status_message(place, 1_000_000 + 20_000 * k, [6000] * 4, zeros, zeros)
            log.add(0.02 * k, speeds)
    assert open_log(opened(tmp_path, bytes(log.data))).channels["rotor_speed"].values.shape == (6, 4)
    happened(3, f"telemetry log with ESC_STATUS from rotor {index}: the first four are read, no others")


def test_a_database_whose_rows_claim_more_than_memory_is_damaged(tmp_path: Path, happened: Happened) -> None:
    """SQLite tells this one as a lack of memory."""
    with pytest.raises(LogError, match="damaged SQLite database") as told:
        open_log(opened(tmp_path, campaign.input_of("rosbag2", 229_688)))
    happened(1, f"rosbag2 whose pages claim sizes that cannot be: '{str(told.value)[:80]}'")


def test_a_motor_beyond_the_outputs_of_a_telemetry_log_is_named(tmp_path: Path, happened: Happened) -> None:
    log = Tlog()
    log.add(0.0, heartbeat())
    for motor, output in enumerate((1, 2, 3, 17)):
        log.add(0.0, function(output, 33 + motor))
    for k in range(50):
        log.add(0.02 * k, raw_imu(10.0 + 0.02 * k))
        log.add(0.02 * k, servo(10.0 + 0.02 * k))
    recording = open_log(opened(tmp_path, bytes(log.data)))
    assert set(recording.channels) == {"gyro", "accel"}
    (said,) = (w for w in recording.warnings if "motor 4 on output 17" in w)
    assert "SERVO_OUTPUT_RAW holds outputs 1 to 16" in said
    happened(31, f"telemetry log with a motor on output 17: '{said[:90]}'")


def test_a_motor_beyond_the_outputs_of_a_dataflash_log_is_named(tmp_path: Path) -> None:
    """Before, the other three were taken for all motors."""
    recording = open_log(opened(tmp_path, bytes(flight(motors=(0, 1, 2, 16)).data)))
    assert "motor_command" not in recording.channels
    assert any("motor 4 on output 17" in w and "RCOU holds outputs 1 to 6" in w for w in recording.warnings)
    without = replace(recording, channels={n: c for n, c in recording.channels.items() if n != "rotor_speed"})
    with pytest.raises(LogError, match="no motor commands.*motor 4 on output 17"):
        rotor_signal(without, Vehicle.shipped("pelican"))


def test_more_escs_than_a_vehicle_has_do_not_say_how_many_motors_there_are(tmp_path: Path) -> None:
    log = Tlog()
    log.add(0.0, heartbeat())
    log.add(0.0, MAV.MAVLink_esc_info_message(0, 0, 0, 255, 0, 0, [0] * 4, [0] * 4, [0] * 4))
    for k in range(50):
        log.add(0.02 * k, servo(10.0 + 0.02 * k))
    assert open_log(opened(tmp_path, bytes(log.data))).channels["motor_command"].values.shape == (50, 4)


@pytest.mark.parametrize("kind", ["tlog", "dataflash"])
@pytest.mark.parametrize("changed", [False, True])
def test_a_motor_order_that_changes_within_a_log_is_said(
    tmp_path: Path, kind: str, changed: bool, happened: Happened
) -> None:
    again = (34, 33) if changed else (33, 34)
    if kind == "dataflash":
        log = flight(motors=(0, 1, 2, 3))
        for output, value in enumerate(again, 1):
            log.add("PARM", 0, f"SERVO{output}_FUNCTION".encode(), float(value))
        add_flight(log, 1.0, 14.0)
        data = bytes(log.data)
    else:
        heard = Tlog()
        heard.add(0.0, heartbeat())
        for k, value in enumerate((33, 34, 35, 36, *again)):
            heard.add(0.02 * k, servo(10.0 + 0.02 * k))
            heard.add(0.02 * k, function(1 + k % 4, value))
        data = bytes(heard.data)
    said = [w for w in open_log(opened(tmp_path, data)).warnings if "motor order" in w]
    assert len(said) == changed
    if said:
        assert "SERVO1_FUNCTION (33, then 34), SERVO2_FUNCTION (34, then 33)" in said[0]
        happened(31, f"{kind} in which two motors change their outputs: '{said[0][:100]}'")


def test_a_ulog_message_described_anew_with_millions_of_numbers_ends_what_is_read(
    tmp_path: Path, happened: Happened
) -> None:
    """Fuzzing: the last description was counted, and the library took the first, of two million numbers."""
    log = ulog_flight()
    log.format("esc_report", "uint64_t timestamp;int32_t esc_rpm;")
    for _ in range(10):
        log.add("sensor_combined", "Q3fIi3fI", 9_000_000, *[0.0] * 3, 5000, 0, *[0.0] * 3, 5000)
    recording = open_log(opened(tmp_path, bytes(log.data)))
    assert any("esc_report redefined" in w for w in recording.warnings)
    assert len(recording.channels["gyro"].t) == 400
    happened(31, "a ULog message described anew: read up to there, and said")


def test_stamps_beyond_what_a_header_holds_are_no_sample(tmp_path: Path) -> None:
    """Fuzzing: a description whose seconds have 64 bits."""
    recording = open_log(opened(tmp_path, campaign.input_of("mcap", 968_079)))
    assert any("could not be decoded" in w for w in recording.warnings)


def test_senders_without_end_take_no_more_than_their_bytes(tmp_path: Path, happened: Happened) -> None:
    """2.6 MB took 20 s, and the error named 60,000 vehicles in one line."""
    data = bytearray()
    for k in range(20_000):
        log = Tlog(1 + k % 255)
        log.mav.srcComponent = k // 255
        log.add(0.001 * k, attitude(0.001 * k))
        data += log.data
    with pytest.raises(LogError, match="also in the log.* and 23 more") as told:
        open_log(opened(tmp_path, bytes(data)))
    assert len(str(told.value)) < 2000
    real = Tlog(7)
    real.add(0.0, heartbeat())
    for k in range(50):
        real.add(0.02 * k, attitude(10.0 + 0.02 * k))
    assert len(open_log(opened(tmp_path, bytes(data + real.data))).channels["attitude"].t) >= 50
    happened(5, f"telemetry log of 20,000 senders in {len(data) >> 10} kB: refused in one line")


def function(output: int, value: int) -> Any:
    """ArduPilot's parameter for an output's function."""
    return MAV.MAVLink_param_value_message(f"SERVO{output}_FUNCTION".encode(), float(value), 9, 900, output)
