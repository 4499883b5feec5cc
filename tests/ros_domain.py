"""A DDS domain for each test process: no other run of tests on this machine is in it."""

import importlib.util
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from tests.conftest import REPOSITORY, absent

THIS_MACHINE = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(REPOSITORY / "quadid_node" / "config" / "loopback.xml"),
}
"""Environment of ROS processes that meet within this machine alone, without shared memory."""
DOMAINS = range(1, 101)
"""Numbers of domains; the ports of those above may be taken by clients of other programs."""


@contextmanager
def free_domain() -> Iterator[int]:
    """Claims the first domain that no other test process holds, by the TCP port beside the UDP ports that DDS takes."""
    with socket.socket() as claim:
        for number in DOMAINS:
            with suppress(OSError):
                claim.bind(("127.0.0.1", 7400 + 250 * number))
                break
        else:
            pytest.fail(f"all {len(DOMAINS)} DDS domains are held by other test processes")
        yield number


@pytest.fixture(scope="session")
def ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """ROS as installed here, in a domain of this process within this machine; logs go to a scratch folder."""
    for module in ("rclpy", "quadid_msgs"):
        if importlib.util.find_spec(module) is None:
            absent(f"{module} is not installed in {sys.prefix}: run 'make messages'")
    with free_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        for name, value in THIS_MACHINE.items():
            patch.setenv(name, value)
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        patch.setenv("AMENT_PREFIX_PATH", sys.prefix)
        patch.delenv("RMW_IMPLEMENTATION", raising=False)  # naming an absent one ends the process without a word
        yield
