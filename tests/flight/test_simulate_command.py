"""`quadid simulate`: files, effects on the command line, JSON, refusals, live MAVLink."""

import socket
import threading
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log

from quadid.app.simulate import SimulateError, parse_effects, read_manoeuvre
from quadid.cli.simulate import check_target, stream
from quadid.errors import ParameterError, VehicleError
from quadid.flight import fly
from quadid.vehicle import Vehicle
from tests.commands import Cli, one_line

PELICAN = Vehicle.shipped("pelican")


@pytest.mark.parametrize("suffix", ["csv", "mcap", "tlog"])
def test_files(suffix: str, tmp_path: Path, inside: Cli) -> None:
    result = inside(
        "simulate",
        tmp_path / f"a.{suffix}",
        "--seconds",
        "5",
        "--seed",
        "7",
        "--effect",
        "rotor_drag:k_x=0.3,k_y=0.2",
        "--json",
        "-",
    ).data
    assert result["schema"] == "quadid.simulate/1"
    assert result["effects"] == {"rotor_drag": {"k_x": 0.3, "k_y": 0.2}}
    assert result["log"] == str(tmp_path / f"a.{suffix}")
    flight = fly(PELICAN, seconds=5.0, seed=7, effects={"rotor_drag": {"k_x": 0.3, "k_y": 0.2}})
    read = open_log(tmp_path / f"a.{suffix}")
    assert flight.window.gyro is not None
    np.testing.assert_allclose(read.channels["gyro"].values, flight.window.gyro, atol=1e-6)
    np.testing.assert_allclose(read.channels["rotor_speed"].values, flight.window.rotor_speed, atol=0.06)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["a.txt"], ".mcap"),
        (["nowhere/a.csv"], "folder"),
        (["a.csv", "--effect", "rotor_drug"], "rotor_drag"),
        (["a.csv", "--effect", "rotor_drag:k_z=1"], "k_x"),
        (["a.csv", "--seconds", "-3"], "3600"),
        (["a.csv", "--vehicle", "pelikan"], "pelican"),
        (["a.csv", "--profile", "wild"], "excited"),
        (["udpout:14550"], "HOST:PORT"),
    ],
)
def test_refusals_are_one_line(
    arguments: list[str], reason: str, tmp_path: Path, inside: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert reason in one_line(inside("simulate", *arguments), 2)
    assert list(tmp_path.iterdir()) == []


def test_effects_without_values_are_drawn() -> None:
    effects, outside = parse_effects(["motor_lag", "wind", "gusts", "gyro_bias:x=0.01"], PELICAN, 1, 60.0)
    assert set(effects) == {"motor_lag", "wind", "rotor_drag", "gyro_bias"}
    assert effects["gyro_bias"] == {"x": 0.01}
    assert set(outside) == {"gusts"}
    for text in ("motor_lag:tau", "motor_lag:tau=fast"):
        with pytest.raises(ParameterError, match="NAME:KEY=NUMBER"):
            parse_effects([text], PELICAN, 1, 60.0)


def test_manoeuvre_files(tmp_path: Path) -> None:
    file = tmp_path / "m.yaml"
    file.write_text("segments:\n  - {axis: roll, kind: doublet, start: 1, duration: 1, amplitude: 0.2}\n")
    assert read_manoeuvre(file)[0].axis == "roll"
    for text in ("[]", "segments: 3", "- 5", "{", "- {axis: roll}"):
        file.write_text(text)
        with pytest.raises((SimulateError, ParameterError, VehicleError)):
            read_manoeuvre(file)
    laughs = ["a0: &a0 [x, x]", *(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 40))]
    file.write_text("\n".join([*laughs, "segments: [{axis: *a39, kind: doublet}]"]))
    with pytest.raises(VehicleError, match="anchors and aliases"):
        read_manoeuvre(file)
    with pytest.raises(SimulateError, match="no manoeuvre file"):
        read_manoeuvre(tmp_path / "none.yaml")


def test_live_mavlink_arrives_in_real_time() -> None:
    flight = fly(PELICAN, seconds=1.0, seed=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(600.0)
        sender = threading.Thread(
            target=stream, args=(f"udpout:127.0.0.1:{receiver.getsockname()[1]}", flight.recording)
        )
        sender.start()
        kinds: dict[int, int] = {}
        while sender.is_alive() or not kinds:
            frame = receiver.recv(512)
            assert frame[0] == 0xFD
            kind = int.from_bytes(frame[7:10], "little")
            kinds[kind] = kinds.get(kind, 0) + 1
            if kinds.get(105, 0) == 50 and kinds.get(31, 0) == 50:
                break
        sender.join()
    assert kinds[0] >= 1  # HEARTBEAT
    assert kinds[105] == 50  # HIGHRES_IMU


def test_targets() -> None:
    check_target("udpout:127.0.0.1:14550")
    for wrong in ("udpout:host", "udpout::14550", "udpout:host:99999", "flight"):
        with pytest.raises(SimulateError):
            check_target(wrong)
