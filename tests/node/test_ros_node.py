"""The ROS node over DDS, every part a process of its own: vehicle, node, subscribers, services, signals, Zenoh."""

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from quadid_node.history import read_history, read_in_force
from quadid_node.process import end_middleware, without_shared_memory
from quadid_node.zenoh import FleetView
from quadid_replay import write_mcap

from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.node.aggregator import branches
from tests.node.peers import LIMIT, ROOT, Ear, Process, latched, node, player, until
from tests.node.zenoh_net import Net
from tests.online.driving import flight

# --- The ROS node over DDS, every part a process of its own: simulated vehicle, node, subscribers, services, signals


pytestmark = pytest.mark.usefixtures("ros")
PELICAN = Vehicle.shipped("pelican")
SPEED = 2.0


def seconds(stamp: Any) -> float:
    """Time of a stamp [s]."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def left_out(diagnostics: Any) -> bool:
    """True if fits were left out because the machine was too slow."""
    told = [v.value for s in diagnostics.status for v in s.values if v.key == "fits left out"]
    return any(value != "0" for value in told)


def test_a_late_subscriber_gets_the_latched_set_and_the_replay_gives_the_same_bits(
    log: Path, tmp_path: Path, ear: Ear
) -> None:
    """Vehicle, node, recorder; a controller that comes late; the recording replayed; a restart."""
    from diagnostic_msgs.msg import DiagnosticArray
    from quadid_msgs.msg import FitStatus, ParameterSet
    from quadid_msgs.srv import GetHistory

    history, recorded = tmp_path / "h.sqlite", tmp_path / "recorded.mcap"
    with node(history, record=recorded) as identify:
        candidates = ear.listen("quadid/candidate", ParameterSet, 100)
        health = ear.listen("/diagnostics", DiagnosticArray)
        identify.wait_for("ready")
        with player(log, SPEED):
            assert ear.until(lambda: any(c.state == ParameterSet.STATE_ACCEPTED for c in candidates)), identify.text
            assert ear.until(lambda: len(candidates) > 5), identify.text
        with Process(sys.executable, str(ROOT / "examples" / "controller_subscriber.py"), "--show-tracking") as late:
            line = late.wait_for("attitude tracking error")
            late.wait_for("applied")
            before, after = (float(word) for word in line.split() if word.startswith("0."))
            assert after < before, line
        shown = [branch for s in health[-1].status for branch in branches(s.name)]
        assert shown == ["quadid/Session", "quadid/Inputs", "quadid/Fit process", "quadid/History"]
        assert identify.end()[0] == 0
    last = read_in_force(history, "pelican", None).item
    assert last is not None
    assert ear.until(lambda: any(c.sequence == last.sequence for c in candidates)), "said while nobody listened"
    accepted = next(c for c in candidates if c.sequence == last.sequence)
    assert accepted.state == ParameterSet.STATE_ACCEPTED
    assert dict(zip(accepted.names, accepted.values, strict=True))["b"] == pytest.approx(2.33e-5, rel=0.01)
    assert accepted.schema_version == ParameterSet.SCHEMA_VERSION
    assert len(accepted.boot_id) == 32
    assert (accepted.mass, accepted.out_of_date) == (1.3, False)
    assert abs(accepted.window_end.sec - time.time()) < 3600.0, "absolute, not seconds of the day"
    assert accepted.vehicle_id == "pelican"

    out = tmp_path / "result.json"
    options = ["--as-recorded", "--json", str(out), "--candidates"]
    with Process(
        str(Path(sys.executable).with_name("quadid")), "replay", str(recorded), "--vehicle", "pelican", *options
    ) as again:
        assert again.code() == 0, again.text
    replayed = json.loads(out.read_text())["candidates"]
    live = [(list(c.values), c.log_hash) for c in candidates]
    assert len(live) > 5
    repeated = [([p["value"] for p in c["parameters"]], c["input_hash"]) for c in replayed]
    if (hurried := next((seconds(d.header.stamp) for d in health if left_out(d)), None)) is None:
        assert live == repeated[: len(live)]
        assert len(repeated) - len(live) <= 1, "the run was stopped while its last fit ran, if at all"
    else:  # a busy machine leaves out fits, a replay none: the same up to there
        same = sum(seconds(c.published) < hurried - 2.0 for c in candidates)
        assert live[:same] == repeated[:same]

    with node(history) as restarted:
        stale = ear.listen("quadid/parameters", ParameterSet, latched())
        status = ear.listen("quadid/status", FitStatus)
        assert ear.until(lambda: stale), restarted.text
        assert [s.state for s in stale] == [ParameterSet.STATE_STALE], "said instead of that nothing is in force"
        assert ear.until(lambda: status and status[-1].in_force == stale[-1].sequence)
        assert list(stale[-1].values) == list(accepted.values)
        assert "not yet confirmed" in stale[-1].reason
        assert stale[-1].sequence > accepted.sequence
        assert stale[-1].boot_id != accepted.boot_id
        assert stale[-1].window_end == accepted.window_end, "the same instant after a restart"
        found = ear.call("quadid/get_history", GetHistory, GetHistory.Request(most=2))
        assert found.success
        assert [s.sequence for s in found.sets][-1] == stale[-1].sequence
        assert len(found.sets) == 2
        assert [s.boot_id for s in found.sets] == [accepted.boot_id, stale[-1].boot_id]


def test_approve_and_rollback_by_service_and_parameters_are_guarded(log: Path, tmp_path: Path, ear: Ear) -> None:
    from quadid_msgs.msg import ParameterSet
    from quadid_msgs.srv import Approve
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters
    from std_srvs.srv import Trigger

    def change(name: str, **value: Any) -> Any:
        kind = ParameterType.PARAMETER_DOUBLE if "double_value" in value else ParameterType.PARAMETER_STRING
        request = SetParameters.Request(parameters=[Parameter(name=name, value=ParameterValue(type=kind, **value))])
        return ear.call("quadid/set_parameters", SetParameters, request).results[0]

    with node(tmp_path / "h.sqlite", approval="manual") as identify:
        sets = ear.sets()
        candidates = ear.listen("quadid/candidate", ParameterSet, 100)
        answer = ear.call("quadid/approve", Approve)
        assert not answer.success
        assert not change("gate.width", double_value=5.0).successful, "outside its range"
        refused = change("window", double_value=8.0)
        assert not refused.successful
        assert "when the node is configured" in refused.reason
        assert not change("approval", string_value="never").successful
        assert change("approval", string_value="manual").successful
        with player(log, SPEED):
            assert ear.until(lambda: any(c.state == ParameterSet.STATE_PENDING for c in candidates)), identify.text
            assert not sets, "nothing is published before a person approves"
            waiting = next(c for c in candidates if c.state == ParameterSet.STATE_PENDING)
            wrong = ear.call("quadid/approve", Approve, Approve.Request(sequence=waiting.sequence - 1))
            assert not wrong.success
            done = ear.call("quadid/approve", Approve, Approve.Request(sequence=waiting.sequence))
            assert done.success, done.message
            assert ear.until(lambda: sets)
            assert sets[0].sequence == done.in_force
            assert list(sets[0].values) == list(waiting.values), "that set and no other"
            assert sets[0].approved_by == "ros service"
            again = ear.call("quadid/approve", Approve, Approve.Request(sequence=waiting.sequence))
            assert not again.success
            back = ear.call("quadid/rollback", Trigger)
        assert not back.success
        assert "no earlier set" in back.message
        assert ear.call("quadid/fit_now", Trigger).success
        assert identify.end()[0] == 0
    stored = read_history(tmp_path / "h.sqlite", "pelican")["sets"]
    assert [s["approved_by"] for s in stored if s["state"] == "accepted"] == ["ros service"]


def test_a_killed_fit_process_is_replaced_and_a_rollback_by_service_brings_the_set_before_back(
    log: Path, tmp_path: Path, ear: Ear, happened: Happened
) -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from quadid_msgs.msg import ParameterSet
    from rcl_interfaces.srv import GetParameters
    from std_srvs.srv import Trigger

    with node(tmp_path / "h.sqlite") as identify:
        sets = ear.sets()
        health = ear.listen("/diagnostics", DiagnosticArray)
        identify.wait_for("ready")
        with player(log, 1.0):
            assert ear.until(lambda: sets), identify.text
            os.kill(worker_of(identify.child.pid), signal.SIGKILL)
            assert ear.until(lambda: len(sets) >= 2), identify.text
            identify.wait_for("ended by signal 9")
            assert ear.until(lambda: restarts(health) == 1)
            before = sets[-2]
            assert ear.call("quadid/rollback", Trigger).success
            assert ear.until(lambda: sets[-1].state == ParameterSet.STATE_ROLLED_BACK)
            reads = ear.call("quadid/get_parameters", GetParameters, GetParameters.Request(names=["approval"]))
            assert reads.values[0].string_value == "manual", "as the rollback made it"
        assert list(sets[-1].values) == list(before.values)
        assert sets[-1].sequence > sets[-2].sequence
        assert sets[-1].approved_by == "ros service"
        assert identify.end()[0] == 0
    stored = read_history(tmp_path / "h.sqlite", "pelican")["sets"]
    assert "rolled_back" in [s["state"] for s in stored]
    happened(11, "fit process of the node killed in flight: replaced, said in /diagnostics, the next set came")


def test_two_vehicles_in_two_namespaces_do_not_mix(tmp_path: Path) -> None:

    heavy = (("mass_change", "time", 0.0), ("mass_change", "fraction", 0.2))
    logs = {}
    for name, effects in (("quad1", ()), ("quad2", heavy)):
        logs[name] = tmp_path / f"{name}.mcap"
        write_mcap(logs[name], flight(240.0, 6, "excited", effects).recording)
    history = tmp_path / "h.sqlite"
    with Ear() as ear, node(history, "quad1") as first, node(history, "quad2") as second:
        sets = {n: ear.sets(f"/{n}/quadid/parameters") for n in logs}
        for started in (first, second):
            started.wait_for("ready")
        with player(logs["quad1"], 1.0, "quad1"), player(logs["quad2"], 1.0, "quad2"):
            assert ear.until(lambda: all(sets.values())), first.text + second.text
        found = {n: dict(zip(s[0].names, s[0].values, strict=True))["b"] for n, s in sets.items()}
        assert {n: s[0].vehicle_id for n, s in sets.items()} == {"quad1": "quad1", "quad2": "quad2"}
        assert found["quad1"] == pytest.approx(2.33e-5, rel=0.01)
        assert found["quad2"] == pytest.approx(2.33e-5 / 1.2, rel=0.01)
        assert first.end()[0] == 0
        assert second.end()[0] == 0


ENDING = """
import os, signal, sys, threading, time
from pathlib import Path
from quadid_node.identify import main

