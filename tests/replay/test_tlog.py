"""Telemetry logs: our ESC messages against mavgen, wraps, reboots, several vehicles, receive time, damage."""

import importlib.util
import struct
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import quadid_replay
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.generator import mavgen
from quadid_replay import open_log
from quadid_replay.columns import GRAVITY
from quadid_replay.mavlink_messages import ESC_INFO, ESC_STATUS, extend_dialect
from quadid_replay.motors import RPM
from quadid_replay.tlog import _rounds

from quadid.data.grid import grid_recording
from quadid.errors import LogError
from quadid.vehicle import Vehicle

MAV = extend_dialect(ardupilotmega)
UNIX = 1_700_000_000_000_000


class Tlog:
    """Writes frames with their receive time."""

    def __init__(self, system: int = 1) -> None:
        self.data = bytearray()
        self.mav = MAV.MAVLink(None, srcSystem=system, srcComponent=1)

    def add(self, received: float, message: Any, force_v1: bool = False) -> None:
        self.data += struct.pack(">Q", UNIX + round(received * 1e6)) + message.pack(self.mav, force_mavlink1=force_v1)
        self.mav.seq = (self.mav.seq + 1) % 256


def heartbeat(kind: int = 2, autopilot: int = 3) -> Any:
    return MAV.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


def raw_imu(seconds: float) -> Any:
    return MAV.MAVLink_raw_imu_message(round(seconds * 1e6), 0, 0, -1000, 100, 200, 300, 0, 0, 0)


def servo(seconds: float) -> Any:
    return MAV.MAVLink_servo_output_raw_message(
        round(seconds * 1e6) % 2**32, 0, 1100, 1200, 1300, 1400, 0, 0, 0, 0, *[0] * 8
    )


def attitude(seconds: float) -> Any:
    return MAV.MAVLink_attitude_message(round(seconds * 1e3), 0.1, 0.2, 0.3, 0.01, 0.02, 0.03)


