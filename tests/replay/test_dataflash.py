"""ArduPilot DataFlash: values as pymavlink reads them, motors, ESC telemetry, reboots, damage."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import DFReader
from quadid_replay import open_log
from quadid_replay.columns import from_euler
from quadid_replay.dataflash import index_dataflash
from quadid_replay.motors import RPM, Outputs, active_outputs, frame_rotors, merge_instances, motor_outputs

from tests.faults.evidence import Happened

CODES = {"Q": "Q", "f": "f", "B": "B", "H": "H", "c": "h", "N": "16s", "Z": "64s", "I": "I"}


class Dataflash:
    """Writes a log byte by byte."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.layouts: dict[str, tuple[int, str]] = {}
        self.describe(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89)

    def describe(self, kind: int, name: str, form: str, columns: str, length: int | None = None) -> None:
        size = length or 3 + struct.calcsize("<" + "".join(CODES[c] for c in form))
        self.layouts[name] = (kind, form)
        body = struct.pack("<BB4s16s64s", kind, size, name.encode(), form.encode(), columns.encode())
        self.data += b"\xa3\x95\x80" + body

    def add(self, name: str, *values: float | bytes) -> None:
        kind, form = self.layouts[name]
        self.data += b"\xa3\x95" + bytes([kind]) + struct.pack("<" + "".join(CODES[c] for c in form), *values)


