"""The ROS node under a lifecycle manager, among faults of topics and processes, and beside a second service."""

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from quadid_node.history import Store, read_history
from quadid_node.messages import ERROR, OK, WARN
from quadid_node.process import end_middleware
from quadid_node.publish import OBSERVES, YOUNG

from tests.faults.evidence import Happened
from tests.node.peers import Ear, Process, latched, level, message, node, player
from tests.online.test_gate import TRUE, online_set

# --- The node under a lifecycle manager: every transition in every state is answered, and a bring-up as nav2's works


pytestmark = pytest.mark.usefixtures("ros")

UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = 1, 2, 3, 4
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE = 1, 2, 3, 4
SHUTDOWN = {UNCONFIGURED: 5, INACTIVE: 6, ACTIVE: 7}
VALID = {
    (UNCONFIGURED, CONFIGURE): INACTIVE,
    (INACTIVE, CLEANUP): UNCONFIGURED,
    (INACTIVE, ACTIVATE): ACTIVE,
    (ACTIVE, DEACTIVATE): INACTIVE,
    **dict.fromkeys(SHUTDOWN.items(), FINALIZED),
}
"""The transitions that a client may ask for, and where they lead (design.ros2.org, managed nodes)."""
ASKED = (*range(0, 9), *range(10, 12), 62, 200)
"""Numbers of transitions: those of clients, create, destroy, results of callbacks, and one that means nothing."""


class Client:
    """Asks one node for transitions, as `ros2 lifecycle set` does."""

    def __init__(self, ear: Ear, name: str = "quadid") -> None:
        self._ear, self._name = ear, name

    def change(self, number: int = 0, label: str = "") -> bool:
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request()
        request.transition.id, request.transition.label = number, label
        return bool(self._ear.call(f"{self._name}/change_state", ChangeState, request).success)

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
        UNCONFIGURED: [],
        INACTIVE: [CONFIGURE],
        ACTIVE: [CONFIGURE, CLEANUP, CONFIGURE, ACTIVATE, DEACTIVATE, ACTIVATE],
    }
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


# --- What a controller or monitor can tell of the node at any time: alive or dead, in which state, with which set


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
            (CONFIGURE, "inactive"),
            (ACTIVATE, "active"),
            (DEACTIVATE, "inactive"),
            (CLEANUP, "unconfigured"),
            (SHUTDOWN[UNCONFIGURED], "finalized"),
        ):
            assert client.change(number), managed.text
            assert said(state), f"{state}: {status} {health}"
            assert abs(status[-1].published.sec - time.time()) < 3600.0, "by the node's clock"
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
        depth=1,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
        reliability=ReliabilityPolicy.RELIABLE,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=Duration(seconds=8.0),
    )
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
        assert abs(none.published.sec - time.time()) < 3600.0
        assert "no set" in none.reason
        assert ear.until(lambda: count() == 1)
        ear.until(lambda: False, 12.0)
        assert ear.until(lambda: count() == 1), "quiet for longer than its lease, without any data, and alive"
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


# --- Faults of topics and processes around the real node, over DDS: silence, rivals, wrong types, signals, power cuts


def rate(health: list[Any], channel: str) -> float:
    entry = next(s for s in health[-1].status if s.name.endswith("inputs"))
    return next((float(v.value) for v in entry.values if v.key == f"{channel} [Hz]"), 0.0)