def opened(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "flight.bin"
    path.write_bytes(data)
    return path


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    """The dialect that mavgen makes of our XML."""
    folder = tmp_path_factory.mktemp("mavgen")
    xml = Path(quadid_replay.__file__).parent / "dialects" / "quadid.xml"
    options = mavgen.Opts(str(folder / "generated_quadid"), wire_protocol="2.0", language="Python3", validate=False)
    assert mavgen.mavgen(options, [str(xml)])
    spec = importlib.util.spec_from_file_location("generated_quadid", folder / "generated_quadid.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("number", [ESC_INFO, ESC_STATUS])
def test_our_messages_are_those_of_mavgen(generated: ModuleType, number: int) -> None:
    ours, theirs = MAV.mavlink_map[number], generated.mavlink_map[number]
    for name in ("fieldnames", "ordered_fieldnames", "orders", "lengths", "array_lengths", "crc_extra", "fieldtypes"):
        assert getattr(ours, name) == getattr(theirs, name), name
    assert (ours.unpacker.format, ours.instance_offset) == (theirs.unpacker.format, theirs.instance_offset)
    values: list[Any] = [4, 123456789]
    if number == ESC_INFO:
        values += [7, 4, 1, 15, [1, 2, 3, 4], [5, 6, 7, 8], [-9, 10, -11, 12]]
    else:
        values += [[-6000, 1, 2, 3], [1.5, 2.5, 3.5, 4.5], [0.0, 1.0, 2.0, 3.0]]
    frames = [m.mavlink_map[number](*values).pack(m.MAVLink(None, 1, 1)) for m in (MAV, generated)]
    assert frames[0] == frames[1]
    assert generated.MAVLink(None).decode(bytearray(frames[0])).to_dict()
    assert MAV.MAVLink(None).decode(bytearray(frames[1])).index == 4


@pytest.mark.parametrize("old_frames", [False, True])
def test_units_of_an_ardupilot_log(tmp_path: Path, old_frames: bool) -> None:
    log = Tlog()
    for k in range(100):
        t = 5.0 + 0.02 * k
        for message in (heartbeat(), raw_imu(t), attitude(t), servo(t)):
            log.add(t, message, old_frames)
    channels = open_log(opened(tmp_path, bytes(log.data))).channels
    np.testing.assert_allclose(channels["gyro"].values[0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(channels["accel"].values[0], [0.0, 0.0, -GRAVITY])
    np.testing.assert_array_equal(channels["motor_command"].values[0], [1100, 1200, 1300, 1400])
    assert channels["gyro"].source.startswith("RAW_IMU")
    assert channels["gyro"].t[0] == pytest.approx(5.0)


def test_raw_imu_of_others_counts_in_unknown_units(tmp_path: Path) -> None:
    log = Tlog()
    for k in range(50):
        log.add(0.02 * k, heartbeat(autopilot=12))
        log.add(0.02 * k, raw_imu(1.0 + 0.02 * k))
        log.add(0.02 * k, attitude(1.0 + 0.02 * k))
    channels = open_log(opened(tmp_path, bytes(log.data))).channels
    assert "accel" not in channels
    assert "filtered" in channels["gyro"].source


def test_the_32_bit_clock_of_servo_output_wraps_unnoticed(tmp_path: Path) -> None:
    log, start = Tlog(), 2**32 * 1e-6 - 1.0
    log.add(0.0, heartbeat())
    for k in range(150):
        t = start + 0.02 * k
        log.add(t - start, attitude(t))
        log.add(t - start, servo(t))
    recording = open_log(opened(tmp_path, bytes(log.data)))
    assert recording.breaks == ()
    motors = recording.channels["motor_command"]
    assert len(motors.t) == 150
    np.testing.assert_allclose(np.diff(motors.t), 0.02, atol=1e-5)
    assert motors.t[0] == pytest.approx(start, abs=1e-3)


def test_a_reboot_is_a_break(tmp_path: Path) -> None:
    log = Tlog()
    log.add(0.0, heartbeat())
    for boot, received in ((100.0, 0.0), (3.0, 20.0)):
        for k in range(100):
            log.add(received + 0.02 * k, raw_imu(boot + 0.02 * k))
            log.add(received + 0.02 * k, attitude(boot + 0.02 * k))
    recording = open_log(opened(tmp_path, bytes(log.data)))
    assert len(recording.breaks) == 1
    assert all(np.all(np.diff(c.t) > 0) for c in recording.channels.values())


def test_messages_without_a_stamp_are_put_on_the_boot_clock(tmp_path: Path) -> None:
    log = Tlog()
    log.add(0.0, heartbeat())
    for k in range(100):
        t = 50.0 + 0.02 * k
        log.add(0.02 * k + 0.003, attitude(t))
        rpm = [1000 + k, 2000, 3000, 4000]
        log.add(
            0.02 * k + 0.004, MAV.MAVLink_esc_telemetry_1_to_4_message([0] * 4, [0] * 4, [0] * 4, [0] * 4, rpm, [0] * 4)
        )
    speed = open_log(opened(tmp_path, bytes(log.data))).channels["rotor_speed"]
    np.testing.assert_allclose(speed.values[7], RPM * np.array([1007, 2000, 3000, 4000]))
    np.testing.assert_allclose(speed.t, 50.0 + 0.001 + 0.02 * np.arange(100), atol=2e-6)


def test_unix_stamps_are_put_on_the_boot_clock(tmp_path: Path) -> None:
    log = Tlog()
    log.add(0.0, heartbeat(autopilot=12))
    log.add(0.0, MAV.MAVLink_system_time_message(UNIX, 7000))
    for k in range(60):
        log.add(0.02 * k, attitude(7.0 + 0.02 * k))
        log.add(0.02 * k, MAV.MAVLink_highres_imu_message(UNIX + 20000 * k, 0, 0, -9.8, 0.1, 0.2, 0.3, *[0] * 7, 63))
    gyro = open_log(opened(tmp_path, bytes(log.data))).channels["gyro"]
    assert gyro.source == "HIGHRES_IMU"
    assert gyro.t[0] == pytest.approx(7.0, abs=1e-3)


def test_eight_rotors_in_two_messages_a_round(tmp_path: Path) -> None:
    log, zeros = Tlog(), [0.0] * 4
    log.add(0.0, heartbeat(kind=14))
    for k in range(60):
        us = 1_000_000 + 20000 * k
        log.add(0.02 * k, attitude(us * 1e-6))
        if k != 30:
            log.add(0.02 * k, MAV.MAVLink_esc_status_message(0, us, [k, 1, 2, 3], zeros, zeros))
        if k != 40:
            log.add(0.02 * k, MAV.MAVLink_esc_status_message(4, us, [4, 5, 6, 7], zeros, zeros))
    speed = open_log(opened(tmp_path, bytes(log.data))).channels["rotor_speed"]
    assert speed.values.shape == (58, 8)  # incomplete rounds are no rows
    np.testing.assert_allclose(speed.values[-1], RPM * np.array([59, 1, 2, 3, 4, 5, 6, 7]))


@pytest.mark.parametrize(("first", "esc"), [(1, 1), (5, 5), (9, 9), (9, 1), (29, 29)])
def test_rotor_speeds_go_with_the_outputs_of_their_motors(tmp_path: Path, first: int, esc: int) -> None:
    """Motors 4 1 2 3 on four outputs; ESCs are counted by output, or up to ArduPilot 4.4 from the first of them."""
    log, motors = Tlog(), (4, 1, 2, 3)
    log.add(0.0, heartbeat())
    for k, motor in enumerate(motors):
        name = f"SERVO{first + k}_FUNCTION".encode()
        log.add(0.0, MAV.MAVLink_param_value_message(name, 32.0 + motor, 9, 900, first + k))
    pulses = [1000 + 100 * motors[n - first] if 0 <= n - first < 4 else 0 for n in range(1, 33)]
    for k in range(60):
        us, none = 1_000_000 + 20000 * k, [0] * 4
        log.add(0.02 * k, attitude(us * 1e-6))
        for port in range(2):
            log.add(0.02 * k, MAV.MAVLink_servo_output_raw_message(us, port, *pulses[16 * port : 16 * port + 16]))
        for group in (1, 5, 9, 29):
            made = getattr(MAV, f"MAVLink_esc_telemetry_{group}_to_{group + 3}_message")
            speeds = [1000 * motor + k for motor in motors] if group == esc else none
            log.add(0.02 * k + 0.001, made(none, none, none, none, speeds, none))
    recording = open_log(opened(tmp_path, bytes(log.data)))
    np.testing.assert_allclose(recording.channels["rotor_speed"].values[-1] / RPM, [1059, 2059, 3059, 4059])
    np.testing.assert_array_equal(recording.channels["motor_command"].values[-1], [1100, 1200, 1300, 1400])


def test_of_several_vehicles_the_one_that_tells_most(tmp_path: Path) -> None:
    one, two = Tlog(1), Tlog(2)
    for k in range(50):
        for log, share in ((one, 1), (two, 5)):
            if k % share == 0:
                log.add(0.02 * k, heartbeat())
                log.add(0.02 * k, raw_imu(5.0 + 0.02 * k))
    recording = open_log(opened(tmp_path, bytes(one.data + two.data)))
    assert len(recording.channels["gyro"].t) == 50
    assert any("also in the log: 2/1" in w for w in recording.warnings)


def test_an_aeroplane_has_no_motors_of_ours(data_dir: Path) -> None:
    recording = open_log(data_dir / "tlog" / "copter_flight.tlog")
    assert "motor_command" not in recording.channels
    assert any("no multirotor" in w for w in recording.warnings)


def test_damage_is_skipped_and_counted(tmp_path: Path) -> None:
    log = Tlog()
    log.add(0.0, heartbeat())
    for k in range(200):
        log.add(0.02 * k, raw_imu(5.0 + 0.02 * k))
    data = bytearray(log.data)
    data[3000:3100] = bytes(100)
    data[6010] ^= 0xFF
    recording = open_log(opened(tmp_path, bytes(data[:-3])))
    assert 190 <= len(recording.channels["gyro"].t) < 199
    text = " ".join(recording.warnings)
    assert "damaged" in text
    assert "cut" in text


def test_frames_without_measurements_are_no_flight(tmp_path: Path) -> None:
    log = Tlog()
    for k in range(10):
        log.add(float(k), heartbeat())
    with pytest.raises(LogError, match="no measurements"):
        open_log(opened(tmp_path, bytes(log.data)))


def test_esc_telemetry_without_a_stamp_stays_in_time_though_the_clocks_drift(tmp_path: Path) -> None:
    log = Tlog()
    log.add(0.0, heartbeat())
    for k in range(5000):
        t, received = 5.0 + 0.02 * k, (1.0 + 5e-4) * 0.02 * k
        log.add(received, attitude(t))
        log.add(received, servo(t))
        log.add(received, MAV.MAVLink_esc_telemetry_1_to_4_message([0] * 4, *[[k] * 4] * 5))
    recording = open_log(opened(tmp_path, bytes(log.data)))
    speeds = recording.channels["rotor_speed"]
    np.testing.assert_allclose(speeds.t, 5.0 + 0.02 * np.round(speeds.values[:, 0] / RPM), atol=1e-3)


def vehicle(path: Path) -> Vehicle:
    return Vehicle.from_yaml(path.read_text(encoding="utf-8"))


def test_speeds_that_are_all_zero_do_not_hide_the_outputs(data_dir: Path) -> None:
    folder = data_dir / "ardupilot_sitl"
    recording = open_log(folder / "x_zero_rpm.tlog")
    gridded = grid_recording(recording, vehicle(folder / "sitl_x_pwm.yaml"))
    assert gridded.report.rotor_source.startswith("SERVO_OUTPUT_RAW")
    assert any("all zero" in note for note in gridded.report.notes)
    with pytest.raises(LogError, match=r"are all zero: the motors are off, or the ESCs do not report"):
        grid_recording(recording, vehicle(folder / "sitl_x.yaml"))


def test_a_vehicle_of_pulse_widths_uses_them_beside_measured_speeds(data_dir: Path) -> None:
    folder = data_dir / "ardupilot_sitl"
    gridded = grid_recording(open_log(folder / "quad_sq.tlog"), vehicle(folder / "quad_sq_pwm.yaml"))
    assert gridded.report.rotor_source.startswith("SERVO_OUTPUT_RAW")
    assert gridded.windows[0].sampling == "held" or gridded.report.filtered


def test_messages_of_a_round_make_a_row() -> None:
    t = np.arange(7.0)
    places = np.array([0, 4, 0, 12, 4, 2, 10])
    values = np.arange(28.0).reshape(7, 4)
    times, rows = _rounds(t, places, values, 12)
    np.testing.assert_array_equal(times, [0.0, 2.0, 5.0])
    nan = [np.nan] * 4
    np.testing.assert_array_equal(rows[0], [0, 1, 2, 3, 4, 5, 6, 7, *nan])
    np.testing.assert_array_equal(rows[1], [8, 9, 10, 11, 16, 17, 18, 19, *nan])
    np.testing.assert_array_equal(rows[2], [np.nan, np.nan, 20, 21, 22, 23, *nan, 24, 25])
