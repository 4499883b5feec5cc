"""Row 6: one rule for saturation, shared by inspection, online windows and diagnosis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadid.checks import inspect
from quadid.data.window import at_limit, data_faults
from quadid.online.checks import judge
from quadid.online.grid_buffer import WindowCut
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import flight
from tests.online.test_quality import thrust_of

PELICAN = Vehicle.shipped("pelican")


@pytest.mark.parametrize("share", [0.5, 0.7])
def test_three_places_agree_on_a_saturated_sensor(share: float, happened: Happened) -> None:
    made = flight(30.0, 3)
    gyro = made.recording.channels["gyro"]
    top = share * float(np.abs(gyro.values[:, 1]).max())
    clipped = np.clip(gyro.values, -top, top)
    recording = replace(made.recording, channels={**made.recording.channels, "gyro": replace(gyro, values=clipped)})
    assert made.window.gyro is not None
    window = replace(made.window, gyro=np.clip(made.window.gyro, -top, top))
    assert any(end.axis == 1 for end in at_limit(clipped))
    assert any("saturated" in c.name for c in inspect(recording, PELICAN).checks)
    assert (
        "saturated" in judge(WindowCut((window,), len(window) * window.dt, 0), PELICAN, thrust_of(2.33e-5), True).fault
    )
    assert [f for f in data_faults([window]) if f.kind == "saturated"]
    happened(6, f"gyro clipped at {share:.0%} of its peak: inspection, online window and diagnosis name it by one rule")


@pytest.mark.parametrize("profile", ["excited", "hover"])
def test_no_true_flight_is_called_saturated_not_even_with_coarse_steps(profile: str) -> None:
    made = flight(30.0, 3, profile)
    for name, step in (("gyro", 0.02), ("accel", 0.1)):
        values = made.recording.channels[name].values
        assert at_limit(values) == []
        assert at_limit(np.round(values / step) * step) == []


def test_a_resting_command_is_not_saturated() -> None:
    rng = np.random.default_rng(0)
    command = np.concatenate([np.zeros(500), rng.uniform(0.3, 0.6, 1000), np.zeros(500)])[:, None]
    assert at_limit(command) == []
