"""Recorded telemetry over worse links: nothing is said of the link at its start, and nothing false of the vehicle."""

from pathlib import Path

import pytest
from quadid_node.recording import play
from quadid_node.service import Service, session_settings
from quadid_node.worker import InlineWorker

from quadid.online import Event
from quadid.vehicle import Vehicle
from tests.node.bad_link import through_bad_link

FLIGHTS = {
    "ardupilot_sitl/quad_sq_pwm.tlog": "ardupilot_sitl/quad_sq_pwm.yaml",
    "findings/ardupilot/first_sticks_57s_false_pitch_step.tlog": "findings/ardupilot/mine_pwm.yaml",
}
LINKS = {
    "as recorded": {},
    "25 Hz": {"rate": 25.0},
    "bursts of up to 2 s": {"held": 2.0},
    "a tenth lost": {"lost": 0.1},
    "out of order": {"apart": 0.05},
}


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("log", FLIGHTS)
def test_the_start_of_a_link_blames_no_clock_and_no_gyro(log: str, link: str, data_dir: Path) -> None:
    """Motor outputs that the decoder held back for the clock came at once: "no gyro for -0.8 s"."""
    service = Service(Vehicle.named(data_dir / FLIGHTS[log]), session_settings("auto", seed=0), InlineWorker())
    said = play(service, through_bad_link(data_dir / log, 1, part=(0.0, 8.0), **LINKS[link]))
    assert [one.text for one in said if isinstance(one, Event) and "gyro" in one.text] == []
