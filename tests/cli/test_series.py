"""Flights over time as files: `--series`, drawn vehicles, and public viewers that open both."""

import json
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from quadid_node.inputs import source
from quadid_node.messages import TOPICS
from quadid_replay import write_mcap
from quadid_replay.ros_messages import TYPES
from quadid_replay.schemas import has_definition, schema_text
from rosbags.highlevel import AnyReader

import quadid
from quadid.app.outcome import json_text
from quadid.app.simulate import simulate_draws
from quadid.errors import ParameterError, VehicleError
from quadid.flight import fly
from quadid.vehicle import ParameterPrior, RandomForces, RandomInput, Vehicle
from tests.cli.conftest import Flights, table
from tests.commands import Cli, one_line

# --- `--series`: simulated against measured as files that public readers open, with the errors that the result states


RATES = "pqr"


@pytest.fixture(scope="module")
def result(quadid: Cli, flights: Flights, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("series")
    run = quadid(
        "identify",
        flights.train,
        "--validate",
        flights.unseen,
        "--vehicle",
        "pelican",
        "--out",
        folder,
        "--series",
        folder / "over" / "time",
        "--json",
        "-",
    )
    assert run.code == 0, run.err
    return dict(run.data)


def test_one_file_a_log_and_form(result: dict[str, Any]) -> None:
    names = [f"{log}.simulated.{kind}" for log in ("train.mcap", "unseen.csv") for kind in ("csv", "mcap")]
    missing = ["train.mcap.missing.csv", "unseen.csv.missing.csv"]
    assert [Path(path).name for path in result["series"]] == [*names, *missing]


def test_what_is_missing_stands_in_newtons_with_its_bands(result: dict[str, Any]) -> None:
    """Of exact flights nearly nothing is missing; the file over time says what the result says of them."""
    missing = result["missing"]
    assert [s["role"] for s in missing["sets"]] == ["train", "validate"]
    assert missing["force"]["of"] == pytest.approx(1.3 * 9.80665)
    assert (missing["force"]["unit"], missing["moment"]["of_what"]) == ("N", "rms control moment")
    for axis in "xyz":
        assert missing["force"]["nominal"][axis] < 0.01 * missing["force"]["of"]
        assert missing["moment"]["nominal"][axis] < 0.1 * missing["moment"]["of"][axis]
        low, high = missing["moment"]["nominal_ci95"][axis]
        assert low <= missing["moment"]["nominal"][axis] <= high
    names, rows = table(Path(result["series"][-2]))
    force, sigma = (rows[:, names.index(f"nominal/{name}_x")] for name in ("force", "force_sigma"))
    stated = missing["sets"][0]["force"]["nominal"]["x"]
    assert np.sqrt(np.mean(force**2 + sigma**2)) == pytest.approx(stated, rel=1e-4)


def test_the_csv_holds_the_stated_errors(result: dict[str, Any]) -> None:
    names, rows = table(Path(result["series"][0]))
    assert names[:4] == ["t", "measured/p", "measured/q", "measured/r"]
    assert {"simulated/phi", "before/az"} <= set(names)
    for rate in RATES:
        measured, simulated = (rows[:, names.index(f"{which}/{rate}")] for which in ("measured", "simulated"))
        stated = result["sets"][0]["rmse"][rate]["value"]
        assert np.sqrt(np.nanmean((simulated - measured) ** 2)) == pytest.approx(stated, rel=1e-6)


def test_the_mcap_holds_the_same_in_the_frames_of_ros(result: dict[str, Any]) -> None:
    names, rows = table(Path(result["series"][0]))
    pitch: dict[str, list[float]] = {which: [] for which in ("measured", "simulated", "before")}
    with Path(result["series"][1]).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        stamps, topics, force = [], set(), []
        for _, channel, message, decoded in reader.iter_decoded_messages():
            stamps.append(message.log_time)
            which, _, topic = channel.topic.partition("/")
            topics.add(channel.topic)
            if topic == "imu":
                pitch[which].append(decoded.angular_velocity.y)
            if channel.topic == "missing/nominal":
                force.append(decoded.wrench.force.z)
    assert stamps == sorted(stamps)
    for which, values in pitch.items():
        np.testing.assert_allclose(values, -rows[:, names.index(f"{which}/q")], rtol=1e-12)
    assert {"innovation/nominal/imu", "missing/nominal", "missing/nominal/sigma"} <= topics
    names, rows = table(Path(result["series"][-2]))
    np.testing.assert_allclose(force, -rows[:, names.index("nominal/force_z")], rtol=1e-6, atol=1e-12)


def test_innovations_of_an_exact_model_are_white_and_as_large_as_stated(result: dict[str, Any]) -> None:
    names, rows = table(Path(result["series"][-1]))
    for rate in RATES:
        found, sigma = (rows[:, names.index(f"nominal/{name}_{rate}")] for name in ("innovation", "innovation_sigma"))
        whitened = found / sigma
        assert np.nanmean(whitened**2) == pytest.approx(1.0, abs=0.1)
        assert abs(np.nanmean(whitened[1:] * whitened[:-1])) < 0.08


def test_a_file_where_the_folder_should_be_is_refused_before_anything_is_read(inside: Cli, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    line = one_line(inside("diagnose", "none.mcap", "--vehicle", "pelican", "--series", tmp_path / "taken"), 2)
    assert "taken" in line


# --- `quadid simulate --draws`: vehicles within the file's uncertainty, each flown under random forces of its own


RANDOM = RandomForces(
    horizontal=RandomInput(sigma=0.8, time=0.5),
    vertical=RandomInput(sigma=0.3, time=0.3),
    roll_pitch=RandomInput(sigma=2.0, time=0.2),
    yaw=RandomInput(sigma=0.5, time=0.5),
)


def uncertain(share: float = 0.02, random: RandomForces | None = RANDOM) -> Vehicle:
    pelican = Vehicle.shipped("pelican")
    priors = {n: ParameterPrior(initial=p.initial, sigma=share * p.initial) for n, p in pelican.parameters.items()}
    return pelican.model_copy(update={"parameters": priors, "random": random})


def test_draws_spread_as_the_file_says_and_repeat_with_their_seed() -> None:
    draws = simulate_draws(uncertain(), 30, seed=4, seconds=0.5)
    logs = np.log([[d.vehicle.parameters[n].initial for n in ("b", "d", "J_xx")] for d in draws])
    assert np.all(np.abs(np.std(logs, axis=0) / 0.02 - 1.0) < 0.5)
    assert [d.seed for d in draws] == list(range(4, 34))
    again = simulate_draws(uncertain(), 2, seed=4, seconds=0.5)
    assert json_text(again[1].entry) == json_text(draws[1].entry)


def test_values_that_were_found_together_are_drawn_together() -> None:
    file = Vehicle.from_yaml(uncertain().to_yaml() + "correlation: {J_xx: {b: 0.95}}\n")
    draws = simulate_draws(file, 40, seed=1, seconds=0.2)
    b, J = np.log([[d.vehicle.parameters[n].initial for n in ("b", "J_xx")] for d in draws]).T
    assert np.corrcoef(b, J)[0, 1] > 0.85
    with pytest.raises(VehicleError, match="did you mean 'J_xx'"):
        Vehicle.from_yaml(uncertain().to_yaml() + "correlation: {J_x: {b: 0.9}}\n")
    with pytest.raises(VehicleError, match="less than or equal to 1"):
        Vehicle.from_yaml(uncertain().to_yaml() + "correlation: {J_xx: {b: 1.2}}\n")


def test_random_forces_act_in_every_draw(tmp_path: Path) -> None:
    """The same vehicle and sticks with and without them; what differs has their size."""
    one, calm = (simulate_draws(uncertain(1e-6, r), 1, seed=7, seconds=20.0)[0].flown for r in (RANDOM, None))
    assert one is not None
    assert calm is not None
    felt = one.flight.window.accel - calm.flight.window.accel  # type: ignore[operator]
    assert 0.5 < np.std(felt[:, 0]) < 1.3
    turned = one.flight.truth.rates - calm.flight.truth.rates
    assert np.std(turned[:, 0]) > 0.05


def test_logs_get_numbers_and_their_seeds_are_told(inside: Cli, tmp_path: Path) -> None:
    file = uncertain().save(tmp_path / "mine.yaml")
    run = inside(
        "simulate",
        tmp_path / "out.csv",
        "--vehicle",
        file,
        "--draws",
        "3",
        "--seconds",
        "5",
        "--seed",
        "2",
        "--json",
        "-",
    )
    assert run.code == 0, run.err
    assert run.data["diverged"] == 0
    assert [d["seed"] for d in run.data["draws"]] == [2, 3, 4]
    assert [Path(d["log"]).name for d in run.data["draws"]] == ["out-1.csv", "out-2.csv", "out-3.csv"]
    assert all(d["diverged"] is None for d in run.data["draws"])
    assert quadid.load(run.data["draws"][2]["log"], vehicle=file).windows


def test_a_draw_that_diverges_says_so(inside: Cli, tmp_path: Path) -> None:
    wild = RANDOM.model_copy(update={"roll_pitch": RandomInput(sigma=400.0, time=0.5)})
    file = uncertain(0.02, wild).save(tmp_path / "wild.yaml")
    run = inside("simulate", tmp_path / "out.csv", "--vehicle", file, "--draws", "2", "--seconds", "5")
    assert run.code == 3
    assert "out-1.csv: diverged, the vehicle crashed" in run.out
    assert not (tmp_path / "out-1.csv").exists()
    assert "all 2 vehicles diverged" in run.err


def test_impossible_numbers_of_draws_are_refused(inside: Cli, tmp_path: Path) -> None:
    for draws in (0, 100000):
        with pytest.raises(ParameterError, match="1 to"):
            simulate_draws("pelican", draws)
    one_line(inside("simulate", "udpout:127.0.0.1:14550", "--draws", "2"), 2)


# --- Results in other viewers: public readers open them, and every curve of the shipped layouts is in the files


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
            for run in TYPES[kind].runs:
                run(asked)
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
