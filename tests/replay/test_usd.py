"""Crazyflie µSD logs: variables to channels, frames, two kinds under one name, mixer, and damage."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log

from quadid.data.rotor_signal import rotor_signal
from quadid.errors import LogError
from quadid.vehicle import Vehicle

CRAZYFLIE = Vehicle.shipped("crazyflie")


class Usd:
    """Writes a µSD log: declare event types first, then add records."""

    def __init__(self, **types: str) -> None:
        self.data = bytearray(b"\xbc\x02\x00" + struct.pack("<H", len(types)))
        self.forms: dict[str, tuple[int, str]] = {}
        for number, (name, variables) in enumerate(types.items()):
            identity = 65535 if name == "fixedFrequency" else number
            names = variables.split()
            self.data += struct.pack("<H", identity) + name.encode() + b"\0" + struct.pack("<H", len(names))
            self.data += b"".join(n.encode() + b"\0" for n in names)
            self.forms[name] = (identity, "".join(n[-2] for n in names))

    def add(self, name: str, us: int, *values: float) -> None:
        number, form = self.forms[name]
        self.data += struct.pack("<HQ" + form, number, us, *values)

    def closed(self) -> bytes:
        return bytes(self.data) + struct.pack("<I", zlib.crc32(self.data))


CONTROLLER = (
    "controller.cmd_thrust(f) controller.cmd_roll(f) controller.cmd_pitch(f) controller.cmd_yaw(f) "
    "controller.r_roll(f) controller.r_pitch(f) controller.r_yaw(f) controller.accelz(f) stateEstimate.x(f) "
    "stateEstimate.y(f) stateEstimate.z(f) controller.ctr_yaw(h)"
)
MOTOR = (
    "motor.m1(I) motor.m2(I) motor.m3(I) motor.m4(I) pm.vbatMV(H) stateEstimate.vx(f) stateEstimate.vy(f) "
    "stateEstimate.vz(f) stateEstimate.ax(f) stateEstimate.ay(f) stateEstimate.az(f) stateEstimate.roll(f) "
    "stateEstimate.yaw(f)"
)


def controller_log(rows: int = 20) -> Usd:
    log = Usd(fixedFrequency=CONTROLLER, modeChanged="mode(B)")
    for k in range(rows):
        log.add("fixedFrequency", 1_000_000 + 10_000 * k, 40000, 1000, 400, 2000, 0.1, 0.2, 0.3, 1.0, 1.0, 2.0, 0.5, 7)
        if k == rows // 2:
            log.add("modeChanged", 1_000_000 + 10_000 * k, 1)
    return log


def motor_log(rows: int = 20) -> Usd:
    log = Usd(fixedFrequency=MOTOR)
    for k in range(rows):
        log.add("fixedFrequency", 10_000 * k, 65535, 0, 32768, 1000, 3700, 1.0, 2.0, 0.5, 0.1, 0.2, 0.0, 1.0, 2.0)
    return log


def write(folder: Path, data: bytes, name: str = "log00") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def test_channels_are_in_core_units_and_frames(tmp_path: Path) -> None:
    recording = open_log(write(tmp_path, controller_log().closed()))
    rows = {name: channel.values[0] for name, channel in recording.channels.items()}
    assert recording.format == "usdlog"
    assert not recording.warnings
    np.testing.assert_allclose(rows["gyro"], [0.1, 0.2, -0.3], rtol=1e-6)
    np.testing.assert_allclose(rows["position"], [1.0, -2.0, -0.5], rtol=1e-6)
    np.testing.assert_allclose(rows["accel_z"], [-9.80665], rtol=1e-6)
    np.testing.assert_allclose(rows["mixer_input"] * 65535, [40000, 1000, 400, 2000], rtol=1e-6)
    np.testing.assert_allclose(np.diff(recording.channels["gyro"].t), 0.01, atol=1e-9)
    assert len(recording.channels["gyro"].t) == 20, "an event between the rows loses none"


def test_the_other_kind_is_told_by_its_variables_not_by_its_name(tmp_path: Path) -> None:
    recording = open_log(write(tmp_path, motor_log().closed(), "controller_001.usd"))
    rows = {name: channel.values[0] for name, channel in recording.channels.items()}
    np.testing.assert_allclose(rows["motor_command"], [1.0, 0.0, 0.5, 0.0153], atol=1e-4)
    np.testing.assert_allclose(rows["battery"], [3.7])
    np.testing.assert_allclose(rows["velocity"], [1.0, -2.0, -0.5])
    np.testing.assert_allclose(rows["accel_world"] / 9.80665, [0.1, -0.2, -1.0], rtol=1e-6)
    assert "attitude" not in rows
    assert "stateEstimate.pitch is missing" in recording.warnings[0]


def test_full_state_becomes_attitude_gyro_and_accelerometer(tmp_path: Path) -> None:
    log = Usd(
        fixedFrequency="gyro.x(f) gyro.y(f) gyro.z(f) acc.x(f) acc.y(f) acc.z(f) stateEstimate.roll(f) "
        "stateEstimate.pitch(f) stateEstimate.yaw(f) rpm.m1(H) rpm.m2(H) rpm.m3(H) rpm.m4(H)"
    )
    for k in range(5):
        log.add("fixedFrequency", 10_000 * k, 180.0, 0.0, 90.0, 0.0, 0.0, 1.0, 0.0, 0.0, 90.0, 6000, 0, 0, 0)
    rows = {n: c.values[0] for n, c in open_log(write(tmp_path, log.closed())).channels.items()}
    np.testing.assert_allclose(rows["gyro"], [np.pi, 0.0, -np.pi / 2], rtol=1e-6)
    np.testing.assert_allclose(rows["accel"], [0.0, 0.0, -9.80665], rtol=1e-6)
    np.testing.assert_allclose(rows["attitude"], [np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)], atol=1e-6)
    np.testing.assert_allclose(rows["rotor_speed"][0], 200 * np.pi, rtol=1e-6)


def test_mixer_inputs_become_the_rotors_of_the_firmware(tmp_path: Path) -> None:
    signal = rotor_signal(open_log(write(tmp_path, controller_log().closed())), CRAZYFLIE)
    thrust = np.array([41700.0, 37300.0, 42300.0, 38700.0]) / 65535  # T -+ R/2 +- P/2 +- Y
    np.testing.assert_allclose(signal.values[0], 2700.0 * np.sqrt(thrust), rtol=1e-6)


def test_mixer_inputs_without_a_mixer_are_refused_with_the_way_out(tmp_path: Path) -> None:
    recording = open_log(write(tmp_path, controller_log().closed()))
    with pytest.raises(LogError, match="mixer: crazyflie"):
        rotor_signal(recording, CRAZYFLIE.model_copy(update={"mixer": None}))


def test_a_cut_log_gives_its_whole_rows_and_is_told(tmp_path: Path) -> None:
    recording = open_log(write(tmp_path, controller_log().closed()[:-30]))
    assert len(recording.channels["gyro"].t) == 19
    assert any("cut off" in text for text in recording.warnings)


@pytest.mark.parametrize("at", [3, 7, 30, 60])
def test_a_damaged_list_of_variables_is_refused(tmp_path: Path, at: int) -> None:
    data = bytearray(controller_log().closed())
    data[at : at + 2] = b"\xff\xff"
    with pytest.raises(LogError, match="copy the file again|none of its variables"):
        open_log(write(tmp_path, bytes(data)))


def test_recorded_flights_of_both_kinds(data_dir: Path) -> None:
    folder = data_dir / "crazypad"
    kinds: dict[str, int] = {}
    for path in sorted(folder.glob("*.usd"))[::6]:
        recording = open_log(path)
        speed = rotor_signal(recording, CRAZYFLIE).values
        assert speed.shape[1] == 4, path.name
        assert 1500 < np.median(speed[speed[:, 0] > 1000]) < 2500, path.name
        kind = "mixer" if "mixer_input" in recording.channels else "motor"
        kinds[kind] = kinds.get(kind, 0) + 1
    assert min(kinds.values()) > 5
    assert len(kinds) == 2


GOLDEN: dict[str, dict[str, tuple[int, list[float]]]] = {
    "motor_126.usd": {
        "accel_world": (2599, [-0.0546707, 0.0935404, -9.79621]),
        "velocity": (2599, [-0.000913192, -0.00393649, -0.00325929]),
        "position": (2599, [1.09875, -0.00784423, -0.301978]),
        "motor_command": (2599, [0.475865, 0.358008, 0.494089, 0.379501]),
        "battery": (2599, [3.6023]),
    },
    "motor_127.usd": {
        "gyro": (2601, [0.000329706, 0.00127459, -0.00122924]),
        "accel_z": (2601, [-9.78826]),
        "position": (2601, [1.10354, -0.00168307, -0.31429]),
        "mixer_input": (2601, [0.428651, 0.0280636, 0.00300468, 0.0580374]),
        "attitude_reference": (2601, [-3.54689e-05, -0.000507466, -0.036516, 0.429182]),
    },
}


@pytest.mark.parametrize("name", sorted(GOLDEN))
def test_recorded_flights_read_as_they_did(data_dir: Path, name: str) -> None:
    channels = open_log(data_dir / "crazypad" / name).channels
    assert sorted(channels) == sorted(GOLDEN[name])
    for channel, (rows, means) in GOLDEN[name].items():
        assert len(channels[channel].t) == rows
        np.testing.assert_allclose(channels[channel].values.mean(axis=0), means, rtol=1e-4, atol=1e-6)
