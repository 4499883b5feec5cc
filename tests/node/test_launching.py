"""What launch arguments become: only those given override the configuration; a fleet has its own of each."""

from __future__ import annotations

import importlib
import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from quadid_node.launching import ARGUMENTS, NODE_ARGUMENTS, fleet, parameters, truth
from quadid_node.settings import PARAMETERS

from tests.node.launch_stand_in import GroupAction, Node, launched

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


def test_the_configuration_file_of_the_package_and_a_launch_argument_are_merged_as_ros_does() -> None:
    given = yaml.safe_load((ROOT / "quadid_node" / "config" / "quadid.yaml").read_text())["/**"]["ros__parameters"]
    file = {**given, "approval": "manual"}
    assert {**file, **parameters({"vehicle": "x.yaml"})} == {**file, "vehicle": "x.yaml"}


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


@pytest.mark.ros
@pytest.mark.parametrize("name", ["identify", "fleet"])
def test_the_launch_file_starts_nodes(name: str) -> None:
    """Where ROS' own launch is installed (the wheels of the package index have none)."""
    if importlib.util.find_spec("launch_ros") is None:
        pytest.skip("launch_ros is on no package index: run where ROS is installed")
    launch, actions = importlib.import_module("launch"), importlib.import_module("launch.actions")
    spec = importlib.util.spec_from_file_location(name, LAUNCH / f"{name}.launch.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    context, made = launch.LaunchContext(), list[Any]()
    context.launch_configurations.update({"namespaces": "quad1,quad2", "vehicle": "pelican"})
    for entity in module.generate_launch_description().entities:
        done = entity.visit(context)
        made += done if isinstance(entity, actions.OpaqueFunction) and done else []
    assert len(made) == (1 if name == "identify" else 2)
