"""The recorded soak: what docs/results/soak.json says must keep the promises of a long run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from quadid_evaluation.studies.soak import slope

from tests.faults.evidence import Happened


def test_the_recorded_hour_lost_nothing_and_stayed_flat(repository: Path, happened: Happened) -> None:
    found = json.loads((repository / "docs/results/soak.json").read_text())["live"]
    r = found["result"]
    sent, taken = r["sent"], r["minutes"][-1]["messages"]
    assert sent == {topic: taken.get(topic, 0) for topic in sent}
    assert not r["minutes"][-1]["dropped"]
    assert r["exit_code"] == 0
    hours, grown = r["points"][-1]["hours"], slope(r["points"], "memory_mib")
    assert hours >= 1.0
    assert grown < 4.0
    assert r["points"][-1]["handles"] <= r["points"][1]["handles"]
    p99 = np.median([m["p99"] for m in r["minutes"] if m["p99"] is not None])
    load, count = r["points"][-1]["load"], sum(sent.values())
    happened(
        22, f"{hours:.1f} h of the node in real time, recorded {found['measured']}: {count:,} messages, none "
        f"lost; memory {grown:+.1f} MiB/h, handles constant; IMU latency p99 {p99:.0f} ms at a load of {load:.0f}"
    )  # fmt: skip


def test_the_recorded_accelerated_flight_lost_nothing_and_stayed_flat(repository: Path, happened: Happened) -> None:
    found = json.loads((repository / "docs/results/soak.json").read_text())["accelerated"]
    points, asked = found["result"]["points"], found["result"]["asked_hours"]
    last = points[-1]
    assert last["sent"] == last["taken"] + last["dropped"]
    grown = slope(points, "memory_mib")
    assert grown < 4.0
    happened(
        22, f"{last['hours']:.1f} h of flight at accelerated time of the {asked:.0f} wanted, recorded "
        f"{found['measured']}: {last['sent']:,} samples, none lost; memory {grown:+.1f} MiB/h"
    )  # fmt: skip
