"""The ROS node on Zenoh too: what `quadid watch` shows of it, and the commands it carries."""

from __future__ import annotations

from pathlib import Path

import pytest
from quadid_node.zenoh import Fleet

from tests.node.peers import node
from tests.node.zenoh_net import Net, until

pytestmark = pytest.mark.usefixtures("ros")


def test_watch_sees_the_state_of_a_ros_node(tmp_path: Path) -> None:
    folder = tmp_path / "net"
    folder.mkdir()
    net = Net(folder)
    fleet = Fleet(net.client("watch"))
    try:
        with node(tmp_path / "h.sqlite", zenoh=net.client("quad1"), vehicle_id="quad1") as it:
            it.wait_for("ready")
            assert until(lambda: "health" in fleet.latest.get("quad1", {})), it.text
            assert fleet.alive["quad1"]
            done, text = fleet.command("quad1", "rollback", seconds=60.0)
            assert not done
            assert "no earlier set" in text
            assert it.end()[0] == 0
        assert until(lambda: not fleet.alive["quad1"])
    finally:
        fleet.close()
        net.close()
