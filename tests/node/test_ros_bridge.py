"""The bridge from parameter sets to a controller's parameters, over DDS, and each reason for which it sets nothing."""

import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from quadid_node.inputs import to_message

from quadid.errors import QuadidError
from quadid.online import SetState
from quadid.parameters import Status
from quadid_node import messages
from tests.node.aggregator import branches
from tests.node.peers import ROOT, Ear, Process, latched
from tests.online.test_gate import TRUE, online_set, parameter_set, scaled

pytestmark = pytest.mark.usefixtures("ros")
CONFIG = ROOT / "quadid_node" / "config"
ENTRIES = ("gains.roll_rate.p = 20.0 * J_xx in 0.02 .. 1.0", "thrust = b in 1e-6 .. 1e-4")
GOOD = replace(online_set(TRUE), sequence=9, mass=1.3)
BEFORE = {"gains.roll_rate.p": 20.0 * 0.9 * TRUE["J_xx"], "thrust": 0.9 * TRUE["b"]}


def message(item: Any = GOOD, **fields: Any) -> Any:
    return to_message(messages.PARAMETER_SET, {**messages.parameter_set(item, "quad1"), **fields})


def planned(sent: Any, now: dict[str, Any], *entries: str) -> Any:
    from quadid_node.bridge import entry, plan

    return plan(sent, [entry(text) for text in entries or ENTRIES], now, 0.5)


def test_a_plan_maps_every_entry() -> None:
    made = planned(message(), BEFORE)
    assert made.values == {"gains.roll_rate.p": pytest.approx(20.0 * TRUE["J_xx"]), "thrust": pytest.approx(TRUE["b"])}
    assert (made.left, made.refused) == ("", "")


@pytest.mark.parametrize(
    ("item", "now", "entries", "word"),
    [
        (GOOD, BEFORE, ("thrust = c in 0 .. 1",), "the set has no c"),
        (GOOD, {**BEFORE, "thrust": 1}, (), "no double"),
        (GOOD, {"thrust": 0.9 * TRUE["b"]}, (), "gains.roll_rate.p is not declared"),
        (GOOD, BEFORE, ("thrust = b in 1e-6 .. 2e-6",), "allowed: 1e-06 .. 2e-06"),
        (replace(GOOD, parameters=parameter_set(scaled(b=1.6))), BEFORE, (), "more than 50%"),
        (GOOD, {**BEFORE, "thrust": 0.0}, (), "would change from 0"),
        (replace(GOOD, parameters=parameter_set(scaled(b=float("nan")))), BEFORE, (), "thrust = nan"),
        (replace(GOOD, parameters=parameter_set(TRUE, b=Status.UNRELIABLE)), BEFORE, ENTRIES[1:], "nothing to set"),
    ],
)
def test_all_is_set_or_nothing(item: Any, now: dict[str, Any], entries: tuple[str, ...], word: str) -> None:
    made = planned(message(item), now, *entries)
    assert word in made.refused
    assert made.values == {}


def test_what_the_data_do_not_determine_stays_and_is_named() -> None:
    made = planned(message(replace(GOOD, parameters=parameter_set(TRUE, J_xx=Status.RATIO_ONLY))), BEFORE)
    assert list(made.values) == ["thrust"]
    assert "gains.roll_rate.p" in made.left


@pytest.mark.parametrize(
    "text", ["a = b", "a = 2 * b in 3 .. 1", "a = b * 2 in 0 .. 1", "a b in 0 .. 1", "a = b in x .. 1"]
)
def test_a_wrong_entry_is_an_error(text: str) -> None:
    from quadid_node.bridge import entry

    with pytest.raises(QuadidError, match="map: "):
        entry(text)


