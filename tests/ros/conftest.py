"""ROS tests: wheels and messages present, a DDS domain of their own."""

import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import THIS_MACHINE, absent

HERE = Path(__file__).resolve().parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks every test of this folder."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.ros)


@pytest.fixture(scope="session", autouse=True)
def ros_environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A DDS domain of this run's own, reachable from this machine only; logs go to a scratch folder."""
    for module in ("rclpy", "quadid_msgs"):
        if importlib.util.find_spec(module) is None:
            absent(f"{module} is not installed in {sys.prefix}: run 'make messages'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))  # above 101 the ports may be taken by clients
        for name, value in THIS_MACHINE.items():
            patch.setenv(name, value)
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        patch.setenv("AMENT_PREFIX_PATH", sys.prefix)
        patch.delenv("RMW_IMPLEMENTATION", raising=False)  # naming an absent one ends the process without a word
        yield