def flight(
    seconds: float = 4.0, start: float = 10.0, motors: tuple[int, ...] = (3, 0, 1, 2), escs: int = 0
) -> Dataflash:
    log = Dataflash()
    log.describe(1, "PARM", "QNf", "TimeUS,Name,Value")
    log.describe(2, "IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.describe(3, "RCOU", "QHHHHHH", "TimeUS,C1,C2,C3,C4,C5,C6")
    log.describe(4, "ATT", "Qcccccc", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw")
    log.describe(5, "CTUN", "Qf", "TimeUS,ThO")
    log.describe(6, "ESC", "QBf", "TimeUS,Instance,RPM")
    for number, output in enumerate(motors):
        log.add("PARM", 0, f"SERVO{output + 1}_FUNCTION".encode(), 33.0 + number)
    add_flight(log, seconds, start, escs)
    return log


def add_flight(log: Dataflash, seconds: float, start: float, escs: int = 0) -> None:
    for k in range(round(seconds * 100)):
        us = round((start + k * 0.01) * 1e6)
        log.add("IMU", us, 0, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8)
        log.add("IMU", us, 1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0)
        log.add("RCOU", us + 100, 1100 + k, 1200 + k, 1300 + k, 1400 + k, 900, 1500)
        if k % 10 == 0:
            log.add("CTUN", us + 150, 0.5)
            log.add("ATT", us + 200, 100, 1000, -100, -500, 9000, 27000)
        log.add("ESC", us + 300, escs + k % 4, 6000.0 + 100.0 * (k % 4))


def opened(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "flight.log"
    path.write_bytes(data)
    return path


def test_channels_units_motor_map_and_instance(tmp_path: Path) -> None:
    recording = open_log(opened(tmp_path, bytes(flight().data)))
    channels = recording.channels
    np.testing.assert_allclose(channels["gyro"].values[0], [0.1, 0.2, 0.3], rtol=1e-6)
    assert channels["gyro"].source == "IMU instance 0"
    assert channels["motor_command"].source == "RCOU C4 C1 C2 C3"
    np.testing.assert_array_equal(channels["motor_command"].values[5], [1405, 1105, 1205, 1305])
    expected = from_euler(np.radians([[10.0, -5.0, 270.0]]))[0]
    assert abs(float(channels["attitude"].values[0] @ expected)) == pytest.approx(1.0)
    np.testing.assert_allclose(
        channels["attitude_reference"].values[0], [np.radians(1), -np.radians(1), np.pi / 2, 0.5], rtol=1e-6
    )
    assert channels["gyro"].t[0] == pytest.approx(10.0)
    assert recording.warnings == ()


def test_esc_telemetry_of_one_motor_at_a_time_becomes_rows(tmp_path: Path) -> None:
    speed = open_log(opened(tmp_path, bytes(flight().data))).channels["rotor_speed"]
    assert speed.values.shape[1] == 4
    np.testing.assert_allclose(speed.values[3], RPM * np.array([6300.0, 6000.0, 6100.0, 6200.0]))
    assert 1.0 / np.median(np.diff(speed.t)) == pytest.approx(25.0, rel=0.01)


@pytest.mark.parametrize(
    ("version", "first", "instances"),
    [
        ("V4.4.4", 9, (0, 1, 2, 3)),
        ("V4.5.7", 9, (8, 9, 10, 11)),
        ("V4.6.0", 17, (16, 17, 18, 19)),
        ("", 5, (0, 1, 2, 3)),
    ],
)
def test_escs_go_with_the_outputs_of_their_motors(
    tmp_path: Path, version: str, first: int, instances: tuple[int, ...]
) -> None:
    """Motors 4 1 2 3 on four outputs from `first` on; up to 4.4 ArduPilot counts ESCs from 0 wherever they are."""
    log = Dataflash()
    log.describe(1, "PARM", "QNf", "TimeUS,Name,Value")
    log.describe(2, "MSG", "QZ", "TimeUS,Message")
    log.describe(3, "ESC", "QBf", "TimeUS,Instance,RPM")
    log.describe(4, "RCOU", "Q" + 14 * "H", "TimeUS," + ",".join(f"C{k}" for k in range(1, 15)))
    log.describe(5, "RCO3", "Q" + 14 * "H", "TimeUS," + ",".join(f"C{k}" for k in range(19, 33)))
    log.describe(6, "RCO2", "QHHHH", "TimeUS,C15,C16,C17,C18")
    log.add("MSG", 1_000_000, f"ArduCopter {version} (abcd)".encode())
    motors = (4, 1, 2, 3)
    for k, motor in enumerate(motors):
        log.add("PARM", 1_000_000, f"SERVO{first + k}_FUNCTION".encode(), 32.0 + motor)
    for row in range(40):
        pulses = {first + k: 1000 + 100 * motor + row for k, motor in enumerate(motors)}
        us = 2_000_000 + 20_000 * row
        for name, outputs in (("RCOU", range(1, 15)), ("RCO2", range(15, 19)), ("RCO3", range(19, 33))):
            log.add(name, us, *(pulses.get(output, 0) for output in outputs))
        for instance in range(20):
            on = dict(zip(instances, motors, strict=True)).get(instance)
            log.add("ESC", us + instance, instance, 1000.0 * on + row if on else 0.0)
    recording = open_log(opened(tmp_path, bytes(log.data)))
    np.testing.assert_array_equal(recording.channels["motor_command"].values[0], [1100, 1200, 1300, 1400])
    np.testing.assert_allclose(recording.channels["rotor_speed"].values[0] / RPM, [1000, 2000, 3000, 4000], atol=1.0)
    assert recording.warnings == ()


def test_escs_of_which_none_is_a_motor_are_named(tmp_path: Path) -> None:
    recording = open_log(opened(tmp_path, bytes(flight(motors=(6, 7, 8, 9), escs=20).data)))
    assert "rotor_speed" not in recording.channels
    assert any("ESC 21, 22, 23, 24 report speeds, but the motors are on" in w for w in recording.warnings)


def test_values_are_those_of_pymavlink(data_dir: Path) -> None:
    path = data_dir / "ardupilot" / "log171.bin"
    reader = DFReader.DFReader_binary(str(path))
    recording = open_log(path)
    gyro, motors, attitude = (recording.channels[n] for n in ("gyro", "motor_command", "attitude"))
    for k in range(0, 300):
        imu = reader.recv_match(type="IMU")
        assert gyro.t[k] == imu.TimeMS * 1e-3
        np.testing.assert_array_equal(gyro.values[k], [imu.GyrX, imu.GyrY, imu.GyrZ])
    reader.rewind()
    for k in range(0, 100):
        out = reader.recv_match(type="RCOU")
        np.testing.assert_array_equal(motors.values[k], [out.Ch1, out.Ch2, out.Ch3, out.Ch4])
    reader.rewind()
    for k in range(0, 50):
        att = reader.recv_match(type="ATT")
        expected = from_euler(np.radians([[att.Roll, att.Pitch, att.Yaw]]))[0]
        assert abs(float(attitude.values[k] @ expected)) == pytest.approx(1.0, abs=1e-12)


def test_two_boots_in_one_log_are_kept_apart(tmp_path: Path, happened: Happened) -> None:
    log = flight()
    add_flight(log, 4.0, 1.0)
    recording = open_log(opened(tmp_path, bytes(log.data)))
    assert len(recording.breaks) == 1
    for channel in recording.channels.values():
        assert np.all(np.diff(channel.t) > 0.0)
    assert recording.channels["gyro"].t[-1] - recording.channels["gyro"].t[0] > 8.0
    happened(7, "two boots in one DataFlash log: kept apart")


def test_a_damaged_stretch_costs_only_itself(tmp_path: Path, happened: Happened) -> None:
    data = bytearray(flight().data)
    data[9000:9300] = bytes(300)
    recording = open_log(opened(tmp_path, bytes(data)))
    assert len(recording.channels["gyro"].t) > 380
    assert any("damaged" in w for w in recording.warnings)
    happened(3, "DataFlash with garbage inside: resynchronised, the bytes skipped are counted")


def test_a_damaged_description_loses_only_that_message(tmp_path: Path, happened: Happened) -> None:
    log = flight()
    at = log.data.find(b"IMU\x00")
    log.data[at + 4 : at + 7] = b"Q\x01~"  # a format that does not exist
    recording = open_log(opened(tmp_path, bytes(log.data)))
    assert "gyro" not in recording.channels
    assert len(recording.channels["motor_command"].t) == 400
    assert any("descriptions" in w for w in recording.warnings)
    happened(3, "DataFlash with a corrupted FMT: only that message is lost, and named")


def test_padding_at_the_end_is_no_damage_but_a_cut_record_is_told(tmp_path: Path) -> None:
    data = bytes(flight().data)
    assert open_log(opened(tmp_path, data + bytes(200))).warnings == ()
    assert any("cut" in w for w in open_log(opened(tmp_path, data[:-4])).warnings)
    index = index_dataflash(opened(tmp_path, b"\x00" * 700 + data))
    assert index.skipped == 700


def functions(*told: int, bank: str = "SERVO") -> dict[str, float]:
    """Parameters that tell what outputs 1, 2, 3 … drive."""
    form = "SERVO{}_FUNCTION" if bank == "SERVO" else f"PWM_{bank}_FUNC{{}}"
    return {form.format(output): float(value) for output, value in enumerate(told, 1)}


@pytest.mark.parametrize(
    ("told", "rotors", "columns"),
    [
        (functions(35, 34, 0, 0, 33), 0, [4, 1, 0]),
        (functions(34, 33, 36, 35, 0, 0, 0, 0), 4, [1, 0, 3, 2]),
        (functions(34, 36, 33, 39), 3, [2, 0, 1]),  # a tricopter: motors 1, 2 and 4, and the servo of its tail
        (functions(33, 34, 0, 36, 0, 0, 39), 0, [0, 1, 3]),
        (functions(33, 34), 4, [0, 1, 2, 3]),  # the other two were lost: they are where they always are
        ({}, 3, [0, 1, 3]),
        ({}, 6, [0, 1, 2, 3, 4, 5]),
        ({}, 0, []),
    ],
)
def test_which_outputs_are_motors_of_an_ardupilot(told: dict[str, float], rotors: int, columns: list[int]) -> None:
    found = motor_outputs(told, rotors, 16, "RCOU", ardupilot=True)
    assert found.columns == columns
    assert found.problem == ""


@pytest.mark.parametrize(
    ("told", "rotors", "said"),
    [
        (functions(34), 0, "SERVO1_FUNCTION 34"),  # motor 1 is nowhere
        (functions(34, 33), 4, "SERVO1_FUNCTION 34, SERVO2_FUNCTION 33"),  # and the other two?
        (functions(33, 34, 0, 36), 4, "SERVO3_FUNCTION 0"),
        (functions(33, 34, 0, 36, 0, 0, 39), 4, "SERVO3_FUNCTION 0, SERVO7_FUNCTION 39"),
        (functions(33, 34, 35, 36, 37, 38), 4, "SERVO5_FUNCTION 37, SERVO6_FUNCTION 38"),
        (functions(33, 34, 35), 3, "SERVO3_FUNCTION 35"),
        (functions(102, 101, 103, 104, bank="MAIN"), 4, "PWM_MAIN_FUNC1 102, PWM_MAIN_FUNC2 101"),
    ],
)
def test_what_is_no_order_of_the_motors_is_said_and_no_output_guessed(
    told: dict[str, float], rotors: int, said: str, happened: Happened
) -> None:
    """A gap was once filled with the first outputs, as for a tricopter, whose third motor is on the fourth one."""
    found = motor_outputs(told, rotors, 16, "RCOU")
    assert found.columns == []
    assert found.problem.startswith(f"{said}: no order")
    happened(31, f"{said} of {rotors or 'nobody knows how many'} rotors: no output is taken for a motor, said")


@given(
    parameters=st.dictionaries(
        st.sampled_from([*functions(*range(16)), *functions(*range(16), bank="MAIN"), *functions(1, 2, bank="AUX")]),
        st.sampled_from([0, 33, 34, 35, 36, 37, 39, 82, 101, 102, 103, 104, -1, 1e30, math.nan, -math.inf]),
    ),
    rotors=st.sampled_from([0, 3, 4, 6, 12]),
    width=st.sampled_from([4, 8, 16, 32]),
    ardupilot=st.booleans(),
)
def test_whatever_parameters_say_each_rotor_has_an_output_of_its_own_or_none_is_used(
    parameters: dict[str, float], rotors: int, width: int, ardupilot: bool
) -> None:
    found = motor_outputs(parameters, rotors, width, "RCOU", ardupilot)
    assert not (found.columns and found.problem)
    assert len(set(found.columns)) == len(found.columns)
    assert all(0 <= column < width for column in found.columns)
    assert found.problem or rotors in (0, len(found.columns))


def test_outputs_of_px4_in_order_and_frames_by_their_names() -> None:
    in_order = functions(101, 102, 103, 104, 0, 0, bank="AUX")
    assert motor_outputs(in_order, 4, 16, "SERVO_OUTPUT_RAW") == Outputs([0, 1, 2, 3])
    assert [frame_rotors(name) for name in ("HEXA/X", "TRI", "quad/plus", "HELI", "")] == [6, 3, 4, 0, 0]


def test_a_tricopters_third_motor_is_on_its_fourth_output(tmp_path: Path) -> None:
    log = flight(motors=())
    for output, value in ((1, 33), (2, 34), (4, 36), (7, 39)):
        log.add("PARM", 0, f"SERVO{output}_FUNCTION".encode(), float(value))
    recording = open_log(opened(tmp_path, bytes(log.data)))
    assert recording.channels["motor_command"].source == "RCOU C1 C2 C4"
    assert recording.channels["motor_command"].values[0].tolist() == [1100.0, 1200.0, 1400.0]


def test_leading_outputs_that_vary_are_motors() -> None:
    k = np.arange(100.0)[:, None]
    pulses = np.hstack([1100 + k, 1200 + k, 1300 + k, 1400 + k, 1500 + 0 * k, 1600 + k])
    assert active_outputs(pulses) == [0, 1, 2, 3]


def test_merging_never_reaches_beyond_an_instance() -> None:
    t = np.arange(0.0, 1.0, 0.1)
    at, values = merge_instances([(t, t), (t + 0.05, 2 * t)])
    assert at[0] >= 0.05
    assert at[-1] <= 0.95
    np.testing.assert_allclose(values[:, 1], 2 * (at - 0.05))
    assert merge_instances([(t, t), (t[:1], t[:1])])[1].shape == (0, 2)