@pytest.mark.parametrize(
    ("item", "fields", "word"),
    [
        (GOOD, {"schema_version": 2}, "schema 2"),
        (GOOD, {"vehicle_id": "quad2"}, "belongs to quad2"),
        (GOOD, {"names": ["b"]}, "1 names, 6 values"),
        (replace(GOOD, sequence=8), {}, "not newer"),
        (replace(GOOD, state=SetState.STALE), {}, "not in force"),
        (GOOD, {"state": messages.NO_SET, "sequence": 0}, "not in force"),
        (replace(GOOD, outdated="lost thrust", outdated_code="weak_rotor"), {}, r"out of date \(weak_rotor\)"),
        (replace(GOOD, mass=1.5), {}, "mass of 1.5"),
        (replace(GOOD, mass=float("nan")), {}, "mass of nan"),
    ],
)
def test_a_set_that_is_not_for_this_controller_is_refused(item: Any, fields: dict[str, Any], word: str) -> None:
    from quadid_node.bridge import objection

    assert objection(message(), "quad1", 1.3, 8) == ""
    with pytest.raises(ValueError, match=word):
        raise ValueError(objection(message(item, **fields), "quad1", 1.3, 8))


class Controller:
    """A node with two gains, which it refuses above a value of its own, and a publisher of sets beside it."""

    def __init__(self, ear: Ear) -> None:
        from quadid_msgs.msg import ParameterSet
        from rcl_interfaces.msg import SetParametersResult

        self.ear, self.most = ear, 1.0
        for name, value in BEFORE.items():
            ear.node.declare_parameter(name, value)
        self._publisher = ear.node.create_publisher(ParameterSet, "quadid/parameters", latched())
        ear.node.add_on_set_parameters_callback(
            lambda changed: SetParametersResult(
                successful=all(p.value <= self.most for p in changed), reason="too much for this controller"
            )
        )

    def values(self) -> dict[str, float]:
        return {name: self.ear.node.get_parameter(name).value for name in BEFORE}

    def send(self, item: Any, **fields: Any) -> None:
        self._publisher.publish(message(item, **fields))


@pytest.fixture
def controller(ear: Ear) -> Controller:
    return Controller(ear)


@pytest.fixture
def controller_name() -> str:
    return "/ear"


@pytest.fixture
def bridge(controller: Controller, controller_name: str, tmp_path: Path) -> Iterator[Process]:
    """The bridge, dry, as the page starts it."""
    given = {"controller": controller_name, "map": list(ENTRIES), "mass": 1.3, "restore_out_of_date": True}
    path = tmp_path / "bridge.yaml"
    path.write_text(yaml.safe_dump({"quadid_bridge": {"ros__parameters": given}}))
    with Process(sys.executable, "-m", "quadid_node.bridge", "--ros-args", "--params-file", str(path)) as started:
        yield started
        assert started.end()[0] == 0, started.text


def dry(ear: Ear, on: bool) -> None:
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=on)
    request = SetParameters.Request(parameters=[Parameter(name="dry_run", value=value)])
    assert ear.call("quadid_bridge/set_parameters", SetParameters, request).results[0].successful


def test_dry_run_then_applied_then_rolled_back(controller: Controller, bridge: Process, ear: Ear) -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from std_srvs.srv import Trigger

    health = ear.listen("/diagnostics", DiagnosticArray)
    controller.send(GOOD)
    assert ear.until(lambda: "dry run: set 9 would set" in bridge.text), bridge.text
    assert controller.values() == BEFORE, "only said"
    assert ear.until(lambda: health)
    assert [branches(s.name) for s in health[-1].status] == [["quadid/Bridge"]]
    dry(ear, False)
    after = {"gains.roll_rate.p": pytest.approx(20.0 * TRUE["J_xx"]), "thrust": pytest.approx(TRUE["b"])}
    assert ear.until(lambda: "set 9 applied" in bridge.text), bridge.text
    assert controller.values() == after
    answer = ear.call("quadid_bridge/rollback", Trigger)
    assert answer.success, answer.message
    assert controller.values() == BEFORE
    controller.send(replace(GOOD, sequence=10))
    assert ear.until(lambda: "dry run: set 10" in bridge.text), bridge.text
    assert controller.values() == BEFORE, "a rollback makes dry_run true"
    assert not ear.call("quadid_bridge/rollback", Trigger).success


def test_a_controller_that_refuses_keeps_all_its_values(controller: Controller, bridge: Process, ear: Ear) -> None:
    controller.most = 1e-3  # the gain is above, the thrust coefficient below
    dry(ear, False)
    controller.send(GOOD)
    assert ear.until(lambda: "too much for this controller" in bridge.text), bridge.text
    assert controller.values() == BEFORE


