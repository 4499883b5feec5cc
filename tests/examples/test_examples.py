"""The examples run as they stand, Foxglove's with a viewer of its own; ROS's are run by tests/node/test_ros_node.py."""

import asyncio
import importlib.util
import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from quadid_replay import write_csv, write_mcap

from quadid.errors import WindowError
from quadid.flight import TruthParameters, fly
from quadid.model.layout import Layout
from quadid.model.step import simulate
from quadid.vehicle import GRAVITY, ParameterPrior, Vehicle
from tests.commands import Cli

# --- The examples run as they stand; the one for ROS 2 is run by tests/node/test_ros_node.py


def run(
    repository: Path, name: str, *arguments: str | Path, cwd: Path | None = None, code: int = 0
) -> subprocess.CompletedProcess[str]:
    """An example in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(repository / "examples" / name), *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(repository), os.environ.get("PYTHONPATH", "")])},
    )
    assert done.returncode == code, done.stderr
    return done


def module(repository: Path, name: str) -> Any:
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, repository / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    out = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(out)
    return out


def test_identify_in_ten_lines(repository: Path, tmp_path: Path) -> None:
    write_mcap(tmp_path / "flight.mcap", fly(Vehicle.shipped("pelican"), seconds=30.0, seed=4).recording)
    out = run(repository, "identify.py", tmp_path / "flight.mcap", cwd=tmp_path).stdout
    assert float(re.findall(r"Thrust coefficient b +([0-9.e-]+)", out)[0]) == pytest.approx(2.33e-5, rel=0.01)
    assert Vehicle.from_yaml((tmp_path / "fitted.yaml").read_text(encoding="utf-8")).name == "pelican"
    text = (repository / "examples" / "identify.py").read_text(encoding="utf-8")
    code = [line for line in text.splitlines() if line.strip() and not line.startswith(('"""', "#"))]
    assert len(code) <= 10


def test_the_example_refuses_what_the_command_refuses(repository: Path, inside: Cli, tmp_path: Path) -> None:
    recording = fly(Vehicle.shipped("pelican"), seconds=30.0, seed=4).recording
    speed = recording.channels["rotor_speed"]
    swapped = replace(speed, values=speed.values[:, [1, 0, 3, 2]])
    log = tmp_path / "flight.csv"
    write_csv(log, replace(recording, channels={**recording.channels, "rotor_speed": swapped}))
    done = run(repository, "identify.py", log, cwd=tmp_path, code=1)
    command = inside("identify", log, "--vehicle", "pelican", "--out", tmp_path)
    assert command.code == 2
    line = command.err.strip().removeprefix("quadid: ")
    assert "order" in line
    assert line in done.stderr
    assert not (tmp_path / "fitted.yaml").exists()


def test_the_extended_model_in_ones_own_simulator(repository: Path) -> None:
    out = run(repository, "own_simulator.py").stdout
    assert "effects in the file: motor_lag" in out
    nominal, extended = (int(t) for t in re.findall(r"after (\d+) ms", out))
    assert extended > nominal + 10


def test_an_effect_of_ones_own(repository: Path) -> None:
    out = run(repository, "own_effect.py").stdout
    knee, true, share = (float(v) for v in re.findall(r"(?:knee|true|share) ([0-9.]+)", out)[:3])
    before, after = (float(v) for v in re.findall(r"([0-9.]+) with", out))
    assert knee == pytest.approx(true, rel=0.01)
    assert share == pytest.approx(0.5, abs=0.1)
    assert after < 0.5 * before


def test_simulate_hovers_falls_and_starts_where_it_is_told() -> None:
    pelican = Vehicle.shipped("pelican")
    hover = np.full((50, 4), pelican.hover_speed())
    still = simulate(pelican, hover, 0.02)
    assert np.abs(still.velocity).max() < 1e-9
    np.testing.assert_allclose(still.force[:, 2], -GRAVITY, rtol=1e-9)
    fall = simulate(pelican, 0.0 * hover, 0.02, velocity=np.array([1.0, 0.0, 0.0]), position=np.array([0.0, 0.0, -9.0]))
    np.testing.assert_allclose(fall.velocity[:, 2], GRAVITY * fall.t, rtol=1e-9)
    np.testing.assert_allclose(fall.position[:, 2], -9.0 + 0.5 * GRAVITY * fall.t**2, rtol=1e-9)
    np.testing.assert_allclose(fall.position[:, 0], fall.t, rtol=1e-9)
    with pytest.raises(WindowError, match="rotor speeds of shape"):
        simulate(pelican, hover[:, :3], 0.02)


