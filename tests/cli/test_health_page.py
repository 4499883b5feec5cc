"""docs/health.md "Is my drone still healthy?": its command as it stands there, on recorded and on Betaflight logs."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from quadid_evaluation.studies.health.flights import Wrong, hover

from quadid.vehicle import GRAVITY, Vehicle
from tests.cli.followed_page import commands
from tests.commands import Cli
from tests.replay import blackbox_writer as writer

FLIGHTS = {"today": "controller_055", "a": "controller_067", "b": "controller_068", "c": "motor_144"}
"""Names on the page, and recorded flights: M3 cut, and healthy ones of the same airframe in both kinds of log."""
PELICAN_X = Vehicle.shipped("pelican_x")
BETAFLIGHT = PELICAN_X.model_copy(update={"rotors": tuple(PELICAN_X.rotors[j] for j in (1, 0, 2, 3))})
"""Its motors: 1 rear right, 2 front right, 3 rear left, 4 front left."""
ERPM = 7 * 60.0 / (2.0 * np.pi) / 100.0
"""Of 14 poles, in hundreds, per rad/s."""


def blackbox(vehicle: Vehicle, wrong: Wrong | None, seed: int) -> bytes:
    """A hover as Betaflight logs it: turns of the motors and acceleration, body FLU."""
    flown = hover(vehicle, wrong, seed).channels
    t, accel = flown["accel"].t, flown["accel"].values * (1.0, -1.0, -1.0) * 2048.0 / GRAVITY
    turns = np.rint(flown["rotor_speed"].values * ERPM).astype(int).tolist()
    rows = []
    for k, (force, speeds) in enumerate(zip(np.rint(accel).astype(int).tolist(), turns, strict=True)):
        row = dict.fromkeys(writer.NAMES, 0) | {
            "loopIteration": k,
            "time": round(1e6 * t[k]),
            "vbatLatest": 1590,
            "rcCommand[3]": 1500,
        }
        row |= {f"motor[{j}]": 48 + speed for j, speed in enumerate(speeds)}
        row |= {f"eRPM[{j}]": speed for j, speed in enumerate(speeds)}
        row |= {f"accSmooth[{j}]": one for j, one in enumerate(force)}
        rows.append([row[name] for name in writer.NAMES])
    return writer.header() + b"".join(writer.frames(rows)) + writer.END


def test_the_page_s_command_names_the_cut_propeller(
    inside: Cli, data_dir: Path, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, flight in FLIGHTS.items():
        shutil.copy(data_dir / "crazypad" / f"{flight}.usd", f"{name}.usd")
    (command,) = commands(repository / "docs" / "health.md")
    run = inside(*command)
    assert run.code == 0, run.err
    assert "The vehicle has changed: rotor 3: " in run.out
    assert 'class="disc damaged"' in Path("health.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("weak", [1, 2, None])
def test_the_same_command_on_betaflight_logs(
    inside: Cli, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weak: int | None
) -> None:
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(FLIGHTS):
        wrong = Wrong({weak: 0.2}, {weak: 0.2}) if weak and name == "today" else None
        Path(f"{name}.bbl").write_bytes(blackbox(BETAFLIGHT, wrong, seed))
    Path("mine.yaml").write_text(BETAFLIGHT.to_yaml(), encoding="utf-8")
    (command,) = commands(repository / "docs" / "health.md")
    filled_in = {"crazyflie": "mine.yaml"} | {f"{name}.usd": f"{name}.bbl" for name in FLIGHTS}
    run = inside(*[filled_in.get(word, word) for word in command])
    assert run.code == 0, run.err
    wanted = f"The vehicle has changed: rotor {weak}: " if weak else "The vehicle flies as it did in the baseline"
    assert wanted in run.out
