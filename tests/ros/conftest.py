"""ROS tests: wheels and messages present, a DDS domain of their own."""

from pathlib import Path

import pytest

from tests.ros_domain import ros as ros

HERE = Path(__file__).resolve().parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks every test of this folder."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.ros)


@pytest.fixture(autouse=True)
def with_ros(ros: None) -> None:
    """Every test of this folder needs it."""
