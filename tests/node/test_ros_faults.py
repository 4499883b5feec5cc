"""Faults of topics and processes around the real node, over DDS: silence, rivals, wrong types, signals, power cuts."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import pytest
from quadid_node.history import read_history

from tests.faults.evidence import Happened
from tests.node.peers import Ear, node, player
from tests.node.test_ros_node import latched, level, message

pytestmark = pytest.mark.usefixtures("ros")
OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"


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
            code, took = starting.end(number)
            spent.append(took)
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
    happened(
        13, f"SIGTERM or SIGINT 0.7, 1.5, 3 s after the start: gone after {times} s (measured beside other programs)"
    )
    happened(13, f"kill -9 in flight: set {last.sequence} came back as stale with the same bits")
