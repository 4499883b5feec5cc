"""The examples run as they stand; the one for ROS 2 is run by tests/node/test_ros_node.py."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import write_mcap

from quadid.errors import WindowError
from quadid.flight import fly
from quadid.model.simulate import simulate
from quadid.vehicle import GRAVITY, Vehicle


def run(repository: Path, name: str, *arguments: str | Path) -> str:
    """Output of an example in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(repository / "examples" / name), *map(str, arguments)],
        capture_output=True, text=True, timeout=280, check=False, env={**os.environ, "PYTHONPATH": str(repository)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_identify_in_ten_lines(repository: Path, tmp_path: Path) -> None:
    write_mcap(tmp_path / "flight.mcap", fly(Vehicle.shipped("pelican"), seconds=30.0, seed=4).recording)
    lines = run(repository, "identify.py", tmp_path / "flight.mcap").splitlines()
    assert [line.split()[0] for line in lines] == ["b", "d", "J_xx", "J_yy", "J_zz", "J_r"]
    assert float(lines[0].split()[1]) == pytest.approx(2.33e-5, rel=0.01)
    text = (repository / "examples" / "identify.py").read_text(encoding="utf-8")
    code = [line for line in text.splitlines() if line.strip() and not line.startswith(('"""', "#"))]
    assert len(code) <= 11  # ten statements; the import of sys is one


def test_the_extended_model_in_ones_own_simulator(repository: Path) -> None:
    out = run(repository, "own_simulator.py")
    assert "effects in the file: motor_lag" in out
    nominal, extended = (int(t) for t in re.findall(r"after (\d+) ms", out))
    assert extended > nominal + 10


def test_an_effect_of_ones_own(repository: Path) -> None:
    out = run(repository, "own_effect.py")
    knee, true, share = (float(v) for v in re.findall(r"(?:knee|true|share) ([0-9.]+)", out)[:3])
    before, after = (float(v) for v in re.findall(r"([0-9.]+) with", out))
    assert knee == pytest.approx(true, rel=0.01)
    assert share == pytest.approx(0.5, abs=0.1)
    assert after < 0.5 * before


def test_simulate_hovers_falls_and_starts_where_it_is_told() -> None:
    pelican = Vehicle.shipped("pelican")
    hover = np.full((50, 4), pelican.hover_speed())
    still = simulate(pelican, hover, 0.02)
    assert np.abs(still.velocity).max() < 1e-9
    np.testing.assert_allclose(still.force[:, 2], -GRAVITY, rtol=1e-9)
    fall = simulate(pelican, 0.0 * hover, 0.02, velocity=np.array([1.0, 0.0, 0.0]), position=np.array([0.0, 0.0, -9.0]))
    np.testing.assert_allclose(fall.velocity[:, 2], GRAVITY * fall.t, rtol=1e-9)
    np.testing.assert_allclose(fall.position[:, 2], -9.0 + 0.5 * GRAVITY * fall.t**2, rtol=1e-9)
    np.testing.assert_allclose(fall.position[:, 0], fall.t, rtol=1e-9)
    with pytest.raises(WindowError, match="rotor speeds of shape"):
        simulate(pelican, hover[:, :3], 0.02)
