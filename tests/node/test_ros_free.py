"""Parts of the node that need no ROS: imports, sources, parameters, launch arguments, mistakes of publishers named."""

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from quadid_node.inputs import DECIDE, SILENT, SourceSelector, source, stamp
from quadid_node.messages import WARN, diagnostics
from quadid_node.process import ARGUMENTS, NODE_ARGUMENTS, PARAMETERS, THREADS, fleet, parameters, truth
from quadid_node.recording import stream
from quadid_node.service import Service, check_change, read_settings, vehicle_id
from quadid_node.worker import InlineWorker
from quadid_replay import open_log, write_mcap
from quadid_replay.ros_messages import TYPES

from quadid.data.window import Block
from quadid.errors import QuadidError
from quadid.online import SessionSettings
from quadid.parameters import Status
from quadid.vehicle import GRAVITY
from quadid_node import messages
from tests.node.aggregator import branches
from tests.node.launch_stand_in import GroupAction, Node, launched
from tests.online.driving import EPOCH, flight, samples
from tests.online.made_up import PELICAN
from tests.online.test_gate import TRUE, online_set

# --- What must hold without ROS: imports, the choice of sources, the table of parameters, messages as dictionaries


def test_everything_but_the_nodes_imports_without_ros() -> None:
    code = (
        "import sys\n"
        "class Block:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('rclpy', 'quadid_msgs', 'sensor_msgs', 'std_srvs', 'rcl_interfaces'):\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Block())\n"
        "import quadid_node.service, quadid_node.history, quadid_node.worker, quadid_node.inputs, quadid_node.zenoh\n"
        "import quadid_node.service, quadid_node.recording, quadid_node.mavlink_link, quadid_node.process\n"
        "import quadid.cli.replay, quadid.cli.serve, quadid.cli.serve, quadid.cli.history\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("given", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_linear_algebra_of_the_node_takes_one_thread_unless_told_otherwise(given: dict[str, str], used: str) -> None:
    """Two threads took eight times as long for a fit's reply on a machine at load 13: each waits for the other."""
    code = (
        "import os, sys; from quadid_node import identify\n"
        "assert 'numpy' not in sys.modules, 'too late to choose'\n"
        "identify._run = lambda *_: print(os.environ['OPENBLAS_NUM_THREADS'])\n"
        "identify.main()\n"
    )
    unset = {n: v for n, v in os.environ.items() if n not in THREADS}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=unset | given)
    assert done.stdout.split()[-1] == used


def test_the_shipped_configuration_names_only_declared_parameters(repository: Path) -> None:
    text = (repository / "quadid_node" / "config" / "quadid.yaml").read_text(encoding="utf-8")
    given = yaml.safe_load(text)["/**"]["ros__parameters"]
    known = {p.name: p for p in PARAMETERS}
    for name, value in given.items():
        assert name in known
        assert isinstance(value, type(known[name].default))


def test_defaults_make_settings_and_every_number_has_its_range() -> None:
    settings = read_settings({p.name: p.default for p in PARAMETERS})
    assert settings.window == 10.0
    assert settings.gate.approval == "auto"
    for p in PARAMETERS:
        assert p.description.endswith(".")
        if isinstance(p.default, int | float) and not isinstance(p.default, bool):
            assert p.span is not None
            assert p.span[0] <= p.default <= p.span[1]


def test_changes_at_run_time_are_refused_with_the_reason() -> None:
    assert check_change("approval", "manual") == ""
    assert "approval" in check_change("approval", "sometimes")
    assert "configured" in check_change("vehicle", "hexacopter")
    assert check_change("use_sim_time", True) == ""


def test_the_namespace_names_the_vehicle_of_a_fleet() -> None:
    from quadid.vehicle import Vehicle

    pelican = Vehicle.shipped("pelican")
    assert vehicle_id("", "/", pelican) == "pelican"
    assert vehicle_id("", "/fleet/quad1", pelican) == "fleet/quad1"
    assert vehicle_id("", "/fleet_quad1", pelican) == "fleet_quad1", "another vehicle"
    assert vehicle_id("mine", "/quad1", pelican) == "mine"


@pytest.mark.parametrize("name", ["canonical", "mavros", "px4", "ardupilot", "rotors"])
def test_every_preset_topic_has_a_type_that_can_be_read_and_feeds_something(name: str) -> None:
    preset = source(name)
    for entry in preset.inputs:
        assert entry.type in TYPES
        assert entry.channels
    fed = {channel for entry in preset.inputs for channel, _ in entry.channels}
    assert {"gyro", "accel", "attitude"} <= fed
    assert ("rotor_speed" in fed) or ("motor_command" in fed) or name == "ardupilot"
    assert preset.motor_hint


def test_px4_is_heard_with_and_without_the_version_of_its_messages() -> None:
    fed = {entry.topic: entry.channels for entry in source("px4").inputs}
    for name in ("vehicle_attitude", "vehicle_local_position", "battery_status", "vehicle_attitude_setpoint"):
        assert fed[f"fmu/out/{name}_v1"] == fed[f"fmu/out/{name}"]


