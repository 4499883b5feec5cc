"""Vehicle files from logs: the airframe as the autopilot numbers it, guesses marked, the result judged in flight."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log
from quadid_replay.motors import ARDUPILOT, frame_of

from quadid.app.init import vehicle_text
from quadid.checks import CheckResult, inspect
from quadid.data.window import Channel, Recording
from quadid.errors import LogError, QuadidError
from quadid.vehicle import Vehicle


@pytest.mark.parametrize("name", sorted(ARDUPILOT))
def test_every_frame_balances(name: str) -> None:
    motors = ARDUPILOT[name]
    place = np.array([[np.cos(np.radians(a)), np.sin(np.radians(a))] for a, _ in motors])
    np.testing.assert_allclose(place.sum(axis=0), 0.0, atol=1e-12)
    assert sum(spin for _, spin in motors) == 0
    for axis in range(2):  # roll and pitch do not turn the vehicle about z
        assert float(place[:, axis] @ [spin for _, spin in motors]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.1, 0.1), (1e-300, 0.0)])
def test_rotors_in_one_place_are_no_airframe(place: tuple[float, float]) -> None:
    t = np.arange(0.0, 20.0, 0.02)
    rotors = {
        f"CA_ROTOR{k}_{what}": value
        for k in range(4)
        for what, value in (("PX", place[0]), ("PY", place[1]), ("PZ", 0.0), ("KM", 0.05))
    }
    speeds = Channel("rotor_speed", t, np.full((len(t), 4), 400.0))
    log = Recording("log", "ulog", {"rotor_speed": speeds}, autopilot={"CA_ROTOR_COUNT": 4.0, **rotors})
    with pytest.raises(QuadidError):
        vehicle_text(log, "mine")


def test_the_frame_of_arducopter_is_that_of_its_truth(data_dir: Path) -> None:
    folder = data_dir / "ardupilot_sitl"
    log = open_log(folder / "x.bin")
    assert log.autopilot["INS_GYRO_FILTER"] == 20.0
    made = Vehicle.from_yaml(vehicle_text(log, "mine", mass=3.0, arm=0.35))
    truth = Vehicle.from_yaml((folder / "sitl_x.yaml").read_text(encoding="utf-8"))
    np.testing.assert_allclose(made.rotor_positions, truth.rotor_positions, atol=1e-3)
    np.testing.assert_array_equal(made.spins, truth.spins)
    assert made.command.kind == "rotor_speed"
    assert made.effects == {"imu_lag": {"cutoff": 20.0}}
    assert made.parameters["b"].initial == pytest.approx(4.1e-5, rel=0.1)  # between secant and tangent of the curve
    checks = {c.name: c.verdict for c in inspect(log, made).checks}
    assert checks["motor_order"] is checks["rotor_timing"] is checks["hover"] is CheckResult.OK


def test_pulse_widths_take_the_range_that_the_autopilot_uses(data_dir: Path) -> None:
    log = open_log(data_dir / "ardupilot_sitl" / "x.bin")
    outputs = {name: c for name, c in log.channels.items() if name != "rotor_speed"}
    made = Vehicle.from_yaml(vehicle_text(replace(log, channels=outputs), "mine"))
    assert made.command.kind == "pwm"
    assert made.command.range == pytest.approx((1150.0, 1950.0))


def test_px4_tells_its_geometry_whole(data_dir: Path) -> None:
    log = open_log(data_dir / "px4" / "ascend_cubeorange_test.ulg")
    text = vehicle_text(log, "cube")
    made = Vehicle.from_yaml(text)
    np.testing.assert_allclose(made.rotor_positions[0], [0.2164, 0.2159, 0.0], atol=1e-4)
    np.testing.assert_array_equal(made.spins, [1, 1, -1, -1])
    assert "arm is a guess" not in text
    assert "FILL IN: weigh it" in text


def test_a_log_without_an_airframe_is_refused(data_dir: Path) -> None:
    with pytest.raises(LogError, match="no parameters that describe the airframe"):
        vehicle_text(open_log(data_dir / "iris" / "sideways.csv"), "mine")
    assert frame_of({"CA_ROTOR_COUNT": 4.0}, 0.2) is None
    assert frame_of({"FRAME_CLASS": float("nan")}, 0.2) is None


@pytest.mark.parametrize("firmware", ["ArduPlane", "ArduHeli", "ArduRover"])
def test_no_vehicle_is_made_of_a_log_of_another_kind(data_dir: Path, tmp_path: Path, firmware: str) -> None:
    log = (data_dir / "findings" / "logs" / "dataflash_esc_index_44" / "aux44.bin").read_bytes()
    told = b"ArduCopter V4.4.4"
    (tmp_path / "log.bin").write_bytes(log.replace(told, f"{firmware} V4.4.4".encode().ljust(len(told))))
    recording = open_log(tmp_path / "log.bin")
    assert recording.other in recording.warnings
    with pytest.raises(LogError, match=f"{firmware}, no multirotor"):
        vehicle_text(replace(recording, warnings=()), "mine")


def test_arducopter_writes_its_attitude_as_ang(data_dir: Path) -> None:
    attitude = open_log(data_dir / "ardupilot_sitl" / "x.bin").channels["attitude"]
    assert attitude.source == "ANG (degrees)"
    assert 1.0 / np.median(np.diff(attitude.t)) > 390.0


def test_a_numbered_log_is_named_with_its_folder(data_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "morning").mkdir()
    path = tmp_path / "morning" / "00000001.BIN"
    path.symlink_to(data_dir / "ardupilot" / "log171.bin")
    assert open_log(path).name == "morning/00000001.BIN"
