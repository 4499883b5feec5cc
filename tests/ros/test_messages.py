"""quadid_msgs in this environment: complete, documented, and a latched set crosses to another process over DDS."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

NAMES = ("AttitudeCommand", "Diagnosis", "Finding", "FitStatus", "MotorCommand", "ParameterSet")


@pytest.mark.parametrize("name", NAMES)
def test_every_message_has_type_support(name: str) -> None:
    import quadid_msgs.msg
    from rclpy.serialization import deserialize_message, serialize_message

    kind: Any = getattr(quadid_msgs.msg, name)
    message = kind()
    assert deserialize_message(serialize_message(message), kind) == message


@pytest.mark.parametrize("name", NAMES)
def test_installed_definition_is_the_one_in_the_checkout(name: str, repository: Path) -> None:
    installed = Path(sys.prefix, "share", "quadid_msgs", "msg", f"{name}.msg").read_text(encoding="utf-8")
    assert installed == (repository / "msgs" / "msg" / f"{name}.msg").read_text(encoding="utf-8"), "run 'make messages'"


@pytest.mark.parametrize("name", NAMES)
def test_every_number_names_its_unit_or_meaning(name: str, repository: Path) -> None:
    text = (repository / "msgs" / "msg" / f"{name}.msg").read_text(encoding="utf-8")
    fields = [line for line in text.splitlines() if re.match(r"[A-Za-z]", line) and "=" not in line.split("#")[0]]
    assert fields
    for line in fields:
        assert "#" in line, f"{name}: no comment on '{line}'"
        if line.startswith("float64"):
            assert re.search(r"# \[\S+\]|# row-major", line), f"{name}: no unit in '{line}'"


def test_a_late_joiner_in_another_process_receives_the_latched_set() -> None:
    """The contract's parameter topic: reliable, transient local, depth 1."""
    import rclpy
    from quadid_msgs.msg import ParameterSet
    from rclpy.executors import SingleThreadedExecutor

    from tests.ros.latched_publisher import LATCHED, example

    with subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("latched_publisher.py"))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as publisher:
        assert publisher.stdin is not None
        assert publisher.stdout is not None
        assert publisher.stdout.readline() == "published\n"

        context = rclpy.Context()
        context.init()
        node = rclpy.create_node("late_joiner", context=context)
        received: list[Any] = []
        node.create_subscription(ParameterSet, "quadid/parameters", received.append, LATCHED)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        deadline = time.monotonic() + 30.0
        while not received and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
        executor.spin_once(timeout_sec=0.5)  # a second message would be one too many
        executor.shutdown()
        node.destroy_node()
        context.shutdown()

        publisher.stdin.close()
        assert publisher.wait(timeout=20.0) == 0
    assert received == [example(2)]
