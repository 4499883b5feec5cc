"""The node as `ros2 run quadid_node identify` starts it: it comes up, offers its topics latched, and ends cleanly."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("quadid_msgs")

LATCHED = {
    "/quadid/parameters": "quadid_msgs/msg/ParameterSet",
    "/quadid/diagnosis": "quadid_msgs/msg/Diagnosis",
    "/quadid/health": "quadid_msgs/msg/Health",
}
"""Topics whose last message reaches who comes late."""
SECONDS = 600.0
"""The first start on a machine compiles; a busy one takes minutes to it."""


def test_it_starts_offers_its_topics_and_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    given = ("vehicle:=pelican", f"history:={tmp_path / 'history.sqlite'}")
    command = [sys.executable, "-m", "quadid_node.identify", "--ros-args", *(a for g in given for a in ("-p", g))]
    context = rclpy.Context()
    context.init()
    listener = rclpy.create_node("listener", context=context)
    with (tmp_path / "said.txt").open("w") as said, subprocess.Popen(command, stdout=said, stderr=said) as node:
        try:
            offered: dict[str, Any] = {}
            deadline = time.monotonic() + SECONDS
            while set(offered) < set(LATCHED) and node.poll() is None and time.monotonic() < deadline:
                time.sleep(0.2)
                offers = {topic: listener.get_publishers_info_by_topic(topic) for topic in LATCHED}
                offered = {topic: found[0] for topic, found in offers.items() if found}
            assert {t: o.topic_type for t, o in offered.items()} == LATCHED, (tmp_path / "said.txt").read_text()
            for topic, offer in offered.items():
                assert offer.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL, topic
                assert offer.qos_profile.reliability is ReliabilityPolicy.RELIABLE, topic
            node.send_signal(signal.SIGINT)
            assert node.wait(30.0) == 0, (tmp_path / "said.txt").read_text()
        finally:
            node.kill()
            listener.destroy_node()
            context.shutdown()
