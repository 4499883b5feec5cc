"""The page for users of PX4, "From logs": every command as it stands there, on logs with motors at full rate.

What a person fills in is the mass, and the file that `diagnose` names.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from quadid.flight import TruthParameters, fly
from quadid.vehicle import Vehicle
from tests.cli.followed_page import follow
from tests.commands import Cli
from tests.replay.px4_flight import px4_ulog

PELICAN = Vehicle.shipped("pelican")
MAX_SPEED = 900.0
"""Rotor speed at full command [rad/s]."""
DRAG = {"rotor_drag": {"k_x": 0.3, "k_y": 0.3}}


def weighed(text: str) -> str:
    """The vehicle file with the mass filled in, all that it asks for."""
    assert text.count("FILL IN") == 1
    return re.sub(r"(?m)^mass: \S+", f"mass: {PELICAN.mass}", text)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_first_flight_with_px4(inside: Cli, tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A made-up log: the shared flights of a real PX4 have motors at 10 Hz only, from which no inertia comes."""
    monkeypatch.chdir(tmp_path)
    for seed, name in ((5, "flight.ulg"), (6, "second.ulg")):
        flight = fly(PELICAN, seconds=90.0, seed=seed, log_rate=100.0, effects=DRAG)
        (tmp_path / name).write_bytes(px4_ulog(flight, PELICAN, MAX_SPEED))
    told = follow(repository / "docs" / "using-with-px4.md", inside, weighed)
    published = told["replay"]["published"]
    assert published
    truth = TruthParameters.of(PELICAN)
    for item in published:
        values = {p["name"]: p["value"] for p in item["parameters"]}
        for name in ("b", "J_xx", "J_yy"):
            assert values[name] == pytest.approx(getattr(truth, name), rel=0.03)
    assert {f["effect"] for f in told["diagnose"]["findings"]} == {"rotor_drag"}
    assert all(Path(file).is_file() for file in told["export"]["files"])
