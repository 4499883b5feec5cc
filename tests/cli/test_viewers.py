"""Results in other viewers: public readers open them, and every curve of the shipped layouts is in the files."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from quadid_node.inputs import source
from quadid_node.messages import TOPICS
from quadid_replay import write_mcap
from quadid_replay.ros_messages import TYPES
from quadid_replay.schemas import has_definition, schema_text
from rosbags.highlevel import AnyReader

from quadid.flight import fly
from quadid.vehicle import Vehicle
from tests.commands import Cli

ROOT = Path(__file__).resolve().parents[2]


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


LAYOUTS = ROOT / "docs" / "layouts"
PANELS = json.loads((LAYOUTS / "foxglove.json").read_text(encoding="utf-8"))["configById"]
FOXGLOVE = [p["value"].partition(".")[::2] for panel in PANELS.values() for p in panel.get("paths", ())]
"""Topic and field of each curve."""
PLOTJUGGLER = [c.attrib["name"] for c in ET.parse(LAYOUTS / "plotjuggler.xml").getroot().iter("curve")]


def plotjugglers(topic: str, field: str) -> str:
    """Name that PlotJuggler gives to a field: one of sensor_msgs/JointState is called by its joint."""
    if topic.strip("/") == "rotor_speeds":
        name, place = field.rstrip("]").split("[")
        return f"{topic}/rotor_{int(place) + 1}/{name}"
    return f"{topic}/{field.replace('.', '/')}"


def test_the_layouts_show_the_same_curves() -> None:
    assert [plotjugglers(topic, field) for topic, field in FOXGLOVE] == PLOTJUGGLER


def test_what_quadid_writes_is_shown_from_its_files_and_live(messages: dict[str, Any]) -> None:
    """Files of quadid name topics without a slash; ROS, and what `ros2 bag record` writes, with one."""
    ours = [(topic, field) for topic, field in FOXGLOVE if not topic.startswith("/")]
    assert {topic for topic, _ in ours} >= {"imu", "rotor_speeds", "quadid/parameters", "quadid/candidate"}
    for topic, field in ours:
        assert (f"/{topic}", field) in FOXGLOVE
        if topic in messages:
            assert isinstance(_field(messages[topic], field), float)
            assert topic != "rotor_speeds" or messages[topic].name[0] == "rotor_1"


def test_every_curve_is_of_a_topic_and_a_field_that_a_live_system_has() -> None:
    """Inputs: of a preset, and read by the node; what the node says: by the definition of the message."""
    read = {f"/{i.topic}": i.type for name in ("canonical", "mavros", "px4") for i in source(name).inputs}
    said = {f"/{topic.lstrip('/')}": kind for topic, kind in TOPICS.values()}
    kinds = {**read, **said}
    for topic, field in FOXGLOVE:
        kind = kinds[f"/{topic.lstrip('/')}"]
        names = re.findall(r"[A-Za-z_]\w*", field)
        if has_definition(kind):
            package, text = kind.split("/")[0], schema_text(kind)
            for name in names:
                declared = re.search(rf"^(\S+?)(?:\[\d*\])?\s+{name}\b", text, re.M)
                assert declared is not None, f"{topic}.{field}"
                if not declared[1].islower() and name != names[-1]:
                    text = schema_text(declared[1] if "/" in declared[1] else f"{package}/{declared[1]}")
        else:
            asked = Asked()
            TYPES[kind].blocks(asked)
            assert asked.names >= {*names}, f"{topic}.{field}"
    assert {p["topicPath"] for p in PANELS.values() if "topicPath" in p} <= set(said)


class Asked:
    """A message that notes which fields are asked for."""

    def __init__(self, names: set[str] | None = None) -> None:
        self.names = set[str]() if names is None else names

    def __getattr__(self, name: str) -> Any:
        self.names.add(name)
        return 0 if name == "actuator_function" else 1 if name == "esc_count" else Asked(self.names)

    def __iter__(self) -> Iterator[Any]:
        return iter([Asked(self.names)])

    def __getitem__(self, k: int) -> Any:
        return Asked(self.names)

    def __abs__(self) -> float:
        return 0.0

    def __float__(self) -> float:
        return 0.0


def test_every_panel_of_the_foxglove_layout_is_shown() -> None:
    layout = json.loads((LAYOUTS / "foxglove.json").read_text(encoding="utf-8"))["layout"]

    def leaves(node: Any) -> list[str]:
        if isinstance(node, str):
            tabs = PANELS[node].get("tabs", ())
            return [node, *(leaf for tab in tabs for leaf in leaves(tab["layout"]))]
        return leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout)) == sorted(PANELS)


def _field(message: Any, path: str) -> Any:
    """A field such as ``velocity[2]`` or ``angular_velocity.x``."""
    for name, index in re.findall(r"(\w+)(?:\[(\d+)\])?", path):
        message = getattr(message, name)
        message = message[int(index)] if index else message
    return message
