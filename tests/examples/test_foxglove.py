"""The Foxglove example, seen by a viewer of its own: every topic announced as in the file, every message delivered."""

from __future__ import annotations

import asyncio
import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from quadid_replay import write_mcap

from quadid.flight import fly
from quadid.vehicle import Vehicle

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
        stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(repository)},
    )  # fmt: skip
    assert done.stdout is not None
    port = re.search(r":(\d+)$", done.stdout.readline().strip())
    assert port is not None
    with ThreadPoolExecutor(1) as apart:  # another test's browser may keep a loop of events in this thread
        channels, got = apart.submit(asyncio.run, asyncio.wait_for(watch(int(port[1])), 120.0)).result()
    assert done.wait(60) == 0
    assert channels["imu"]["schemaName"] == "sensor_msgs/msg/Imu"
    assert channels["imu"]["encoding"] == "cdr"
    assert len(got["imu"]) == round(SECONDS * 50)
    told = channels["imu"]
    schema = Schema(told["id"], told["schema"].encode(), told["schemaEncoding"], told["schemaName"])
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    assert decoder(got["imu"][-1]).linear_acceleration.z == pytest.approx(9.8, abs=8.0)
