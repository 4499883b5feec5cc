"""What ROS users publish wrongly is named in /diagnostics of a real node; `test_mistakes_are_said` has the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_node.messages import WARN
from quadid_replay import write_mcap

from tests.node.peers import Ear, node, player
from tests.node.test_mistakes_are_said import MISTAKES
from tests.online.driving import flight

pytestmark = pytest.mark.usefixtures("ros")


def test_a_mistake_on_the_topics_is_named_at_warn(tmp_path: Path, ear: Ear) -> None:
    from diagnostic_msgs.msg import DiagnosticArray

    changes, word = MISTAKES["two rotors exchanged"]
    recording = flight(240.0, 3).recording
    channels = dict(recording.channels)
    for name, change in changes.items():
        values = np.array([change(tuple(row)) for row in channels[name].values.tolist()])
        channels[name] = replace(channels[name], values=values)
    write_mcap(tmp_path / "spoilt.mcap", replace(recording, channels=channels))
    health = ear.listen("/diagnostics", DiagnosticArray)

    def said() -> list[Any]:
        return [s for h in health for s in h.status if s.name == "quadid: session" and word in s.message]

    with node(tmp_path / "h.sqlite") as identify:
        identify.wait_for("ready")
        with player(tmp_path / "spoilt.mcap", 3.0):
            assert ear.until(said), identify.text
    assert {s.level for s in said()} == {WARN}
    inputs = [s.message for h in health for s in h.status if s.name == "quadid: inputs"]
    assert "data arrive" in inputs
    assert not [text for text in inputs if "bursts" in text or "_covariance" in text], "of evenly sent messages"