def test_a_withdrawn_set_puts_the_first_values_back(controller: Controller, bridge: Process, ear: Ear) -> None:
    dry(ear, False)
    controller.send(GOOD)
    assert ear.until(lambda: "set 9 applied" in bridge.text), bridge.text
    assert controller.values() != BEFORE
    controller.send(replace(GOOD, sequence=10, outdated="thrust fell", outdated_code="thrust_drop"))
    assert ear.until(lambda: controller.values() == BEFORE), bridge.text


ALONE = f"""
import rclpy, sys
rclpy.init()
node = rclpy.create_node("alone")
for name, value in {BEFORE}.items():
    node.declare_parameter(name, value)
node.add_on_set_parameters_callback(
    lambda changed: print("asked", *(p.value for p in changed)) or rclpy.node.SetParametersResult(successful=True)
)
print("ready")
rclpy.spin(node)
"""
"""A controller that is a process of its own and can be stopped and killed."""


@pytest.mark.parametrize("controller_name", ["/alone"])
def test_a_controller_that_dies_before_its_answer_holds_nothing_up(
    controller: Controller, bridge: Process, ear: Ear
) -> None:
    from std_srvs.srv import Trigger

    with Process(sys.executable, "-c", ALONE) as first:
        first.wait_for("ready")
        controller.send(GOOD)
        assert ear.until(lambda: "dry run: set 9" in bridge.text), bridge.text
        first.child.send_signal(signal.SIGSTOP)
        dry(ear, False)
        assert ear.until(lambda: "/alone does not answer" in bridge.text), bridge.text
    with Process(sys.executable, "-c", ALONE) as second:
        assert ear.until(lambda: "set 9 applied" in bridge.text), bridge.text
        second.wait_for(f"asked {20.0 * TRUE['J_xx']}")
        second.child.send_signal(signal.SIGSTOP)
        answer = ear.call("quadid_bridge/rollback", Trigger)
        assert not answer.success
        assert answer.message == "/alone does not answer"
        second.child.send_signal(signal.SIGCONT)
        assert ear.call("quadid_bridge/rollback", Trigger).success
        second.wait_for(f"asked {BEFORE['gains.roll_rate.p']}")


def test_a_lost_answer_leaves_the_way_back(controller: Controller, bridge: Process, ear: Ear) -> None:
    """The controller sets the values, and nobody hears that it did: it is not spun until the bridge gave up."""
    from rcl_interfaces.msg import SetParametersResult
    from std_srvs.srv import Trigger

    dry(ear, False)
    asked = list[Any]()

    def hang(changed: list[Any]) -> Any:
        asked.append(changed)
        if len(asked) == 1:
            bridge.wait_for("/ear does not answer")
        return SetParametersResult(successful=True)

    ear.node.add_on_set_parameters_callback(hang)
    controller.send(GOOD)
    assert ear.until(lambda: "set 9 applied" in bridge.text), bridge.text
    assert ear.call("quadid_bridge/rollback", Trigger).success
    assert controller.values() == BEFORE


def test_options_that_are_wrong_end_it_with_the_fix() -> None:
    with Process(sys.executable, "-m", "quadid_node.bridge") as started:
        assert started.code() == 2
        started.wait_for("controller is not given")


def test_the_configurations_of_the_package_belong_together() -> None:
    from quadid_node.bridge import OPTIONS, entry

    given = yaml.safe_load((CONFIG / "bridge.yaml").read_text())["quadid_bridge"]["ros__parameters"]
    assert set(given) <= set(OPTIONS)
    assert given["dry_run"] is True
    control = yaml.safe_load((CONFIG / "ros2_control.yaml").read_text())
    gains = control[given["controller"].strip("/")]["ros__parameters"]["gains"]
    for made in map(entry, given["map"]):
        _, axis, gain = made.target.split(".")
        assert made.low <= gains[axis][gain] <= made.high
        assert made.factor * TRUE[made.source] == pytest.approx(gains[axis][gain], rel=given["step"])
