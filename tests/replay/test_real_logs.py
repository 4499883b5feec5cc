"""Every real log: the golden summary, plausible units and rates, and windows where the log allows them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_replay import open_log

from quadid.data.grid import grid_recording, to_windows
from quadid.errors import NotIdentifiableError
from quadid.vehicle import Vehicle
from tests.replay.golden import GOLDEN, real_logs, summary
from tests.replay.synthetic import PELICAN, with_command

EXPECTED: dict[str, Any] = json.loads(GOLDEN.read_text(encoding="utf-8"))
PLAUSIBLE = {
    "gyro": 45.0,
    "accel": 160.0,
    "attitude": 1.0,
    "rotor_speed": 6000.0,
    "motor_command": 2200.0,
    "velocity": 40.0,
    "position": 500.0,
    "battery": 60.0,
    "attitude_reference": 3.2,
}


def test_the_golden_file_covers_every_log(data_dir: Path) -> None:
    assert real_logs(data_dir) == sorted(EXPECTED), "run: python -m tests.replay.golden"


def close(found: Any, expected: Any, place: str) -> None:
    """Compares nested summaries, numbers to five digits."""
    if isinstance(expected, dict):
        assert list(found) == list(expected), place
        for key in expected:
            close(found[key], expected[key], f"{place}.{key}")
    elif isinstance(expected, list):
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6, err_msg=place)
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, rel=2e-5, abs=1e-6), place
    else:
        assert found == expected, place


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_each_log_reads_as_it_did(data_dir: Path, name: str) -> None:
    recording = open_log(data_dir / name)
    close(summary(recording), EXPECTED[name], name)
    for channel in recording.channels.values():
        assert np.abs(channel.values).max() <= PLAUSIBLE[channel.name], channel.name
        assert np.isfinite(channel.values).all()
    gyro, accel = recording.channels["gyro"], recording.channels["accel"]
    assert len(gyro.t) == pytest.approx(len(accel.t), abs=2)
    if "tlog" not in name:
        assert 8.5 < float(np.median(np.linalg.norm(accel.values, axis=1))) < 14.0
        assert float(np.median(accel.values[:, 2])) < -8.0


@pytest.mark.parametrize(
    ("name", "vehicle", "rate", "windows", "seconds"),
    [
        ("nanodrone/random_run1.csv", "nanodrone/vehicle.yaml", None, 1, 59.98),
        ("nanodrone/random_run1.csv", "nanodrone/vehicle.yaml", 50.0, 1, 59.82),
        ("crazyflie_rpm/figure8_20.csv", "crazyflie_rpm/vehicle.yaml", None, 2, 6.99),
        ("crazyflie_rpm/figure8_20.csv", "crazyflie_rpm/vehicle.yaml", 50.0, 1, 6.82),
        ("crazyflie_rpm/figure8_17_pwm.csv", "crazyflie_rpm/vehicle_pwm.yaml", 50.0, 1, 6.8),
        ("cases/case_010/train.csv", "cases/case_010/vehicle.yaml", 50.0, 1, 119.98),
        ("mcap/crazyflie_figure8_35.mcap", "crazyflie_rpm/vehicle.yaml", 50.0, 1, 5.16),
        ("mcap/crazyflie_rollpitch.mcap", "crazyflie_rpm/vehicle_pwm.yaml", 50.0, 1, 62.0),
    ],
)
def test_windows_of_real_flights(
    data_dir: Path, name: str, vehicle: str, rate: float | None, windows: int, seconds: float
) -> None:
    described = Vehicle.from_yaml((data_dir / vehicle).read_text())
    gridded = grid_recording(open_log(data_dir / name), described, rate)
    assert gridded.report.windows == windows
    assert gridded.report.seconds_used == pytest.approx(seconds, rel=0.03)
    lost = 0
    for window in gridded.windows:
        assert window.gyro is not None
        lost += int(np.isnan(window.gyro).any(axis=1).sum())
        assert np.isfinite(window.rotor_speed).all()
    assert lost <= gridded.report.bridged, "only rows between lost samples are no measurement"


def test_an_ardupilot_flight_on_the_grid(data_dir: Path) -> None:
    vehicle = with_command(PELICAN, kind="pwm", max_speed=800.0)
    recording = open_log(data_dir / "ardupilot" / "log171.bin")
    zero = float(recording.channels["gyro"].t[0])
    (window,) = to_windows(recording, vehicle, 50.0, zero + 76.0, zero + 216.0)
    assert len(window) * window.dt == pytest.approx(140.0, abs=0.1)
    assert window.attitude is not None
    assert np.isfinite(window.attitude[:, 0]).mean() == pytest.approx(0.2, abs=0.02)  # 10 Hz on 50 Hz


def test_a_telemetry_too_slow_is_refused_with_the_reason(data_dir: Path) -> None:
    recording = open_log(data_dir / "px4" / "auterion_esc_status_log.ulg")
    with pytest.raises(NotIdentifiableError, match=r"3\.9 Hz is too slow.*50 Hz for inertias") as error:
        to_windows(recording, PELICAN)
    assert error.value.exit_code == 3
    assert "SDLOG_PROFILE" in error.value.fix
