"""A service that reads its link late, as beside other jobs: rotor speeds without a stamp stay in their round."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_node.mavlink_link import MavlinkDecoder, MavlinkLink
from quadid_node.mavlink_wire import dialect
from quadid_replay.tlog import read_frames

from tests.node.mavlink_ends import Sender, free_port

ROUND = 0.02
"""Between two rounds of messages [s]."""


def speeds(rpm: int) -> Any:
    return dialect.MAVLink_esc_telemetry_1_to_4_message([20] * 4, [0] * 4, [0] * 4, [0] * 4, [rpm] * 4, [0] * 4)


def test_what_came_while_nobody_looked_is_of_the_moment_before() -> None:
    port, now = free_port(), [100.0]
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", 4, clock=lambda: now[0])
    vehicle, got = Sender(port), []
    vehicle.heartbeat(autopilot=3)
    for k in range(4):
        vehicle.send(dialect.MAVLink_param_value_message(f"SERVO{k + 1}_FUNCTION".encode(), 33 + k, 4, 4, k))
    list(link.receive())
    for k in range(100):
        vehicle.imu(10.0 + ROUND * k)
        got += list(link.receive())
        vehicle.send(speeds(4000 + k))
        now[0] += ROUND  # busy with something else
        got += list(link.receive())
    link.close()
    gyro, rotors = ([s.t for s in got if s.channel == channel] for channel in ("gyro", "rotor_speed"))
    assert len(rotors) == 99
    np.testing.assert_allclose(rotors, gyro[:99], rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("every", [0.026, 0.2])
def test_a_flight_whose_bytes_are_read_late_keeps_its_rounds(every: float, data_dir: Path) -> None:
    """ArduCopter sends rotor speeds in rounds of 20 ms; looked for more rarely, they still come evenly."""
    frames = read_frames(data_dir / "ardupilot_sitl" / "x.tlog")
    came = frames.received - frames.received[0]
    decoder, coder, times = MavlinkDecoder(4, wall=lambda: 0.0), dialect.MAVLink(None), []
    decoder.order.ardupilot = True
    for k in range(4):
        decoder.order.tell(f"SERVO{k + 1}_FUNCTION", 33.0 + k)
    for k in np.flatnonzero((came > 50.0) & (came < 60.0) & (frames.system == 1)).tolist():
        message, read = coder.decode(bytearray(frames.frame(k))), every * np.ceil(came[k] / every)
        times += [s.t for s in decoder.samples(message, read, read - every) if s.channel == "rotor_speed"]
    assert len(times) > 490
    np.testing.assert_allclose(np.diff(times), ROUND, rtol=0.0, atol=2e-3)