def test_an_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(QuadidError, match="did you mean 'mavros'"):
        source("mavross")


def at(*t: float) -> Block:
    return Block(np.array(t), (("attitude", np.arange(4.0 * len(t)).reshape(-1, 4)),))


def times(blocks: Iterable[Block]) -> list[float]:
    return [t for block in blocks for t in block.t.tolist()]


def test_the_better_source_is_used_from_its_first_sample() -> None:
    chooser = SourceSelector({"attitude": 0})
    assert list(chooser.take(at(0.0), 1)) == []
    assert times(chooser.take(at(0.1), 0)) == [0.1]
    assert list(chooser.take(at(0.2), 1)) == []
    assert times(chooser.take(at(0.3), 0)) == [0.3]


def test_a_lone_worse_source_is_used_without_loss() -> None:
    chooser, got = SourceSelector({"attitude": 0}), []
    for k in range(30):
        got += times(chooser.take(at(0.1 * k), 1))
    assert got == [0.1 * k for k in range(30)]
    assert DECIDE < 2.9


def test_a_source_that_falls_silent_gives_way() -> None:
    chooser = SourceSelector({"attitude": 0})
    list(chooser.take(at(0.0), 0))
    got = times(block for k in range(80) for block in chooser.take(at(0.1 * k), 1))
    assert got
    assert min(got) > SILENT


@pytest.mark.parametrize("seed", range(20))
def test_how_samples_are_cut_into_blocks_changes_nothing(seed: int) -> None:
    """Two or three sources that come, fall silent and come back, in any order of arrival."""
    rng = np.random.default_rng(seed)
    runs = [
        (int(rank), np.sort(start + rng.uniform(0.0, 3.0, 12)))
        for start in np.arange(0.0, 40.0, 2.5)
        for rank in rng.permutation(3)
        if rng.random() < 0.5
    ]
    best = {"attitude": int(rng.integers(2))}
    whole, single = SourceSelector(best), SourceSelector(best)
    for rank, t in runs:
        one_by_one = [s for k in t for block in single.take(at(k), rank) for s in times([block])]
        assert times(whole.take(at(*t), rank)) == one_by_one


def test_stamps_come_back_to_the_nanosecond(tmp_path: Path) -> None:
    recording = flight(4.0).recording
    write_mcap(tmp_path / "f.mcap", recording, epoch_ns=1_700_000_123 * 10**9)
    read = open_log(tmp_path / "f.mcap")
    assert read.epoch == 1_700_000_123
    first = next(iter(stream(read)))
    assert stamp(float(first.t[0])) == {"sec": 1_700_000_123, "nanosec": 0}


def test_a_set_carries_its_mass_whether_it_is_out_of_date_and_what_is_unreliable() -> None:
    item = replace(online_set(TRUE), mass=1.3, outdated="mass +15 % since", start=1.7e9, stop=1.7e9 + 30.25)
    told = messages.parameter_set(item, "quad1", "ab" * 16)
    assert (told["mass"], told["out_of_date"], told["out_of_date_reason"]) == (1.3, True, "mass +15 % since")
    assert told["out_of_date_code"] == "unknown_cause", "a set of a version that noted no code"
    assert messages.parameter_set(replace(item, outdated_code="mass_change"), "q")["out_of_date_code"] == "mass_change"
    assert messages.parameter_set(replace(item, outdated=""), "q")["out_of_date_code"] == ""
    assert told["boot_id"] == "ab" * 16
    assert told["window_end"] == {"sec": 1_700_000_030, "nanosec": 250_000_000}
    assert set(messages.STATUSES) >= {s.value for s in Status}
    assert messages.STATUSES["unreliable"] == 4


# --- What launch arguments become: only those given override the configuration; a fleet has its own of each


ROOT = Path(__file__).resolve().parents[2]
LAUNCH = ROOT / "quadid_node" / "launch"


def test_what_is_not_given_leaves_the_configuration_alone() -> None:
    """`approval: manual` in the file once became auto, by the default of a launch argument."""
    nothing = dict.fromkeys(ARGUMENTS, "")
    assert parameters(nothing) == {}
    assert parameters({**nothing, "approval": "manual", "observer": "true"}) == {"approval": "manual", "observer": True}
    text = (LAUNCH / "identify.launch.py").read_text(encoding="utf-8")
    assert re.findall(r'DeclareLaunchArgument\(k, default_value=("?\w*"?)', text) == ['""', "v"]


def test_every_argument_is_a_parameter_of_the_node() -> None:
    known = {p.name: p.default for p in PARAMETERS} | {"use_sim_time": False}
    assert set(ARGUMENTS) <= set(known)
    for name, value in parameters(dict.fromkeys(ARGUMENTS, "false")).items():
        assert type(value) is type(known[name]), name
    assert {"record", "history", "observer", "autostart"} <= set(ARGUMENTS)
    assert {"log_level", "respawn"} <= set(NODE_ARGUMENTS)