def threads():
    return [p.read_text().strip() for p in Path("/proc/self/task").glob("*/comm")]

def end():
    while not any(name.startswith("dds.ev") for name in threads()):
        time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread(target=end, daemon=True).start()
main(["--ros-args", "-p", "history:=none", "-p", "autostart:=false"])
print("threads left:", *threads())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
def test_no_thread_of_the_middleware_outlives_the_node() -> None:
    """Such a thread races with the interpreter's end, which then is a SIGSEGV now and then."""
    with Process(sys.executable, "-c", ENDING) as ended:
        left = ended.wait_for("threads left")
        assert ended.code() == 0
    assert "dds.udp" not in left
    assert "dds.ev" not in left


@pytest.mark.parametrize("window", ["8", "8.0"])
def test_a_whole_number_is_a_number(window: str) -> None:
    import rclpy
    from quadid_node.node import IdentifyNode

    rclpy.init(args=["--ros-args", "-p", "history:=none", "-p", f"window:={window}", "-p", "gate.step:=1"])
    try:
        made = IdentifyNode(lambda: True)
        made.trigger_configure()
        assert made._service is not None
        assert made._service.session.settings.window == 8.0
        made.trigger_shutdown()
        made.destroy_node()
    finally:
        rclpy.try_shutdown()
        end_middleware()  # or its services would stay listed beside those of the next test's node