@pytest.mark.slow
def test_silence_rivals_and_strangers_on_the_topics(log: Path, tmp_path: Path, ear: Ear, happened: Happened) -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from quadid_msgs.msg import FitStatus, ParameterSet
    from sensor_msgs.msg import Imu, JointState

    with node(tmp_path / "h.sqlite") as identify:
        health = ear.listen("/diagnostics", DiagnosticArray)
        status = ear.listen("quadid/status", FitStatus)
        sets = ear.sets()
        identify.wait_for("ready")
        with player(log, 1.0):
            assert ear.until(lambda: sets), identify.text
            rogue = ear.node.create_publisher(Imu, "imu", 10)
            timer = ear.node.create_timer(0.1, lambda: rogue.publish(Imu()))
            paused = "2 publishers on one topic: paused"
            assert ear.until(lambda: paused in message(health, "inputs")), message(health, "inputs")
            assert level(health, "inputs") == ERROR
            assert ear.until(lambda: rate(health, "gyro") == 0.0), "paused: nothing is taken in"
            ear.node.destroy_timer(timer)
            ear.node.destroy_publisher(rogue)
            assert ear.until(lambda: level(health, "inputs") == OK), identify.text
            happened(15, "second IMU publisher: ERROR naming topic and count, nothing taken in until it was gone again")
        held, fits = sets[-1], status[-1].fits
        first = len(health)
        assert ear.until(lambda: level(health, "inputs") == ERROR and "silent" in message(health, "inputs"))
        levels = [next(s.level for s in h.status if s.name.endswith("inputs")) for h in health[first:]]
        assert WARN in levels[: levels.index(ERROR)], "first a warning, then an error"
        with Ear() as late:
            again = late.sets()
            assert late.until(lambda: again)
            assert list(again[0].values) == list(held.values)
        with player(log, 2.0):  # the first one was killed: it stays listed until its lease ends, and is waited for 1 s
            assert ear.until(lambda: rate(health, "gyro") > 20.0 and "paused" not in message(health, "inputs"))
            assert ear.until(lambda: level(health, "inputs") == OK), message(health, "inputs")
            assert ear.until(lambda: status[-1].fits > fits), identify.text
        happened(
            9,
            "vehicle gone: WARN, then ERROR naming the silent channel; a late subscriber still got the last set; "
            "publisher restarted: OK again, fits go on",
        )
        strange = ear.node.create_publisher(JointState, "attitude", 10)
        assert ear.until(lambda: "another type (sensor_msgs/msg/JointState" in message(health, "inputs")), message(
            health, "inputs"
        )
        ear.node.destroy_publisher(strange)
        ear.listen("quadid/candidate", ParameterSet, latched())
        assert ear.until(lambda: "its subscriber: asks for a QoS" in message(health, "inputs"))
        happened(9, "publisher of another type, subscriber with a QoS that is not offered: ERROR naming the topic")
        forger = ear.node.create_publisher(ParameterSet, "quadid/parameters", latched())
        forger.publish(ParameterSet(sequence=999, values=[4.0e-5], names=["b"], log_hash="00" * 32))
        assert ear.until(lambda: "someone else publishes" in message(health, "inputs"))
        assert level(health, "inputs") == ERROR
        assert identify.end()[0] == 0
    hashes = {s["input_hash"] for s in read_history(tmp_path / "h.sqlite", "pelican")["sets"]}
    assert held.log_hash in hashes
    assert "00" * 32 not in hashes
    happened(15, "forged set on our topic: ERROR naming it; its log_hash is in no history, those of ours are")


@pytest.mark.slow
def test_a_power_cut_in_flight_and_signals_while_it_starts(
    log: Path, tmp_path: Path, ear: Ear, happened: Happened
) -> None:
    from quadid_msgs.msg import ParameterSet

    history = tmp_path / "h.sqlite"
    sets = ear.sets()
    with node(history) as identify:
        identify.wait_for("ready")
        with player(log, 2.0):
            assert ear.until(lambda: sets), identify.text
            ear.until(lambda: False, 1.0)
            identify.end(signal.SIGKILL)
    last = sets[-1]
    spent = []
    for number, after in ((signal.SIGTERM, 0.7), (signal.SIGINT, 1.5), (signal.SIGINT, 3.0)):
        with node(history) as starting:
            time.sleep(after)
            code, work = starting.end(number)
            spent.append(work)
            assert code in (0, -number), starting.text
            assert code == 0 or not starting.lines, "only before its first line may a signal end it the hard way"
    ear.until(lambda: False, 0.5)
    sets.clear()  # one of those that were stopped may have got as far as publishing
    with node(history) as restarted:
        assert ear.until(lambda: sets and sets[-1].state == ParameterSet.STATE_STALE), restarted.text
        assert restarted.end(signal.SIGTERM)[0] == 0
    assert sets[-1].sequence > last.sequence
    assert list(sets[-1].values) == list(last.values)
    times = ", ".join(f"{s:.1f}" for s in spent)
    happened(13, f"SIGTERM or SIGINT 0.7, 1.5, 3 s after the start: gone after {times} s of processor time")
    happened(13, f"kill -9 in flight: set {last.sequence} came back as stale with the same bits")


