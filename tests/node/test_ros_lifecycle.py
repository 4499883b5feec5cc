"""The node under a lifecycle manager: every transition in every state is answered, and a bring-up as nav2's works."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from quadid_node.messages import ERROR
from quadid_node.process import end_middleware

from tests.node.peers import Ear, Process, node

pytestmark = pytest.mark.usefixtures("ros")

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = 1, 2, 3, 4
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE = 1, 2, 3, 4
SHUTDOWN = {UNCONFIGURED: 5, INACTIVE: 6, ACTIVE: 7}
VALID = {
    (UNCONFIGURED, CONFIGURE): INACTIVE, (INACTIVE, CLEANUP): UNCONFIGURED, (INACTIVE, ACTIVATE): ACTIVE,
    (ACTIVE, DEACTIVATE): INACTIVE, **dict.fromkeys(SHUTDOWN.items(), FINALIZED),
}  # fmt: skip
"""The transitions that a client may ask for, and where they lead (design.ros2.org, managed nodes)."""
ASKED = (*range(0, 9), *range(10, 12), 62, 200)
"""Numbers of transitions: those of clients, create, destroy, results of callbacks, and one that means nothing."""


class Client:
    """Asks one node for transitions, as `ros2 lifecycle set` does."""

    def __init__(self, ear: Ear, name: str = "quadid") -> None:
        self._ear, self._name = ear, name

    def change(self, number: int = 0, label: str = "", seconds: float = 120.0) -> bool:
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request()
        request.transition.id, request.transition.label = number, label
        return bool(self._ear.call(f"{self._name}/change_state", ChangeState, request, seconds).success)

    @property
    def state(self) -> int:
        from lifecycle_msgs.srv import GetState

        return int(self._ear.call(f"{self._name}/get_state", GetState).current_state.id)


@pytest.fixture
def managed(ear: Ear) -> Iterator[Process]:
    """A node that waits for its manager; ended, not killed: the services of a killed one are listed for a while."""
    with node("none", autostart=False) as started:
        yield started
        assert started.end()[0] == 0, started.text


def refuse_all_others(client: Client, state: int, process: Process) -> None:
    """Asks for everything that is not valid in a state: refused, and the node is where it was."""
    for number in ASKED:
        if (state, number) not in VALID:
            assert not client.change(number), f"transition {number} in state {state}"
            assert client.state == state, f"after transition {number}"
    assert not client.change(label="no such transition")
    assert client.state == state
    assert process.child.poll() is None, process.text


@pytest.mark.parametrize("last", [UNCONFIGURED, INACTIVE, ACTIVE])
def test_every_transition_in_every_state_is_answered_and_the_node_lives(last: int, managed: Process, ear: Ear) -> None:
    """The longest walk asks for all others in every state; `configure` comes back with warm kernels."""
    client, state, seen = Client(ear), UNCONFIGURED, set[int]()
    walk = {
        UNCONFIGURED: [], INACTIVE: [CONFIGURE],
        ACTIVE: [CONFIGURE, CLEANUP, CONFIGURE, ACTIVATE, DEACTIVATE, ACTIVATE],
    }  # fmt: skip
    for number in [*walk[last], SHUTDOWN[last]]:
        if last == ACTIVE and state not in seen:
            refuse_all_others(client, state, managed)
            seen.add(state)
        assert client.change(number), managed.text
        assert (number != CONFIGURE) or "the fit process is warm" in managed.text
        state = VALID[state, number]
        assert client.state == state
    refuse_all_others(client, FINALIZED, managed)
    managed.wait_for("cannot")  # what was refused is said, with what may be asked for


def test_an_error_in_a_transition_is_said_and_the_node_can_be_configured_again(managed: Process, ear: Ear) -> None:
    """A vehicle file that does not exist: configure fails, and the reason stays; with another vehicle it succeeds."""
    from diagnostic_msgs.msg import DiagnosticArray
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    def vehicle(name: str) -> None:
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=name)
        request = SetParameters.Request(parameters=[Parameter(name="vehicle", value=value)])
        assert ear.call("quadid/set_parameters", SetParameters, request).results[0].successful

    client, health = Client(ear), ear.listen("/diagnostics", DiagnosticArray)
    vehicle("nowhere.yaml")
    assert not client.change(CONFIGURE)
    assert client.state == UNCONFIGURED
    managed.wait_for("nowhere.yaml")
    health.clear()
    assert ear.until(lambda: any("nowhere.yaml" in s.message and s.level == ERROR for h in health for s in h.status))
    vehicle("pelican")
    assert client.change(CONFIGURE), managed.text
    assert client.change(ACTIVATE), managed.text


def test_an_exception_in_a_callback_is_said_and_everything_is_put_away(monkeypatch: pytest.MonkeyPatch) -> None:
    import rclpy
    from quadid_node.node import IdentifyNode

    rclpy.init(args=["--ros-args", "-p", "history:=none"])
    try:
        made = IdentifyNode(lambda: True)
        told: list[str] = []
        monkeypatch.setattr(made, "_log", lambda level, text: told.append(text))
        monkeypatch.setattr(made, "_subscribe", lambda *_: 1 / 0)
        made.trigger_configure()
        assert made._state_machine.current_state[1] == "unconfigured"
        assert any("division by zero" in text for text in told), told
        monkeypatch.undo()
        made.trigger_configure()
        assert made._state_machine.current_state[1] == "inactive"
        made.trigger_shutdown()
        made.destroy_node()
        del made
    finally:
        rclpy.try_shutdown()
        end_middleware()  # or its services would stay listed beside those of the next test's node


class Manager:
    """Brings a node up and down as nav2's lifecycle manager does: transitions one after the other, then a bond.

    Of `nav2_lifecycle_manager`: a transition is asked for and waited for, then the state is asked; after `activate` a
    bond on the topic `bond`, with the node's name as its id, must form, and lives as long as the other side's
    heartbeats come; after `deactivate` it is broken.
    """

    TIMEOUT, PERIOD = 4.0, 0.25

    def __init__(self, ear: Ear) -> None:
        self._ear, self._client = ear, Client(ear)
        self.heard: list[Any] = []

    def transition(self, number: int, goal: int) -> bool:
        return self._client.change(number) and self._client.state == goal

    def bring_up(self) -> bool:
        return self.transition(CONFIGURE, INACTIVE) and self.transition(ACTIVATE, ACTIVE)

    def form_bond(self) -> bool:
        from bond.msg import Status

        self._publisher = self._ear.node.create_publisher(Status, "bond", 5)
        self._ear.node.create_subscription(Status, "bond", self._on_status, 100)
        self._timer = self._ear.node.create_timer(self.PERIOD, lambda: self._say(True))
        return self._ear.until(lambda: self.heard)

    def _on_status(self, status: Any) -> None:
        if status.id == "quadid" and status.instance_id != "manager":
            self.heard.append(status)

    def _say(self, active: bool) -> None:
        from bond.msg import Status

        status = Status(id="quadid", instance_id="manager", active=active)
        status.heartbeat_timeout, status.heartbeat_period = self.TIMEOUT, self.PERIOD
        self._publisher.publish(status)

    def break_bond(self) -> None:
        self._ear.node.destroy_timer(self._timer)
        self._say(False)


def test_a_manager_brings_it_up_and_down_with_a_bond(managed: Process, ear: Ear) -> None:
    pytest.importorskip("bond.msg")
    manager = Manager(ear)
    assert manager.bring_up(), managed.text
    assert manager.form_bond(), managed.text
    assert manager.heard[0].active
    before = len(manager.heard)
    assert ear.until(lambda: len(manager.heard) >= before + 8), "heartbeats go on"
    assert {status.heartbeat_period for status in manager.heard} == {Manager.PERIOD}
    assert len({status.instance_id for status in manager.heard}) == 1
    manager.break_bond()
    assert ear.until(lambda: not manager.heard[-1].active), "as bondcpp acknowledges the other side's end"
    assert (Client(ear).state, managed.child.poll()) == (ACTIVE, None), "a manager that goes away changes nothing"
    assert manager.transition(DEACTIVATE, INACTIVE)
    manager.heard.clear()
    assert manager.transition(ACTIVATE, ACTIVE)
    assert ear.until(lambda: manager.heard and manager.heard[-1].active), "a bond of its own each time"
    assert manager.transition(DEACTIVATE, INACTIVE)
    assert ear.until(lambda: not manager.heard[-1].active), "its end is said, not left to a timeout"
    assert manager.transition(CLEANUP, UNCONFIGURED)
    assert manager.transition(SHUTDOWN[UNCONFIGURED], FINALIZED)
    assert "Traceback" not in managed.text


def test_configure_gives_up_after_a_bounded_time_and_says_what_to_do(ear: Ear) -> None:
    with node("none", autostart=False, warm_up=0.01) as started:
        client = Client(ear)
        assert not client.change(CONFIGURE)
        assert client.state == UNCONFIGURED
        started.wait_for("quadid warmup")
        assert started.end()[0] == 0
