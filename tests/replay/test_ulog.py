"""PX4 ULog: topics and units, motors, stamps, truncation that pyulog does not report, and formats made to explode."""

import struct
from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog
from quadid_replay import open_log
from quadid_replay.motors import RPM
from quadid_replay.ulog import unversioned

from quadid.errors import LogError
from tests.faults.evidence import Happened


class Ulog:
    """Writes a ULog record by record."""

    def __init__(self) -> None:
        self.data = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))
        self.ids: dict[str, int] = {}

    def record(self, kind: str, body: bytes) -> None:
        self.data += struct.pack("<HB", len(body), ord(kind)) + body

    def format(self, name: str, fields: str) -> None:
        self.record("F", f"{name}:{fields}".encode())

    def parameter(self, name: str, value: float) -> None:
        key = f"float {name}".encode()
        self.record("P", bytes([len(key)]) + key + struct.pack("<f", value))

    def subscribe(self, name: str) -> None:
        self.ids[name] = len(self.ids)
        self.record("A", struct.pack("<BH", 0, self.ids[name]) + name.encode())

    def add(self, name: str, form: str, *values: float) -> None:
        self.record("D", struct.pack("<H", self.ids[name]) + struct.pack("<" + form, *values))


def flight(parameters: dict[str, float] | None = None, count: int = 400) -> Ulog:
    log = Ulog()
    log.format(
        "sensor_combined",
        "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;int32_t accelerometer_timestamp_relative;"
        "float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;",
    )
    log.format("actuator_motors", "uint64_t timestamp;uint64_t timestamp_sample;float[12] control;")
    log.format("esc_report", "uint64_t timestamp;int32_t esc_rpm;uint8_t actuator_function;")
    log.format("esc_status", "uint64_t timestamp;uint8_t esc_count;esc_report[8] esc;")
    for name, value in (parameters or {}).items():
        log.parameter(name, value)
    for name in ("sensor_combined", "actuator_motors", "esc_status"):
        log.subscribe(name)
    nan = float("nan")
    for k in range(count):
        us = 5_000_000 + 5000 * k
        log.add("sensor_combined", "Q3fIi3fI", us, 0.1, 0.2, 0.3, 4000, 500, 0.0, 0.0, -9.8, 4000)
        log.add("actuator_motors", "QQ12f", us, us - 300, 0.5, 0.6, 0.7, 0.8, *[nan] * 8)
        escs = [x for i in range(8) for x in ((us, -(6000 + i), 104 - i) if i < 4 else (0, 0, 0))]
        log.add("esc_status", "QB" + "QiB" * 8, us, 4, *escs)
    return log


