"""Runs the real command line in a process of its own, on simulated flights that are flown once a session."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from quadid_replay import write_csv, write_mcap

from quadid.flight import Flight, fly
from quadid.vehicle import Vehicle

QUADID = [sys.executable, "-c", "import sys; from quadid.cli.main import app_main; sys.exit(app_main())"]


class Run(NamedTuple):
    """What a command did."""

    code: int
    out: str
    err: str

    @property
    def data(self) -> dict[str, Any]:
        """Stdout as JSON; fails when anything else is there."""
        parsed = json.loads(self.out)
        assert isinstance(parsed, dict)
        return parsed


Cli = Callable[..., Run]


@pytest.fixture(scope="session")
def quadid() -> Cli:
    """Returns a function that runs `quadid` with arguments."""

    def run(*arguments: str | Path, cwd: Path | None = None, **environment: str) -> Run:
        done = subprocess.run(
            [*QUADID, *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=cwd,
            env={**os.environ, "COLUMNS": "160", **environment},
            timeout=280,
            check=False,
        )
        return Run(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture
def inside(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Cli:
    """The same in this process, through the same entry point: many calls cost no start."""
    from quadid.cli.main import app_main

    monkeypatch.setenv("COLUMNS", "160")

    def run(*arguments: str | Path) -> Run:
        monkeypatch.setattr(sys, "argv", ["quadid", *map(str, arguments)])
        capfd.readouterr()
        code = app_main()
        return Run(code, *capfd.readouterr())

    return run


class Flights(NamedTuple):
    """Logs of simulated Pelicans and the flights behind them."""

    train: Path
    unseen: Path
    train_flight: Flight
    unseen_flight: Flight


@pytest.fixture(scope="session")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Flights:
    """Two lively flights of 30 s, one logged as MCAP and one as CSV with velocity and position."""
    folder = tmp_path_factory.mktemp("flights")
    pelican = Vehicle.shipped("pelican")
    train = fly(pelican, seconds=30.0, seed=11)
    unseen = fly(pelican, seconds=30.0, seed=12, extras=("velocity", "position"))
    write_mcap(folder / "train.mcap", train.recording)
    write_csv(folder / "unseen.csv", unseen.recording)
    return Flights(folder / "train.mcap", folder / "unseen.csv", train, unseen)


def table(path: Path) -> tuple[list[str], np.ndarray]:
    """Header and numbers of a CSV log."""
    names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    return names, np.loadtxt(path, delimiter=",", skiprows=1)


def write_table(path: Path, names: list[str], rows: np.ndarray) -> Path:
    """Writes a CSV log."""
    np.savetxt(path, rows, delimiter=",", header=",".join(names), comments="", fmt="%.10g")
    return path


def one_line(run: Run, code: int) -> str:
    """Checks that a command failed with one line and no traceback; returns the line."""
    assert run.code == code, run.err
    lines = [line for line in run.err.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1, run.err
    assert lines[0].startswith("quadid: ")
    assert "Traceback" not in run.err
    assert run.out == ""
    return lines[0]
