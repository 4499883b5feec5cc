"""Written logs are read back: every channel, frames and all, to the precision that the format has."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_replay import open_log, write_csv, write_mcap, write_tlog
from quadid_replay.motors import RPM

from quadid.data.grid import to_windows
from quadid.data.window import Channel, Recording, as_recording
from quadid.errors import LogError
from quadid.vehicle import Vehicle
from tests.replay.synthetic import PELICAN, Flight, full_recording

SINGLE = {"gyro": 1e-6, "accel": 1e-5, "attitude": 1e-7, "velocity": 1e-5, "position": 1e-6, "attitude_reference": 1e-6}
PRECISION: dict[str, dict[str, float]] = {
    "csv": {},
    "mcap": {"attitude": 1e-14, "attitude_reference": 1e-13, "velocity": 1e-13, "battery": 1e-5},
    "tlog": {**SINGLE, "rotor_speed": 0.51 * RPM, "motor_command": 1e-7, "battery": 5.1e-4},
}
MILLISECONDS = ("attitude", "velocity", "position", "attitude_reference", "battery")
WRITERS: dict[str, Callable[[Any, Any], None]] = {"csv": write_csv, "mcap": write_mcap, "tlog": write_tlog}


def same(before: Recording, after: Recording, kind: str) -> None:
    missing = set(before.channels) - set(after.channels)
    assert not missing
    for name, channel in before.channels.items():
        back = after.channels[name]
        assert len(back.t) == len(channel.t), name
        step = {"csv": 0.0, "mcap": 1.0e-9, "tlog": 6e-4 if name in MILLISECONDS else 1e-6}[kind]
        np.testing.assert_allclose(back.t, channel.t, rtol=0, atol=step, err_msg=name)
        values = back.values
        if name == "attitude":
            values = values * np.sign(np.sum(values * channel.values, axis=1))[:, None]
        np.testing.assert_allclose(values, channel.values, rtol=0, atol=PRECISION[kind].get(name, 0.0), err_msg=name)
    assert after.warnings == ()


@pytest.mark.parametrize("kind", WRITERS)
def test_round_trip_of_every_channel(tmp_path: Path, kind: str) -> None:
    recording = full_recording()
    path = tmp_path / "log"
    WRITERS[kind](path, recording)
    back = open_log(path)
    assert back.format == kind
    same(recording, back, kind)


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize(
    "source", ["nanodrone/square_run1.csv", "ardupilot/log171.bin", "px4/ascend_cubeorange_test.ulg"]
)
def test_round_trip_of_real_flights(tmp_path: Path, data_dir: Path, source: str, kind: str) -> None:
    recording = open_log(data_dir / source)
    keep = {n: Channel(n, c.t[:1000], c.values[:1000]) for n, c in recording.channels.items()}
    recording = Recording(recording.name, recording.format, keep)
    if kind == "tlog":  # there the first battery message may come before anything told the boot time
        recording = Recording("log", "x", {n: c for n, c in keep.items() if n != "battery"})
    path = tmp_path / "log"
    WRITERS[kind](path, recording)
    same(recording, open_log(path), kind)


@pytest.mark.parametrize("kind", WRITERS)
def test_windows_are_written_with_their_gaps(tmp_path: Path, kind: str) -> None:
    whole = Flight().recording(seconds=8.0)
    (window,) = to_windows(whole, PELICAN)
    parts = [window.slice(0, 150), window.slice(170, 400)]
    path = tmp_path / "log"
    WRITERS[kind](path, parts)
    back = to_windows(open_log(path), PELICAN)
    assert [len(w) for w in back] == [150, 230]
    for before, after in zip(parts, back, strict=True):
        assert after.sampling == "held"
        tolerance = 0.51 * RPM if kind == "tlog" else 0.0
        np.testing.assert_allclose(after.rotor_speed, before.rotor_speed, rtol=0, atol=tolerance)
        assert before.gyro is not None
        assert after.gyro is not None
        np.testing.assert_allclose(after.gyro, before.gyro, rtol=0, atol=1e-6)


@pytest.mark.parametrize("rotors", ["hexacopter", "pelican_x"])
@pytest.mark.parametrize("kind", WRITERS)
def test_any_number_of_rotors(tmp_path: Path, rotors: str, kind: str) -> None:
    vehicle = Vehicle.shipped(rotors)
    recording = Flight(vehicle).recording(seconds=3.0)
    WRITERS[kind](tmp_path / "log", recording)
    same(recording, open_log(tmp_path / "log"), kind)


def test_pulses_and_octocopters_over_telemetry(tmp_path: Path) -> None:
    t = np.arange(0.0, 2.0, 0.02)
    pulses = Channel("motor_command", t, np.round(1500.0 + 100.0 * np.sin(t[:, None] + np.arange(8))))
    recording = Recording("octo", "x", {"motor_command": pulses, "gyro": Channel("gyro", t, np.zeros((100, 3)))})
    write_tlog(tmp_path / "log", recording)
    np.testing.assert_array_equal(open_log(tmp_path / "log").channels["motor_command"].values, pulses.values)


def test_gyro_and_accelerometer_at_their_own_times(tmp_path: Path) -> None:
    t = np.arange(0.0, 2.0, 0.02)
    recording = Flight().at({"gyro": t, "accel": t[::2] + 0.005, "velocity": t[::5]})
    for kind, write in WRITERS.items():
        write(tmp_path / kind, recording)
        same(recording, open_log(tmp_path / kind), kind)


def test_velocity_without_attitude_stays_in_the_world(tmp_path: Path) -> None:
    recording = Flight().at({"gyro": np.arange(0.0, 2.0, 0.02), "velocity": np.arange(0.0, 2.0, 0.1)})
    write_mcap(tmp_path / "log", recording)
    same(recording, open_log(tmp_path / "log"), "mcap")


def test_positions_in_every_other_message_lose_nothing(tmp_path: Path) -> None:
    t = np.arange(0.0, 2.0, 0.02)
    channels = [Channel("gyro", t, np.zeros((100, 3))), Channel("velocity", t, np.sin(t[:, None] + np.arange(3)))]
    channels += [Channel("position", t[::2], np.cos(t[::2, None] + np.arange(3)))]
    write_tlog(tmp_path / "log", Recording("quad", "x", {c.name: c for c in channels}))
    read = open_log(tmp_path / "log")
    assert len(read.channels["position"].t) == 50
    assert not any("position" in warning for warning in read.warnings), read.warnings


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    recording = Flight().recording(seconds=1.0)
    for write in WRITERS.values():
        with pytest.raises(LogError, match="cannot write"):
            write(tmp_path / "absent" / "log", recording)
        with pytest.raises(LogError):
            write(tmp_path / "log", [])
    early = Flight().recording(seconds=1.0, start=-5.0)
    with pytest.raises(LogError, match="times begin at -5"):
        write_mcap(tmp_path / "log", early)
    with pytest.raises(LogError, match="times from -5"):
        write_tlog(tmp_path / "log", early)
    write_mcap(tmp_path / "log", early, 10**18)


def test_windows_must_be_in_order() -> None:
    (window,) = to_windows(Flight().recording(seconds=2.0), PELICAN)
    with pytest.raises(LogError, match="overlap"):
        as_recording([window, window])