def test_a_fleet_has_a_vehicle_and_a_configuration_each() -> None:
    given = {"vehicle": "a.yaml, b.yaml", "config": "a_node.yaml,b_node.yaml", "source": "mavros"}
    assert fleet("quad1,quad2", given) == [
        {"namespace": "quad1", "vehicle": "a.yaml", "config": "a_node.yaml", "source": "mavros"},
        {"namespace": "quad2", "vehicle": "b.yaml", "config": "b_node.yaml", "source": "mavros"},
    ]
    with pytest.raises(ValueError, match="one for each of the 3 vehicles or one for all"):
        fleet("a,b,c", {"vehicle": "x,y"})
    with pytest.raises(ValueError, match="give one for each of the 2 vehicles,"):
        fleet("a,b", {"record": "run.mcap"})
    with pytest.raises(ValueError, match="give each vehicle its own"):
        fleet("a,a", {})


def test_a_truth_value_that_is_none_is_refused() -> None:
    assert truth("respawn", "True")
    with pytest.raises(ValueError, match="respawn:=yes: true or false"):
        truth("respawn", "yes")


def test_the_launch_file_of_one_node_overrides_what_is_given_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    file = LAUNCH / "identify.launch.py"
    (plain,) = launched(file, {}, monkeypatch)
    assert isinstance(plain, Node)
    _, overrides = plain.named["parameters"]
    assert overrides == {}, "approval: manual of the configuration file stays"
    assert (plain.named["package"], plain.named["executable"]) == ("quadid_node", "identify")
    assert (plain.named["ros_arguments"], plain.named["respawn"]) == ([], False)
    given = {"vehicle": "x.yaml", "approval": "manual", "observer": "true", "log_level": "debug", "respawn": "true"}
    (told,) = launched(file, given, monkeypatch)
    assert told.named["parameters"][1] == {"vehicle": "x.yaml", "approval": "manual", "observer": True}
    assert (told.named["ros_arguments"], told.named["respawn"]) == (["--log-level", "debug"], True)


def test_the_launch_file_of_a_fleet_gives_each_vehicle_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    given = {"namespaces": "quad1,quad2", "vehicle": "a.yaml,b.yaml", "approval": "manual"}
    groups = launched(LAUNCH / "fleet.launch.py", given, monkeypatch)
    told = []
    for group in groups:
        assert isinstance(group, GroupAction)
        assert group.named["forwarding"] is False
        (one,) = group.arguments[0]
        told.append(dict(one.named["launch_arguments"]))
    assert told == [
        {"namespace": "quad1", "vehicle": "a.yaml", "approval": "manual"},
        {"namespace": "quad2", "vehicle": "b.yaml", "approval": "manual"},
    ]
    with pytest.raises(AssertionError, match="required: namespaces"):
        launched(LAUNCH / "fleet.launch.py", {}, monkeypatch)


# --- What ROS users publish wrongly is named in /diagnostics, at WARN, and nothing is learned from it


Values = tuple[float, ...]


def flipped(v: Values) -> Values:
    return v[0], -v[1], -v[2]


def turned(q: Values) -> Values:
    """The body's axes turned by half a turn about x."""
    return q[0], q[1], -q[2], -q[3]


def world(q: Values) -> Values:
    """The world's axes exchanged: north for east, up for down."""
    w, x, y, z = q
    return tuple(c / math.sqrt(2.0) for c in (-x - y, w + z, w - z, y - x))


MISTAKES: dict[str, tuple[dict[str, Callable[[Values], Values]], str]] = {
    "PX4's body axes in every channel": (
        {"gyro": flipped, "accel": flipped, "attitude": turned},
        "PX4 has FRD and NED",
    ),
    "PX4's body axes in the gyro": ({"gyro": flipped}, "gyro axes differ"),
    "PX4's world": ({"attitude": world}, "its world has z up"),
    "no gravity": ({"accel": lambda v: (v[0], v[1], v[2] + GRAVITY)}, "gravity is missing"),
    "two rotors exchanged": ({"rotor_speed": lambda v: (v[1], v[0], *v[2:])}, "in the order 2, 1, 3, 4"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_at_warn_and_nothing_is_learned(mistake: str) -> None:
    changes, word = MISTAKES[mistake]
    service = Service(PELICAN, SessionSettings(diagnose=0.0), InlineWorker())
    for sample in samples(flight(16.0, 3).recording, EPOCH):
        change = changes.get(sample.channel)
        service.push((sample if change is None else sample._replace(values=change(sample.values))).block)
    service.step()
    told = diagnostics(service.health(), "/quad1/quadid", "pelican", {}, {}, {})
    assert all(len(branches(entry["name"])) == 1 for entry in told["status"])
    session = next(entry for entry in told["status"] if entry["name"].endswith("session"))
    assert word in session["message"]
    assert session["level"] == WARN
    assert service.session.status().fits == 0