def test_no_event_of_a_topic_is_left_to_the_executor() -> None:
    """One that it watches outlives its topic, and the node ends by SIGSEGV now and then (ros2/rclpy issue 1644)."""
    import rclpy
    from quadid_node.node import IdentifyNode

    rclpy.init(args=["--ros-args", "-p", "history:=none"])
    try:
        configured = IdentifyNode(lambda: True)
        rclpys_own = {*configured.waitables}
        configured.trigger_configure()
        assert configured.count_publishers("/diagnostics") == 1
        assert configured.count_subscribers("/imu") == 1
        assert {*configured.waitables} == rclpys_own
        configured.trigger_shutdown()
        configured.destroy_node()
    finally:
        rclpy.try_shutdown()
        end_middleware()  # or its services would stay listed beside those of the next test's node


@pytest.mark.parametrize(("number", "times"), [(signal.SIGTERM, 1), (signal.SIGINT, 2)], ids=["term", "int int"])
def test_signals_end_it_cleanly_with_little_work(tmp_path: Path, number: int, times: int) -> None:
    with node(tmp_path / "h.sqlite") as identify:
        identify.wait_for("ready")
        code, work = identify.end(number, times)
    assert code == 0, identify.text
    assert "Traceback" not in identify.text
    assert work < 2.0, "processor seconds: a machine that others keep busy does not add to them"


