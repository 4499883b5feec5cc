"""The ROS node where nobody tells the rotors: IMU, attitude and references only, over DDS."""

from __future__ import annotations

from pathlib import Path

import pytest
from quadid_replay import write_mcap

from quadid.flight import fly
from tests.node.peers import Ear, node, player
from tests.online.test_command_reconstruction import STEERED, without_rotors

pytestmark = pytest.mark.usefixtures("ros")


def test_a_set_comes_from_references_through_the_stabiliser(tmp_path: Path, ear: Ear) -> None:
    from quadid_msgs.msg import ParameterSet

    flight = fly(STEERED, seconds=60.0, seed=5, profile="excited")
    log, vehicle = tmp_path / "flight.mcap", tmp_path / "steered.yaml"
    write_mcap(log, without_rotors(flight.recording))
    vehicle.write_text(STEERED.to_yaml())
    with node(tmp_path / "h.sqlite", vehicle=vehicle) as identify:
        candidates = ear.listen("quadid/candidate", ParameterSet, 100)
        identify.wait_for("ready", 120.0)
        with player(log, 2.0):
            accepted = ear.until(lambda: any(c.state == ParameterSet.STATE_ACCEPTED for c in candidates), 90.0)
        assert accepted, [c.reason for c in candidates]
        assert identify.end()[0] == 0
    taken = next(c for c in candidates if c.state == ParameterSet.STATE_ACCEPTED)
    values, truth = dict(zip(taken.names, taken.values, strict=True)), flight.truth.parameters.as_dict()
    for name in ("b", "J_xx", "J_yy"):
        assert values[name] == pytest.approx(truth[name], rel=0.03)
