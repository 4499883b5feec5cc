"""A log that also stands on the ground: what is in the air is used, and named as LOG@from:to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import quadid
import quadid.checks
from quadid.checks.motion import Spans, flying_spans
from quadid.data.window import Recording
from quadid.errors import LogError
from quadid.vehicle import Vehicle
from tests.cli.conftest import Flights, table, write_table
from tests.commands import Cli


@pytest.fixture(scope="module")
def standing(flights: Flights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight that begins with ten seconds on its legs, rotors idling."""
    names, rows = table(flights.unseen)
    early = rows[:, 0] < rows[0, 0] + 10.0
    still = {
        "p": 0.0,
        "q": 0.0,
        "r": 0.0,
        "ax": 0.0,
        "ay": 0.0,
        "az": -9.81,
        "qw": 1.0,
        "qx": 0.0,
        "qy": 0.0,
        "qz": 0.0,
    }
    for name, value in {**still, **{n: 80.0 for n in names if n.startswith("w")}}.items():
        rows[early, names.index(name)] = value
    noise = np.random.default_rng(1).normal(0.0, 0.01, (len(rows), 6))
    rows[:, [names.index(n) for n in ("p", "q", "r", "ax", "ay", "az")]] += noise
    return write_table(tmp_path_factory.mktemp("standing") / "standing.csv", names, rows)


def test_inspect_proposes_what_is_in_the_air(inside: Cli, standing: Path) -> None:
    run = inside("inspect", standing, "--vehicle", "pelican", "--json", "-")
    assert run.data["use"] == ["standing.csv@12:30"]
    assert "use standing.csv@12:30" in inside("inspect", standing, "--vehicle", "pelican").err
    assert inside("inspect", f"{standing}@12:30", "--json", "-").data["use"] == []


def test_excitation_is_that_of_the_flight(inside: Cli, standing: Path) -> None:
    whole, cut, all_of_it = (
        inside("inspect", f"{standing}{part}", "--vehicle", "pelican", "--json", "-").data["excitation"]
        for part in ("", "@12:30", "@0:")
    )
    assert whole == cut
    assert whole != all_of_it


def test_when_it_flies_is_worked_out_once(standing: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def counted(recording: Recording, vehicle: Vehicle | None) -> Spans:
        asked.append(recording.name)
        return flying_spans(recording, vehicle)

    monkeypatch.setattr(quadid.checks, "flying_spans", counted)
    quadid.load(standing, vehicle="pelican")
    assert len(asked) == 1


def test_only_what_is_in_the_air_is_used_and_said_once(standing: Path) -> None:
    log = quadid.load(standing, vehicle="pelican")
    assert [w for w in log.warnings if "ground" in w] == [
        "standing.csv: time on the ground is left out: fits use standing.csv@12:30; to use all of it: standing.csv@0:"
    ]
    (flown,) = log.windows
    (cut,) = quadid.load(f"{standing}@12:30", vehicle="pelican").windows
    np.testing.assert_array_equal(flown.gyro, cut.gyro)
    (slower,) = log.at(25.0).windows
    assert slower.t[0] >= log.recording.channels["gyro"].t[0] + 12.0 - 1e-6


@pytest.mark.parametrize("part", ["@0:", "@12:30"])
def test_a_part_that_was_asked_for_is_used_as_it_is(standing: Path, part: str) -> None:
    log = quadid.load(f"{standing}{part}", vehicle="pelican")
    assert not [w for w in log.warnings if "ground" in w]
    first = log.recording.channels["gyro"].t[0]
    assert log.windows[0].t[0] - first == pytest.approx(float(part[1:].split(":")[0]), abs=0.02)


def test_a_refused_log_proposes_it_as_well(standing: Path, tmp_path: Path) -> None:
    names, rows = table(standing)
    rows[:, names.index("az")] *= -1.0
    wrong = write_table(tmp_path / "wrong.csv", names, rows)
    with pytest.raises(LogError) as refused:
        quadid.load(wrong, vehicle="pelican")
    assert "use wrong.csv@12:30" in str(refused.value.fix)


def test_a_recorded_flight(inside: Cli, data_dir: Path) -> None:
    """Armed at 72 s, crashed at about 220 s: see the data's README."""
    (use,) = inside("inspect", data_dir / "ardupilot" / "log171.bin", "--json", "-").data["use"]
    start, stop = (float(v) for v in use.rpartition("@")[2].split(":"))
    assert 72.0 < start < 78.0
    assert 210.0 < stop < 230.0
