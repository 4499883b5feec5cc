"""Results in other viewers: public readers open them, and every curve of the shipped layouts is in the files."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from quadid_replay import write_mcap
from rosbags.highlevel import AnyReader

from quadid.flight import fly
from quadid.vehicle import Vehicle
from tests.cli.conftest import Cli


@pytest.fixture(scope="module")
def files(quadid: Cli, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A flight long enough for the gate, and what the online session made of it."""
    folder = tmp_path_factory.mktemp("result")
    log, result = folder / "flight.mcap", folder / "result.mcap"
    write_mcap(log, fly(Vehicle.shipped("pelican"), seconds=45.0, seed=10).recording)
    run = quadid("replay", log, "--vehicle", "pelican", "--speed", "max", "--out", result)
    assert run.code == 0, run.out + run.err
    return [log, result]


@pytest.fixture(scope="module")
def messages(files: list[Path]) -> dict[str, Any]:
    """The last message of every topic, decoded by the public mcap packages."""
    last = {}
    for file in files:
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for _, channel, _, message in reader.iter_decoded_messages():
                last[channel.topic] = message
    return last


def test_rosbags_reads_every_message(files: list[Path], messages: dict[str, Any]) -> None:
    seen: Counter[str] = Counter()
    for file in files:
        with AnyReader([file]) as reader:
            for connection, _, raw in reader.messages():
                reader.deserialize(raw, connection.msgtype)
                seen[connection.topic.lstrip("/")] += 1
    assert set(seen) == {topic.lstrip("/") for topic in messages}
    assert seen["imu"] == 2250


def test_every_curve_of_the_foxglove_layout_is_there(repository: Path, messages: dict[str, Any]) -> None:
    layout = json.loads((repository / "docs" / "layouts" / "foxglove.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    paths = [p["value"] for panel in panels.values() for p in panel.get("paths", ())]
    assert len(paths) == 14
    for path in paths:
        topic, fields = path.split(".", 1)
        assert isinstance(_field(messages[topic], fields), float)

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)


def test_every_curve_of_the_plotjuggler_layout_is_there(repository: Path, messages: dict[str, Any]) -> None:
    root = ET.parse(repository / "docs" / "layouts" / "plotjuggler.xml").getroot()
    names = [curve.attrib["name"] for curve in root.iter("curve")]
    assert len(names) == 14
    for name in names:
        topic = next(t for t in messages if name.startswith(f"{t}/"))
        assert isinstance(_field(messages[topic], name[len(topic) + 1 :].replace("/", ".")), float)


def _field(message: Any, path: str) -> Any:
    """A field such as ``velocity[2]`` or ``angular_velocity.x``."""
    for name, index in re.findall(r"(\w+)(?:\[(\d+)\])?", path):
        message = getattr(message, name)
        message = message[int(index)] if index else message
    return message
