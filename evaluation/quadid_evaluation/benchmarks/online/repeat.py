"""The same flight live and replayed: samples late and out of order, fits in a process of its own, against inline."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from quadid_node.service import Service
from quadid_node.worker import InlineWorker, ProcessWorker

from quadid.data.window import Sample
from quadid.online import Publish, SessionSettings
from quadid_evaluation.benchmarks.online.accuracy import PELICAN, flown
from quadid_evaluation.benchmarks.online.driving import samples

DELAYS = {"attitude": 0.1, "rotor_speed": 0.3}
"""How much later these channels come than the others [s]."""
PACE = 10.0
"""Times real time."""


def outcome(item: Any) -> tuple[Any, ...]:
    """Everything of a set that must be the same, to the bit."""
    p = item.parameters
    return item.state, item.reason, p.values.tobytes(), p.covariance.tobytes(), item.input_hash


def run_live(service: Service, arriving: list[Sample]) -> list[tuple[Any, ...]]:
    """Plays samples in the order of arrival at a pace, polling as a service does, until the last fit is back."""
    out: list[tuple[Any, ...]] = []

    def step() -> None:
        out.extend(outcome(o.item) for o in service.step() if isinstance(o, Publish))

    while not service.ready:
        step()
        time.sleep(0.02)
    begin, first = time.monotonic(), arriving[0].t
    for k, sample in enumerate(arriving):
        service.push(sample)
        if k % 20 == 0:
            step()
            time.sleep(max(begin + (sample.t - first) / PACE - time.monotonic(), 0.0))
    while service.session.running is not None or service.session.status().backlog > 1.0:
        step()
        time.sleep(0.002)
    return out


def repeatability(seconds: float, seed: int) -> dict[str, Any]:
    """Estimates of a live run and of its replay: how many, and whether all are the same to the bit."""
    flight = flown(seconds, seed)
    rng = np.random.default_rng(seed)
    every = list(samples(flight.recording))
    arrival = [s.t + DELAYS.get(s.channel, 0.0) + rng.exponential(0.02) for s in every]
    arriving = [every[i] for i in np.argsort(arrival, kind="stable")]
    settings = SessionSettings()
    live_service = Service(PELICAN, settings, ProcessWorker(PELICAN))
    try:
        live = run_live(live_service, arriving)
    finally:
        live_service.close()
    replayed = run_live(Service(PELICAN, settings, InlineWorker()), arriving)
    return {"seconds": seconds, "estimates": len(live), "same_bits": live == replayed and len(live) > 0}
