"""What a log tells of its flight: modes as logged, and a spectrum that finds what shakes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log
from quadid_replay.columns import mode_changes
from quadid_replay.dataflash import ARDUCOPTER

from quadid.data.window import Channel
from quadid.flight import fly
from quadid.report.fit_pages import flight_section, mode_rows, spectrum
from quadid.vehicle import Vehicle

PELICAN = Vehicle.shipped("pelican")


def test_a_shaking_shows_at_its_frequency_with_its_power() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 60.0, 0.005)
    values = rng.normal(0.0, 0.2, (len(t), 3)) + [0.0, 0.0, -9.81]
    values[:, 1] += 0.5 * np.sin(2.0 * np.pi * 31.0 * t)
    found = spectrum(Channel("accel", t, values), ((5.0, 55.0),))
    assert found is not None
    frequency, density = found
    assert frequency[np.argmax(density[:, 1])] == pytest.approx(31.0, abs=0.5)
    near = np.abs(frequency - 31.0) < 2.0
    power = float(np.sum(density[near, 1] ** 2) * np.diff(frequency).mean())
    assert power == pytest.approx(0.5**2 / 2.0, rel=0.1)
    # White noise of 0.2 at 200 Hz: 0.2 / sqrt(100 Hz).
    assert np.median(density[:, 0]) == pytest.approx(0.02, rel=0.1)
    assert spectrum(Channel("accel", t, values), ((5.0, 6.0),)) is None


def test_the_rotors_are_placed_in_it_or_said_to_be_beyond_it() -> None:
    slow = fly(PELICAN, seconds=20.0, seed=3).recording
    section = flight_section(slow, PELICAN, 0)
    assert section is not None
    turns = float(slow.channels["rotor_speed"].values.mean()) / (2.0 * np.pi)
    assert f"turn {turns:.0f} times a second, faster than this log can show (25 Hz)" in section["intro"]
    quick = fly(PELICAN, seconds=20.0, seed=3, log_rate=500.0).recording
    shown = flight_section(quick, PELICAN, 1)
    assert shown is not None
    assert [f["title"] for f in shown["figures"]] == ["Rotor signals", "Vibration in the air"]
    (line,) = shown["figures"][1]["views"][0]["layout"]["shapes"]
    assert line["x0"] == pytest.approx(turns, rel=0.02)
    assert not section["figures"][1]["views"][0]["layout"]["shapes"]


def test_modes_are_told_from_the_first_imu_sample_on() -> None:
    modes = mode_changes(
        np.array([99.0, np.nan, 103.0, 104.0, 110.0]), np.array([0.0, 5.0, 5.0, 5.0, 99.0]), ARDUCOPTER
    )
    assert modes == ((99.0, "Stabilize"), (103.0, "Loiter"), (110.0, "mode 99"))
    t = np.arange(100.0, 120.001, 0.01)
    gyro = Channel("gyro", t, np.zeros((len(t), 3)))
    recording = replace(fly(PELICAN, seconds=2.0, seed=1).recording, channels={"gyro": gyro}, modes=modes)
    assert mode_rows(recording) == [["Stabilize", "0.0", "3.0"], ["Loiter", "3.0", "10.0"], ["mode 99", "10.0", "20.0"]]


@pytest.mark.parametrize(
    ("log", "names"),
    [
        ("ardupilot/log171.bin", {"Loiter", "Acro"}), ("px4/ascend_cubeorange_test.ulg", {"Takeoff", "Hold", "Land"}),
        ("nanodrone/square_run1.csv", set()),
    ],
)  # fmt: skip
def test_recorded_flights(data_dir: Path, log: str, names: set[str]) -> None:
    assert {name for _, name in open_log(data_dir / log).modes} == names
