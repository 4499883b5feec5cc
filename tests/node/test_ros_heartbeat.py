"""What a controller or monitor can tell of the node at any time: alive or dead, in which state, with which set."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.node.peers import Ear, node
from tests.node.test_ros_lifecycle import ACTIVATE, CLEANUP, CONFIGURE, DEACTIVATE, SHUTDOWN, UNCONFIGURED, Client

pytestmark = pytest.mark.usefixtures("ros")


def parameters(ear: Ear, *names: str) -> tuple[Any, ...]:
    """Values of parameters of the node, as `ros2 param get` reads them."""
    from rcl_interfaces.srv import GetParameters
    from rclpy.parameter import parameter_value_to_python

    found = ear.call("quadid/get_parameters", GetParameters, GetParameters.Request(names=list(names)))
    return tuple(parameter_value_to_python(value) for value in found.values)


def test_status_and_diagnostics_speak_in_every_state_of_the_life_cycle(ear: Ear) -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from quadid_msgs.msg import FitStatus

    status = ear.listen("quadid/status", FitStatus)
    health = ear.listen("/diagnostics", DiagnosticArray)

    def said(state: str) -> bool:
        """Both topics carry the state since now."""
        status.clear()
        health.clear()

        def both() -> bool:
            session = [s.message for h in health for s in h.status if s.name == "quadid: session"]
            reasons = [s.reason for s in status]
            idle = [any(text.startswith(f"{state}: ") for text in texts) for texts in (session, reasons)]
            active = bool(reasons) and reasons[-1].startswith("waiting for data")
            return active if state == "active" else all(idle)

        return ear.until(both)

    with node("none", autostart=False) as managed:
        client = Client(ear)
        assert said("unconfigured"), managed.text
        for number, state in (
            (CONFIGURE, "inactive"), (ACTIVATE, "active"), (DEACTIVATE, "inactive"), (CLEANUP, "unconfigured"),
            (SHUTDOWN[UNCONFIGURED], "finalized"),
        ):  # fmt: skip
            assert client.change(number), managed.text
            assert said(state), f"{state}: {status} {health}"
            assert abs(status[-1].published.sec - time.time()) < 60.0, "by the node's clock"
        assert managed.end()[0] == 0


def alive(ear: Ear, sets: list[Any]) -> Callable[[], int]:
    """Subscribes to the parameter topic as a controller that wants to know of the publisher's death."""
    from quadid_msgs.msg import ParameterSet
    from rclpy.duration import Duration
    from rclpy.event_handler import SubscriptionEventCallbacks
    from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

    counts = [0]

    def changed(event: Any) -> None:
        counts.append(event.alive_count)

    asked = QoSProfile(
        depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC, liveliness_lease_duration=Duration(seconds=8.0),
    )  # fmt: skip
    callbacks = SubscriptionEventCallbacks(liveliness=changed)
    ear.node.create_subscription(ParameterSet, "quadid/parameters", sets.append, asked, event_callbacks=callbacks)
    return lambda: counts[-1]


def test_nothing_in_force_is_said_and_a_hanging_or_dead_service_is_told_from_a_quiet_one(ear: Ear) -> None:
    from quadid_msgs.msg import ParameterSet

    sets: list[Any] = []
    count = alive(ear, sets)
    with node("none") as identify:
        identify.wait_for("ready")
        assert ear.until(lambda: sets), identify.text
        (none,) = sets
        assert (none.state, none.sequence, list(none.values)) == (ParameterSet.STATE_NONE, 0, [])
        assert none.schema_version == ParameterSet.SCHEMA_VERSION == 3
        assert (none.vehicle_id, len(none.boot_id)) == ("pelican", 32)
        assert abs(none.published.sec - time.time()) < 60.0
        assert "no set" in none.reason
        assert ear.until(lambda: count() == 1)
        ear.until(lambda: False, 12.0)
        assert count() == 1, "quiet, without any data, and alive"
        identify.child.send_signal(signal.SIGSTOP)
        assert ear.until(lambda: count() == 0), "it hangs"
        identify.child.send_signal(signal.SIGCONT)
        assert ear.until(lambda: count() == 1), "it goes on"
        identify.child.kill()
        assert ear.until(lambda: count() == 0), "it is dead"
    assert len(sets) == 1


def test_parameters_read_back_what_is_in_force(tmp_path: Path, ear: Ear) -> None:
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    history = tmp_path / "h.sqlite"
    with node(history, autostart=False) as managed:
        client = Client(ear)
        assert parameters(ear, "vehicle_id", "window") == ("", 5.0)
        assert client.change(CONFIGURE)
        assert client.change(ACTIVATE)
        assert parameters(ear, "vehicle_id", "history", "approval") == ("pelican", str(history), "auto")
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="manual")
        request = SetParameters.Request(parameters=[Parameter(name="approval", value=value)])
        assert ear.call("quadid/set_parameters", SetParameters, request).results[0].successful
        assert parameters(ear, "approval") == ("manual",)
        assert client.change(DEACTIVATE)
        assert client.change(CLEANUP)
        assert parameters(ear, "vehicle_id", "approval") == ("", "auto"), "what the next configure starts from"
        assert managed.end()[0] == 0
    with node(history, approval="auto", **{"gate.step": "1"}) as restarted:
        restarted.wait_for("ready")
        assert parameters(ear, "approval", "gate.step") == ("manual", 1.0), "as decided in the earlier run"
        assert restarted.end()[0] == 0