# --- Two services for one vehicle over DDS, each a process with a history of its own: one speaks, the other observes


def history_with(path: Path, b: float, sequence: int) -> Path:
    """A history whose last set in force has this b."""
    store = Store(path, "pelican")
    store.numbered(replace(online_set({**TRUE, "b": b}), sequence=sequence, approved_by="auto"))
    store.close(30.0)
    return path


def b_of(message: Any) -> float:
    """Thrust coefficient of a set on the topic: each of the two histories has its own."""
    return float(dict(zip(message.names, message.values, strict=True))["b"])


def speakers(ear: Ear) -> set[tuple[int, ...]]:
    """Publishers of parameter sets, each by what DDS calls it."""
    return {tuple(found.endpoint_gid) for found in ear.node.get_publishers_info_by_topic("quadid/parameters")}


@pytest.mark.slow
def test_a_second_service_with_a_history_of_its_own_observes_and_takes_over(
    tmp_path: Path, ear: Ear, happened: Happened
) -> None:

    paths = [history_with(tmp_path / f"{k}.sqlite", b, 10 * k) for k, b in ((1, 2.3e-5), (2, 2.4e-5))]
    sets = ear.sets()
    with node(paths[0]) as first:
        first.wait_for("ready")
        assert ear.until(lambda: sets), first.text
        with node(paths[1]) as second:
            second.wait_for(OBSERVES)
            second.wait_for("ready")  # kernels compile for minutes on a busy machine
            ear.until(lambda: False, 3.0)
            assert {b_of(s) for s in sets} == {2.3e-5}, "the second one says nothing"
            assert first.end()[0] == 0
            begin = time.monotonic()
            assert ear.until(lambda: b_of(sets[-1]) == 2.4e-5), second.text
            took = time.monotonic() - begin
            assert second.end()[0] == 0
    happened(
        21, f"second node with a history of its own: observes with ERROR; first one ended: speaks {took:.1f} s later"
    )


@pytest.mark.slow
def test_two_that_lost_sight_of_each_other_end_with_one_speaker(tmp_path: Path, ear: Ear, happened: Happened) -> None:
    """The first one is stopped for so long that DDS takes it for gone; the second takes over; then both are there."""
    with node(tmp_path / "1.sqlite") as first:
        first.wait_for("ready")
        assert ear.until(lambda: len(speakers(ear)) == 1)
        with node(tmp_path / "2.sqlite") as second:
            second.wait_for(OBSERVES)
            second.wait_for("ready")
            begin, before = time.monotonic(), speakers(ear)
            first.child.send_signal(signal.SIGSTOP)
            assert ear.until(lambda: speakers(ear) - before and not speakers(ear) & before), second.text
            took_over = time.monotonic() - begin
            ear.until(lambda: False, YOUNG + 2.0)
            begin = time.monotonic()
            first.child.send_signal(signal.SIGCONT)
            both = ear.until(lambda: len(speakers(ear)) == 2, 60.0)
            assert ear.until(lambda: len(speakers(ear)) == 1), f"{first.text}\n{second.text}"
            settled = time.monotonic() - begin
            ear.until(lambda: False, 8.0)
            assert len(speakers(ear)) == 1
            assert first.child.poll() is None
            assert second.child.poll() is None
    seen = "both spoke for a moment" if both else "it gave way before anyone saw both"
    happened(
        21,
        f"speaker stopped until DDS forgets it: the observer speaks after {took_over:.0f} s; the first one back "
        f"({seen}): one speaker again after {settled:.1f} s",
    )
