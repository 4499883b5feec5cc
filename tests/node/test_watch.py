"""`quadid watch`, run as a user runs it, through a router with TLS."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from quadid_node.zenoh import ZenohLink

from tests.node.peers import Process
from tests.node.zenoh_net import Net, accepted, service
from tests.online.test_gate import TRUE, online_set


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Net]:
    made = Net(tmp_path_factory.mktemp("zenoh"))
    yield made
    made.close()


def quadid(*arguments: str) -> Process:
    return Process(str(Path(sys.executable).with_name("quadid")), *arguments, COLUMNS="160")


def test_quadid_watch_shows_the_fleet_and_carries_commands(net: Net) -> None:
    """The command itself, a process of its own: live view, JSON, approval, and a vehicle that is not there."""
    owned = service()
    owned.session.active_set.approval = "manual"
    owned.session.active_set.hold(online_set(TRUE), 30.0)
    link = ZenohLink(net.client("quad1"), "quad1", owned)
    link.publish(accepted(2))
    link.report(owned.health())
    where = ("watch", "--zenoh", net.client("watch"))
    with link_attended(link):
        with quadid(*where, "--seconds", "3") as live:
            assert live.child.wait(60) == 0, live.text
        assert "quad1" in live.text
        assert "waiting: no samples yet" in live.text
        assert "J_xx" in live.text
        with quadid(*where, "--json", "-") as once:
            assert once.child.wait(60) == 0
        assert json.loads(once.text)["vehicles"]["quad1"]["parameters"]["sequence"] == 2
        with quadid(*where, "--approve", "quad1", "--json", "-") as approve:
            assert approve.child.wait(60) == 0, approve.text
        assert "approved, in force as set" in json.loads(approve.text)["text"]
        with quadid(*where, "--rollback", "quad9") as nobody:
            assert nobody.child.wait(60) == 3
        assert "no answer from 'quad9'" in nobody.text
    with quadid("watch", "--zenoh", "nowhere.json5") as wrong:
        assert wrong.child.wait(60) == 2
    assert "no Zenoh configuration" in wrong.text


@contextlib.contextmanager
def link_attended(link: ZenohLink) -> Iterator[None]:
    """A thread that does what the loop of `quadid serve` does for its link."""
    over = threading.Event()

    def attend() -> None:
        while not over.wait(0.02):
            link.attend()

    thread = threading.Thread(target=attend)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        link.close()
