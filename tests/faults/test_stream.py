"""Row 8: duplicates, reordering, jitter and 30 % dropout change the estimate by no more than its interval says."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.data.window import Sample
from quadid.online import Session, SessionSettings
from quadid.online.gate import GateSettings
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import drive, flight, published, samples

PELICAN = Vehicle.shipped("pelican")
QUICK = SessionSettings(window=5.0, gate=GateSettings(windows=2, width=0.08, yaw_width=0.6))


def disturbed(stream: list[Sample], how: str) -> list[Sample]:
    rng = np.random.default_rng(8)
    if how == "duplicates":
        return [s for sample in stream for s in (sample,) * int(rng.integers(1, 4))]
    if how == "reordering":
        return sorted(stream, key=lambda s: s.t + rng.uniform(0.0, 0.2))
    if how == "jitter":
        return [Sample(s.t + rng.normal(0.0, 0.001), s.channel, s.values) for s in stream]
    return [s for s in stream if rng.random() > 0.3]


@pytest.mark.parametrize("how", ["duplicates", "reordering", "jitter", "dropout"])
def test_a_disturbed_stream_gives_the_same_estimate_or_the_reason(how: str, happened: Happened) -> None:
    stream = samples(flight(16.0, 6).recording)
    clean = published(drive(Session(PELICAN, QUICK), stream), "candidate")[-1].parameters
    session = Session(PELICAN, QUICK)
    sets = published(drive(session, disturbed(stream, how)), "candidate")
    if not sets:
        reason = session.status().reason
        assert reason
        happened(8, f"{how} at 50 Hz: no estimate, the reason said: {reason}")
        return
    found = sets[-1].parameters
    pairs = [(found[name], clean[name]) for name in ("b", "J_xx", "J_yy")]
    off = [abs(a.value - b.value) / np.hypot(a.sigma, b.sigma) for a, b in pairs]
    assert max(off) < 3.0, off
    wider = found["J_xx"].sigma / found["J_xx"].value / (clean["J_xx"].sigma / clean["J_xx"].value)
    happened(8, f"{how}: b, J_xx, J_yy within {max(off):.1f} sigma of the clean run; interval x {wider:.2f}")
