"""Motors at 50 Hz from the setpoints that PX4 logs, where it logs the motors themselves at 10 Hz."""

from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog
from quadid_replay.ulog import allocated, allocation, read_ulog

import quadid
from quadid.flight import TruthParameters, fly
from quadid.parameters import Status
from quadid.vehicle import Vehicle
from tests.replay.px4_flight import px4_ulog

PELICAN = Vehicle.shipped("pelican")
MAX_SPEED = 1000.0
PARAMETERS = {"CA_AIRFRAME": 0.0, "CA_ROTOR_COUNT": 4.0} | {
    f"CA_ROTOR{n}_{key}": value
    for n, place in enumerate([(0.2, 0.3, 0.05), (-0.2, -0.3, 0.05), (0.2, -0.3, -0.05), (-0.2, 0.3, -0.05)])
    for key, value in zip(("PX", "PY", "KM"), place, strict=True)
}


def test_motors_are_those_that_a_real_px4_allocated(data_dir: Path) -> None:
    """Rows logged at 10 Hz of the same moments, in flight: single precision apart."""
    log = ULog(str(data_dir / "px4" / "ascend_cubeorange_test.ulg"))
    topics = {d.name: d.data for d in log.data_list if d.multi_id == 0}
    mix = allocation(log.initial_parameters)
    assert mix is not None
    torque, thrust, motors = (
        topics[n] for n in ("vehicle_torque_setpoint", "vehicle_thrust_setpoint", "actuator_motors")
    )
    setpoints = np.column_stack([part[f"xyz[{i}]"] for part in (torque, thrust) for i in range(3)])
    _, here, there = np.intersect1d(torque["timestamp_sample"], motors["timestamp_sample"], return_indices=True)
    off = allocated(mix, setpoints)[here] - np.column_stack([motors[f"control[{i}]"] for i in range(4)])[there]
    off = off[np.isfinite(off).all(axis=1)]
    assert len(off) > 250
    assert np.max(np.abs(off)) < 1e-6


def test_px4s_scale_of_a_rectangle() -> None:
    """Roll and pitch have the scale of the weaker axis, yaw and thrust one of their own; front left is motor 2."""
    mix = allocation(PARAMETERS)
    assert mix is not None
    roll, pitch, yaw, up = (mix[:, k] for k in (0, 1, 2, 5))
    assert np.sign(roll).tolist() == [-1, 1, 1, -1]
    assert np.sign(pitch).tolist() == [1, -1, 1, -1]
    assert np.sign(yaw).tolist() == [1, 1, -1, -1]
    assert np.abs(pitch) == pytest.approx(np.sqrt(0.5))
    assert np.abs(roll) == pytest.approx(np.sqrt(0.5) * 0.2 / 0.3)
    assert np.abs(yaw) == pytest.approx(1.0)
    assert up == pytest.approx(-1.0)


@pytest.mark.parametrize("wrong", [{"CA_AIRFRAME": 1.0}, {"CA_ROTOR_COUNT": 0.0}, {"CA_ROTOR1_AZ": 0.0}])
def test_other_airframes_are_not_allocated(wrong: dict[str, float]) -> None:
    assert allocation(PARAMETERS | wrong) is None


def test_rows_that_px4_limits_have_no_value() -> None:
    mix = allocation(PARAMETERS)
    assert mix is not None
    motors = allocated(mix, np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -0.5], [1.2, 0.0, 0.0, 0.0, 0.0, -0.5]]))
    assert motors[0] == pytest.approx(0.5)
    assert np.isnan(motors[1]).all()


def test_a_log_of_the_default_profile_has_inertias(tmp_path: Path) -> None:
    flight = fly(PELICAN, seconds=60.0, seed=5, log_rate=50.0)
    path = tmp_path / "flight.ulg"
    path.write_bytes(px4_ulog(flight, PELICAN, MAX_SPEED, thinned=5))
    assert "allocated" in read_ulog(path).channels["motor_command"].source
    command = PELICAN.command.model_copy(update={"kind": "normalized", "max_speed": MAX_SPEED})
    found = quadid.identify(quadid.load(path, PELICAN.model_copy(update={"command": command}))).parameters
    truth = TruthParameters.of(PELICAN).as_dict()
    for name in ("b", "J_xx", "J_yy"):
        assert found[name].value == pytest.approx(truth[name], rel=0.02)
        assert found[name].status is Status.IDENTIFIED


def test_setpoints_that_motors_do_not_follow_are_not_used(tmp_path: Path) -> None:
    flight = fly(PELICAN, seconds=10.0, seed=5, log_rate=50.0)
    path = tmp_path / "flight.ulg"
    path.write_bytes(px4_ulog(flight, PELICAN, MAX_SPEED, thinned=5, mixed_otherwise=0.02))
    assert "actuator_motors" in read_ulog(path).channels["motor_command"].source.split()[0]
