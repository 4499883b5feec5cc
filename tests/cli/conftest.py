"""Simulated flights for the command line, flown once a session."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from quadid_replay import write_csv, write_mcap

from quadid.flight import Flight, fly
from quadid.vehicle import Vehicle


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
