"""Recorded MAVLink bytes as a worse link brings them: fewer, late, in bursts, out of order, some not at all."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect
from quadid_node.mavlink_link import MavlinkDecoder
from quadid_replay.tlog import read_frames

from quadid.data.window import Block


def through_bad_link(
    log: Path,
    seed: int,
    *,
    rate: float = np.inf,
    held: float = 0.0,
    lost: float = 0.0,
    apart: float = 0.0,
    part: tuple[float, float] = (0.0, np.inf),
) -> Iterator[Block]:
    """Yields what the service makes of an ArduCopter's telemetry, its motors on the first outputs.

    Args:
        rate: of every kind of message at most [Hz].
        held: bytes are read in bursts, each of what came in a random time up to this [s].
        lost: share of frames that do not come.
        apart: frames change places with others so far away at most [s].
        part: of the log that is sent [s after its first frame].
    """
    rng, frames = np.random.default_rng(seed), read_frames(log)
    came = frames.received - frames.received[0]
    sent = (frames.system == 1) & (came >= part[0]) & (came < part[1]) & (rng.random(len(came)) >= lost)
    if np.isfinite(rate):
        for kind in np.unique(frames.message[sent]):
            rows = np.flatnonzero(sent & (frames.message == kind))
            sent[rows[1:][np.diff(np.floor(came[rows] * rate)) == 0.0]] = False
    rows = np.flatnonzero(sent)
    due = came[rows] + rng.uniform(0.0, apart, len(rows))
    looks = due if held == 0.0 else part[0] + np.cumsum(rng.uniform(0.0, held, round(4.0 * np.ptp(came[rows]) / held)))
    decoder, coder = MavlinkDecoder(4, wall=lambda: 0.0), dialect.MAVLink(None)
    decoder.order.ardupilot = True
    for k in range(4):
        decoder.order.tell(f"SERVO{k + 1}_FUNCTION", 33.0 + k)
    for k in np.argsort(due, kind="stable").tolist():
        place = int(np.searchsorted(looks, due[k])) if held else k
        message = coder.decode(bytearray(frames.frame(int(rows[k]))))
        yield from decoder.blocks(message, float(looks[place]), float(looks[place - 1]) if held and place else None)
