"""Tests of the service: processes, files, links and topics are real; they run one after the other in one worker."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep them in one xdist worker: they measure time, and two of them at once would disturb each other."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.xdist_group("node"))