def opened(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "flight.csv"
    path.write_bytes(data)
    return path


def test_channels_units_and_the_middle_of_the_interval(tmp_path: Path) -> None:
    channels = open_log(opened(tmp_path, bytes(flight().data))).channels
    np.testing.assert_allclose(channels["gyro"].values[0], [0.1, 0.2, 0.3], rtol=1e-6)
    assert channels["gyro"].t[0] == pytest.approx(5.0 - 0.002)
    assert channels["accel"].t[0] == pytest.approx(5.0 + 0.0005 - 0.002)
    np.testing.assert_allclose(channels["motor_command"].values[0], [0.5, 0.6, 0.7, 0.8], rtol=1e-6)
    assert channels["motor_command"].t[0] == pytest.approx(5.0)
    # ESC 4 drives motor 1 here, and a reverse-turning motor counts as turning
    np.testing.assert_allclose(channels["rotor_speed"].values[0], RPM * np.array([6003, 6002, 6001, 6000]))


def test_relative_thrust_becomes_the_signal_to_the_esc(tmp_path: Path) -> None:
    factor, signal = 0.3, 0.5
    thrust = factor * signal**2 + (1 - factor) * signal
    log = flight({"THR_MDL_FAC": factor})
    for k in range(5):
        log.add("actuator_motors", "QQ12f", 9_000_000 + k * 5000, 0, *[thrust] * 4, *[float("nan")] * 8)
    command = open_log(opened(tmp_path, bytes(log.data))).channels["motor_command"]
    np.testing.assert_allclose(command.values[-1], signal, rtol=1e-6)
    assert "THR_MDL_FAC" in command.source


def test_values_are_those_of_pyulog(data_dir: Path) -> None:
    path = data_dir / "px4" / "ascend_cubeorange_test.ulg"
    recording = open_log(path)
    data = {d.name: d.data for d in ULog(str(path)).data_list if d.multi_id == 0}
    np.testing.assert_array_equal(
        recording.channels["velocity"].values[:, 0], data["vehicle_local_position"]["vx"].astype(np.float64)
    )
    np.testing.assert_array_equal(
        recording.channels["gyro"].values[:, 2], data["sensor_combined"]["gyro_rad[2]"].astype(np.float64)
    )
    assert recording.channels["motor_command"].values.shape == (1422, 4), (
        "of the setpoints, not of the 330 rows of motors"
    )


def test_a_wild_stamp_moves_nothing(tmp_path: Path, happened: Happened) -> None:
    log = flight()
    log.add("sensor_combined", "Q3fIi3fI", 10**15, 0.1, 0.2, 0.3, 4000, 500, 0.0, 0.0, -9.8, 4000)
    for k in range(10):
        log.add("sensor_combined", "Q3fIi3fI", 7_000_000 + k * 5000, 0.1, 0.2, 0.3, 4000, 500, 0.0, 0.0, -9.8, 4000)
    recording = open_log(opened(tmp_path, bytes(log.data)))
    assert len(recording.channels["gyro"].t) == 410
    assert recording.channels["gyro"].t[-1] < 8.0
    assert any("gyro: dropped samples: 1 with a wild stamp" in w for w in recording.warnings)
    happened(7, "ULog with one wild stamp: refused, no other sample moved")


def test_a_cut_file_is_told_although_pyulog_says_nothing(tmp_path: Path, happened: Happened) -> None:
    data = bytes(flight().data)
    path = opened(tmp_path, data[: len(data) // 2 + 1])
    assert not ULog(str(path)).file_corruption
    recording = open_log(path)
    assert any("cut" in w for w in recording.warnings)
    assert len(recording.channels["gyro"].t) == pytest.approx(200, abs=15)
    happened(4, "ULog cut where pyulog reports no corruption: told by our own walk through the records")


def test_damage_in_the_middle_is_counted(tmp_path: Path) -> None:
    data = bytearray(flight().data)
    data[20000:20200] = bytes(200)
    recording = open_log(opened(tmp_path, bytes(data)))
    assert any("damaged" in w for w in recording.warnings)


def test_a_header_alone_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="header and nothing else"):
        open_log(opened(tmp_path, bytes(Ulog().data)))


def test_records_are_found_again_without_a_sync_mark(tmp_path: Path) -> None:
    data = bytearray(flight().data)
    del data[15000:15007]
    recording = open_log(opened(tmp_path, bytes(data)))
    assert len(recording.channels["gyro"].t) >= 397


def test_definitions_that_run_past_the_end_do_not_loop(tmp_path: Path) -> None:
    """pyulog 1.3 seeks back further than it read and never ends."""
    log = flight(count=0)
    head = bytes(log.data[: log.data.find(b"A\x00") - 2])
    with pytest.raises(LogError):
        open_log(opened(tmp_path, head + struct.pack("<HB", 60000, ord("Z")) + bytes(100)))


def test_data_appended_after_a_crash_is_read(tmp_path: Path) -> None:
    log = flight()
    body = bytes(log.data)
    flags = struct.pack("<8s8s3Q", bytes(8), b"\x01" + bytes(7), len(body) + 43 - 20, 0, 0)
    tail = Ulog()
    tail.ids = log.ids
    tail.add("sensor_combined", "Q3fIi3fI", 7_100_000, 0.1, 0.2, 0.3, 4000, 500, 0.0, 0.0, -9.8, 4000)
    data = body[:16] + struct.pack("<HB", 40, ord("B")) + flags + body[16:-20] + bytes(tail.data[16:])
    recording = open_log(opened(tmp_path, data))
    assert recording.channels["gyro"].t[-1] == pytest.approx(7.098)
    assert recording.warnings == ()
    future = bytearray(data)
    future[19 + 9] = 1
    with pytest.raises(LogError, match="flags that this version cannot read"):
        open_log(opened(tmp_path, bytes(future)))


@pytest.mark.parametrize("name", ["vehicle_attitude_v1", "vehicle_attitude_v12"])
def test_versions_behind_a_topic_make_no_difference(name: str) -> None:
    assert unversioned(name) == "vehicle_attitude"
    assert unversioned("actuator_motors") == "actuator_motors"
