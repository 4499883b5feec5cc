"""Motor readings of a live link are asked for out of step with sticks that move in steps."""

from __future__ import annotations

import numpy as np
import pytest
from quadid_evaluation.studies.readings import LOOP, errors
from quadid_node.mavlink_link import MOTORS as RATE
from quadid_node.mavlink_link import REQUESTED

from quadid.types import FloatArray

MOTORS = ("SERVO_OUTPUT_RAW", "ACTUATOR_OUTPUT_STATUS", "ESC_STATUS", "ESC_TELEMETRY_1_TO_4")
RING, DAMPING = 2.0 * np.pi * 22.0, 0.1


def ringing(step: float, seconds: float = 60.0) -> FloatArray:
    """Torque of a loop that rings at 22 Hz and follows slow sticks, which come every `step` [s]."""
    t, runs = np.arange(round(seconds / LOOP)) * LOOP, round(step / LOOP)
    sticks = sum(a * np.sin(2.0 * np.pi * f * t + p) for a, f, p in ((1.0, 0.3, 0.0), (0.6, 0.7, 1.0), (0.4, 1.3, 2.0)))
    out, place, speed = np.empty(len(t)), 0.0, 0.0
    for k in range(len(t)):
        speed += LOOP * (RING**2 * (sticks[k - k % runs] - place) - 2.0 * DAMPING * RING * speed)
        place += LOOP * speed
        out[k] = speed
    return out


@pytest.mark.parametrize("step", [0.02, 0.04])
@pytest.mark.parametrize("message", MOTORS)
def test_snapshots_as_asked_for_give_slow_torque_where_those_in_step_do_not(message: str, step: float) -> None:
    torque = ringing(step)
    ours = round(1.0 / REQUESTED.get(message, RATE) / LOOP)
    in_step, asked = (np.abs(errors(torque, runs)).max() for runs in (8, ours))
    assert in_step > 0.2
    assert asked < 0.01