def worker_of(pid: int) -> int:
    """Process id of the fit process of a node."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return next(int(c) for c in children if b"node.worker" in Path(f"/proc/{c}/cmdline").read_bytes())


def restarts(health: list[Any]) -> int:
    entry = next(s for s in health[-1].status if s.name.endswith("worker"))
    return int(next(v.value for v in entry.values if v.key == "restarts"))


@pytest.mark.parametrize(
    ("parameters", "word"),
    [
        ({"source": "mavros"}, "package mavros_msgs is not installed"),
        ({"vehicle": "pelikan"}, "no shipped vehicle 'pelikan'"),
    ],
)
def test_what_cannot_be_configured_is_told_with_the_fix(tmp_path: Path, parameters: dict[str, str], word: str) -> None:
    with node(tmp_path / "h.sqlite", **parameters) as identify:
        assert identify.code() == 2
        identify.wait_for(word)
        assert "Traceback" not in identify.text


def test_a_second_node_on_one_history_is_refused_and_may_observe(tmp_path: Path, happened: Happened) -> None:
    with node(tmp_path / "h.sqlite") as first:
        first.wait_for("ready")
        with node(tmp_path / "h.sqlite") as second:
            assert second.code() == 2
            assert "another service writes" in second.text
        with node(tmp_path / "h.sqlite", observer=True) as observer:
            observer.wait_for("ready")
            assert observer.end()[0] == 0
    happened(21, "second node on one history: refused with exit code 2 and the fix; as observer it runs")


def test_a_log_that_cannot_be_played_is_told(tmp_path: Path) -> None:
    with player(tmp_path / "none.mcap") as vehicle:
        assert vehicle.code() == 2
        assert "no file" in vehicle.text


# --- Which way Fast DDS carries the node's messages


_PORT = "/fastrtps_port"


def _mapped(folder: Path) -> str:
    """Files mapped into the memory of a node that is ready."""
    with node(folder / "h.sqlite") as identify:
        identify.wait_for("ready")
        mapped = Path(f"/proc/{identify.child.pid}/maps").read_text(encoding="utf-8")
        assert identify.end()[0] == 0
    return mapped


@pytest.mark.parametrize(("chosen", "shared"), [("", False), ("DEFAULT", True)])
def test_shared_memory_is_used_only_where_the_user_asks_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chosen: str, shared: bool
) -> None:
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE")
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", chosen)
    assert (_PORT in _mapped(tmp_path)) == shared


def test_the_shipped_profile_keeps_to_this_machine_without_shared_memory(tmp_path: Path) -> None:
    assert _PORT not in _mapped(tmp_path)


def test_a_profile_of_the_user_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FASTDDS_BUILTIN_TRANSPORTS", raising=False)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "profile.xml")
    without_shared_memory()
    assert "FASTDDS_BUILTIN_TRANSPORTS" not in os.environ


# --- The ROS node on Zenoh too: what `quadid watch` shows of it, and the commands it carries


def test_watch_sees_the_state_of_a_ros_node(tmp_path: Path) -> None:
    folder = tmp_path / "net"
    folder.mkdir()
    net = Net(folder)
    fleet = FleetView(net.client("watch"))
    try:
        with node(tmp_path / "h.sqlite", zenoh=net.client("quad1"), vehicle_id="quad1") as it:
            it.wait_for("ready")
            assert until(lambda: "health" in fleet.latest.get("quad1", {})), it.text
            assert fleet.alive["quad1"]
            done, text = fleet.command("quad1", "rollback", seconds=LIMIT)
            assert not done
            assert "no earlier set" in text
            assert it.end()[0] == 0
        assert until(lambda: not fleet.alive["quad1"])
    finally:
        fleet.close()
        net.close()
