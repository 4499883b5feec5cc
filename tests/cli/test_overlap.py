"""A flight that was fitted cannot validate: under another name, in another format, in part, from a second recorder."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import write_csv, write_mcap

import quadid
from quadid.app.logs import Log, check_unseen
from quadid.data.window import Recording
from quadid.errors import LogError
from tests.cli.conftest import Flights
from tests.commands import Cli, one_line


def load(path: Path | str) -> Log:
    return quadid.load(path, vehicle="pelican")


def moved(recording: Recording, by: float, noise: float = 0.0) -> Recording:
    """The recording at another time [s], as another gyro with noise of its own [rad/s] has it."""
    channels = {n: replace(c, t=c.t + by) for n, c in recording.channels.items()}
    rates = channels["gyro"].values
    extra = noise * np.random.default_rng(1).standard_normal(rates.shape)
    channels["gyro"] = replace(channels["gyro"], values=rates + extra)
    return replace(recording, channels=channels)


@pytest.mark.parametrize("spans", [("", ""), ("@0:20", "@15:30"), ("", "@5:15"), ("@10:20", "")])
def test_the_same_log_and_overlapping_parts_of_it(
    spans: tuple[str, str], inside: Cli, flights: Flights, tmp_path: Path
) -> None:
    copy = tmp_path / "renamed.mcap"
    shutil.copy(flights.train, copy)
    train, held = f"{flights.train}{spans[0]}", f"{copy}{spans[1]}"
    for command in ("identify", "diagnose", "compare"):
        line = one_line(inside(command, train, "--validate", held, "--vehicle", "pelican", "--out", tmp_path), 2)
        assert "renamed.mcap cannot validate" in line
        assert "train.mcap, which is fitted" in line


def test_a_copy_in_another_format(flights: Flights, tmp_path: Path) -> None:
    write_csv(tmp_path / "copy.csv", flights.train_flight.recording)
    with pytest.raises(LogError, match="cannot validate"):
        check_unseen([load(flights.train)], [load(tmp_path / "copy.csv")])


def test_another_flight_and_another_part_are_fine(flights: Flights) -> None:
    check_unseen([load(flights.train)], [load(flights.unseen)])
    check_unseen([load(f"{flights.train}@0:15")], [load(f"{flights.train}@15:30")])


def test_a_second_recorder_of_the_same_flight(flights: Flights, tmp_path: Path) -> None:
    for name, by, noise in (("one", 0.0, 0.0), ("two", 5.003, 0.02), ("later", 60.0, 0.02)):
        recording = moved(flights.train_flight.recording, by, noise)
        # The second recorder's clock starts five seconds earlier.
        epoch = 1_700_000_000 - (5 if name == "two" else 0)
        write_mcap(tmp_path / f"{name}.mcap", recording, epoch_ns=epoch * 10**9)
    with pytest.raises(LogError, match="cannot validate"):
        check_unseen([load(tmp_path / "one.mcap")], [load(tmp_path / "two.mcap")])
    check_unseen([load(tmp_path / "one.mcap")], [load(tmp_path / "later.mcap")])
