"""Names of columns and the place of the IMU from the vehicle file: another CSV, the same windows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log, write_csv, write_mcap

import quadid
from quadid.checks import CheckResult, inspect
from quadid.data.grid import to_windows
from quadid.data.window import mounting_matrix
from quadid.errors import LogError, VehicleError
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.replay.synthetic import PELICAN, Flight, full_recording

NAMES = {"t": "Time_s", "p": "gyro_x", "q": "gyro_y", "r": "gyro_z", "ax": "acc_x"}


def with_keys(**keys: object) -> Vehicle:
    return Vehicle.model_validate({**PELICAN.model_dump(), **keys})


def test_columns_are_read_under_the_names_of_the_vehicle_file(tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    write_csv(path, full_recording(4.0, 50.0))
    expected = open_log(path)
    header, _, rows = path.read_text().partition("\n")
    theirs = ",".join(NAMES.get(name, name) for name in header.split(","))
    path.write_text(f"{theirs}\n{rows}")
    with pytest.raises(LogError):
        open_log(path)
    vehicle = Vehicle.from_yaml(with_keys(columns=NAMES).to_yaml())
    found = open_log(path, columns=vehicle.columns)
    for name, channel in expected.channels.items():
        np.testing.assert_array_equal(found.channels[name].values, channel.values)
    with pytest.raises(LogError, match=r"no column gyro_X, which `columns` names for p.*did you mean 'gyro_"):
        open_log(path, columns={**NAMES, "p": "gyro_X"})


def test_names_of_columns_are_no_matter_of_the_format(tmp_path: Path) -> None:
    """A misspelt name was said of CSV alone, and that names are of no use to other formats was not."""
    path = tmp_path / "flight.mcap"
    write_mcap(path, full_recording(4.0, 50.0))
    with pytest.raises(LogError, match="unknown name 'pp'.*did you mean 'p'"):
        quadid.inspect(path, columns={"pp": "gyro_x"})
    said = quadid.inspect(path, columns={"p": "gyro_x"}).warnings
    assert [text for text in said if "gyro_x" in text and "mcap" in text]
    described = with_keys(columns=NAMES)
    assert not [text for text in quadid.inspect(path, vehicle=described).warnings if "columns" in text]


def test_an_imu_that_sits_turned_is_turned_back() -> None:
    flight = Flight().recording(seconds=10.0)
    rotation = (0.3, -0.2, 1.5707963)
    turn = mounting_matrix(rotation)
    channels = {
        name: replace(c, values=c.values @ turn) if name in ("gyro", "accel") else c
        for name, c in flight.channels.items()
    }
    turned = replace(flight, channels=channels)
    vehicle = Vehicle.from_yaml(with_keys(mounting={"rotation": list(rotation)}).to_yaml())
    (straight,), (back,) = to_windows(flight, PELICAN), to_windows(turned, vehicle)
    for found, expected in ((back.gyro, straight.gyro), (back.accel, straight.accel)):
        assert found is not None
        assert expected is not None
        np.testing.assert_allclose(found, expected, atol=1e-12)
    verdicts = {c.name: c.verdict for c in inspect(turned, vehicle).checks}
    assert verdicts["gyro_attitude"] is verdicts["motor_order"] is verdicts["rotor_timing"] is CheckResult.OK
    assert not inspect(turned, PELICAN).usable


def test_the_matrix_turns_one_axis_at_a_time_in_the_order_z_y_x() -> None:
    def about(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> FloatArray:
        return mounting_matrix((roll, pitch, yaw))

    np.testing.assert_allclose(about(yaw=np.pi / 2) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(about(pitch=np.pi / 2) @ [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(about(roll=np.pi / 2) @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(mounting_matrix((0.4, 0.7, -1.1)), about(yaw=-1.1) @ about(pitch=0.7) @ about(roll=0.4))


def test_the_place_of_the_imu_is_a_known_lever_arm() -> None:
    vehicle = with_keys(mounting={"position": [0.02, -0.01, 0.03]})
    assert vehicle.effects["imu_lever_arm"] == {"x": 0.02, "y": -0.01, "z": 0.03}
    assert Vehicle.from_yaml(vehicle.to_yaml()).effects == vehicle.effects
    with pytest.raises(VehicleError, match="unknown key 'mounting.angle'"):
        Vehicle.from_yaml(PELICAN.to_yaml() + "mounting: {angle: [0, 0, 0]}\n")
    text = "effects: {imu_lever_arm: {x: 1.0, y: 0, z: 0}}\nmounting: {position: [0, 0, 0.1]}\n"
    with pytest.raises(VehicleError, match="differ; keep one of them"):
        Vehicle.from_yaml(PELICAN.to_yaml().replace("effects: {}\n", "") + text)
