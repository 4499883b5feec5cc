"""Which way Fast DDS carries the node's messages."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from quadid_node.process import without_shared_memory

from tests.node.peers import node

pytestmark = pytest.mark.usefixtures("ros")
_PORT = "/fastrtps_port"


def _mapped(folder: Path) -> str:
    """What a node that is ready has in its memory."""
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
