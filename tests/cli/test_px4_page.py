"""The page for users of PX4, "From logs": every command as it stands there, on logs with motors at full rate.

What a person fills in is the mass, and the file that `diagnose` names.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from quadid.flight import TruthParameters, fly
from quadid.vehicle import Vehicle
from tests.cli.conftest import Cli
from tests.replay.px4_flight import px4_ulog

MAX_SPEED = 900.0
"""Rotor speed at full command [rad/s]."""
DRAG = {"rotor_drag": {"k_x": 0.3, "k_y": 0.3}}


def from_logs(page: Path) -> list[list[str]]:
    """The commands of the page's chapter "From logs", as a shell splits them, without the program's name."""
    block = page.read_text(encoding="utf-8").split("## From logs\n```\n")[1].split("```")[0]
    return [shlex.split(line, comments=True)[1:] for line in block.splitlines()]


def follow(page: Path, quadid: Cli, mass: float) -> dict[str, dict[str, Any]]:
    """Does what the page says in the current folder, which holds its logs; what each command said, by its name."""
    told: dict[str, dict[str, Any]] = {}
    for name, *arguments in from_logs(page):
        given = [told["diagnose"]["vehicle_file"] if "…" in a else a for a in arguments]
        run = quadid(name, *given, "--json", "-")
        assert run.code == 0, (name, given, run.err)
        told[name] = run.data
        if name == "init":
            file = Path("my_quad.yaml")
            text = file.read_text(encoding="utf-8")
            assert text.count("FILL IN") == 1
            file.write_text(re.sub(r"(?m)^mass: \S+", f"mass: {mass}", text), encoding="utf-8")
    return told


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_first_flight_with_px4(inside: Cli, tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A made-up log: the shared flights of a real PX4 have motors at 10 Hz only, from which no inertia comes."""
    monkeypatch.chdir(tmp_path)
    pelican = Vehicle.shipped("pelican")
    for seed, name in ((5, "flight.ulg"), (6, "second.ulg")):
        flight = fly(pelican, seconds=90.0, seed=seed, log_rate=100.0, effects=DRAG)
        (tmp_path / name).write_bytes(px4_ulog(flight, pelican, MAX_SPEED))
    told = follow(repository / "docs" / "using-with-px4.md", inside, pelican.mass)
    published = told["replay"]["published"]
    assert published
    truth = TruthParameters.of(pelican)
    for item in published:
        values = {p["name"]: p["value"] for p in item["parameters"]}
        for name in ("b", "J_xx", "J_yy"):
            assert values[name] == pytest.approx(getattr(truth, name), rel=0.03)
    assert {f["effect"] for f in told["diagnose"]["findings"]} == {"rotor_drag"}
    assert all(Path(file).is_file() for file in told["export"]["files"])