def test_the_identified_vehicle_flies_closer_to_the_circle(repository: Path) -> None:
    """The controller of the example, with the guesses of the file and with what a diagnosis finds."""
    pytest.importorskip("casadi")
    example = module(repository, "casadi_mpc")
    guess = Vehicle.shipped("pelican")
    truth = {n: ParameterPrior(initial=v) for n, v in TruthParameters.of(guess).as_dict().items()}
    found = guess.model_copy(update={"parameters": truth, "effects": example.HIDDEN})
    missed = [example.circled(v, guess, example.WEIGHTS["firm"], 1.6) for v in (guess, found)]
    far = [float(np.sqrt(np.mean(m[20:] ** 2))) for m in missed]
    assert far[1] < 0.6 * far[0]


def test_a_policy_learns_over_the_vehicles_of_a_fit(repository: Path) -> None:
    env_checker = pytest.importorskip("gymnasium.utils.env_checker")
    example = module(repository, "gym_hover")
    vehicle = Vehicle.shipped("pelican")
    thetas = np.repeat(Layout(vehicle).initial(vehicle)[None], 5, axis=0)
    thetas[:, :6] *= np.exp(0.1 * np.random.default_rng(0).standard_normal((5, 6)))
    env = example.Hover(vehicle, thetas)
    env_checker.check_env(env, skip_render_check=True)
    first, again = (example.flown(env, np.zeros((4, 12)), 3) for _ in range(2))
    assert first == again
    _, curve = example.learn(env, 18)
    assert np.mean(curve[-3:]) > 1.5 * curve[0]


# --- The Foxglove example, seen by a viewer of its own: every topic announced as in the file, every message delivered


pytest.importorskip("foxglove", reason="pip install .[foxglove]")
SECONDS = 5.0


async def watch(port: int) -> tuple[dict[str, Any], dict[str, list[bytes]]]:
    """Subscribes to everything a server announces; returns its channels and the messages of each, by topic."""
    from tornado.websocket import websocket_connect

    viewer = await websocket_connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])
    channels: dict[str, Any] = {}
    got: dict[str, list[bytes]] = {}
    topic: dict[int, str] = {}
    while (message := await viewer.read_message()) is not None:
        if isinstance(message, bytes):
            # 1: message data; 4 bytes subscription (or channel), 8 bytes time, then the message
            if message[0] == 1:
                got.setdefault(topic[int.from_bytes(message[1:5], "little")], []).append(message[13:])
            continue
        told = json.loads(message)
        if told["op"] == "advertise":
            for channel in told["channels"]:
                channels[channel["topic"]] = channel
                topic[channel["id"]] = channel["topic"]
            wanted = [{"id": c["id"], "channelId": c["id"]} for c in told["channels"]]
            await viewer.write_message(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    return channels, got


def test_a_viewer_gets_every_topic_and_message(repository: Path, tmp_path: Path) -> None:
    log = tmp_path / "flight.mcap"
    write_mcap(log, fly(Vehicle.shipped("pelican"), seconds=SECONDS, seed=1).recording)
    command = [sys.executable, "-u", str(repository / "examples" / "foxglove_live.py"), str(log)]
    done = subprocess.Popen(
        [*command, "--port", "0", "--speed", "5"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(repository)},
    )
    assert done.stdout is not None
    port = re.search(r":(\d+)$", done.stdout.readline().strip())
    assert port is not None
    with ThreadPoolExecutor(1) as apart:  # another test's browser may keep a loop of events in this thread
        channels, got = apart.submit(asyncio.run, asyncio.wait_for(watch(int(port[1])), 1500.0)).result()
    assert done.wait(1500) == 0
    assert channels["imu"]["schemaName"] == "sensor_msgs/msg/Imu"
    assert channels["imu"]["encoding"] == "cdr"
    assert len(got["imu"]) == round(SECONDS * 50)
    told = channels["imu"]
    schema = Schema(told["id"], told["schema"].encode(), told["schemaEncoding"], told["schemaName"])
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    assert decoder(got["imu"][-1]).linear_acceleration.z == pytest.approx(9.8, abs=8.0)
