"""Tests of the service: processes, files, links and topics are real."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from quadid_replay import write_mcap

from quadid.online.fit_job import warm_up
from quadid.vehicle import Vehicle
from tests.node.peers import Ear
from tests.online.driving import flight
from tests.ros_domain import ros as ros

HERE = Path(__file__).resolve().parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks those that need ROS."""
    for item in items:
        if HERE in item.path.parents and item.path.stem.startswith("test_ros"):
            item.add_marker(pytest.mark.ros)


@pytest.fixture(scope="session", autouse=True)
def warm_kernels() -> None:
    """Compiles what fits need once: after a change of a kernel every niced fit process would do it for minutes."""
    warm_up(Vehicle.shipped("pelican"))


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four minutes of flight: as long as a busy machine takes for what is waited for, and no test waits for its end."""
    path = tmp_path_factory.mktemp("log") / "flight.mcap"
    write_mcap(path, flight(240.0, 6).recording)
    return path


@pytest.fixture
def ear(ros: None) -> Iterator[Ear]:
    """A ROS node of this process that listens and calls."""
    with Ear() as made:
        yield made
