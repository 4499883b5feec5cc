"""`quadid inspect` as people and programs call it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import write_csv

from quadid.app.inspect import channel_table, parameter_outlook_table
from quadid.checks import inspect
from quadid.parameters import NOMINAL_NAMES
from tests.commands import Cli, one_line
from tests.replay.synthetic import Flight


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "flight.csv"
    write_csv(path, Flight().recording(seconds=10.0))
    return path


def test_tables_for_people(log: Path, inside: Cli) -> None:
    out = inside("inspect", log).out
    for text in ("gyro", "rate (Hz)", "gravity", "J_xx", "usable for identification"):
        assert text in out
    assert "[bold]" not in out


def test_json_alone_on_stdout(log: Path, inside: Cli) -> None:
    result = inside("inspect", log, "--vehicle", "pelican", "--json", "-").data
    assert result["schema"] == "quadid.inspect/1"
    assert result["log"] == str(log)
    assert {row["name"] for row in result["excitation"]} == {"b", "d", "J_xx", "J_yy", "J_zz", "J_r"}
    assert all(row["relative_sigma"] > 0 for row in result["excitation"])


def test_no_precision_is_promised_of_a_log_in_wrong_units(tmp_path: Path, inside: Cli) -> None:
    """Of rates in degrees J_yy was promised to 0.00001 %."""
    flown = Flight().recording(seconds=10.0)
    gyro = flown.channels["gyro"]
    degrees = replace(gyro, values=np.degrees(gyro.values))
    write_csv(tmp_path / "degrees.csv", replace(flown, channels={**flown.channels, "gyro": degrees}))
    run = inside("inspect", tmp_path / "degrees.csv", "--vehicle", "pelican", "--json", "-")
    assert not run.data["usable"]
    assert run.data["excitation"] == []


def test_files_are_named_by_absolute_path(log: Path, inside: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(log.parent)
    assert inside("inspect", "flight.csv", "--json", "result.json", "--out", "written").code == 0
    result = json.loads((log.parent / "result.json").read_text())
    (written,) = result["files"]
    assert Path(written).is_absolute()
    assert json.loads(Path(written).read_text())["schema"] == "quadid.inspect/1"


def test_a_span_of_the_log(log: Path, inside: Cli) -> None:
    assert inside("inspect", f"{log}@2:5", "--json", "-").data["seconds"] == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["{log}", "--preset", "mavro", "--json", "-"], "did you mean 'mavros'"),
        (["{log}@100:200"], "nothing between 100.0 and 200.0 s; allowed: a span inside the log, 0.0 to "),
        (["{log}@100:"], "nothing after 100.0 s; allowed: a span inside the log, 0.0 to "),
    ],
)
def test_bad_input_is_one_line_and_exit_2(log: Path, inside: Cli, arguments: list[str], text: str) -> None:
    assert text in one_line(inside("inspect", *(a.format(log=log) for a in arguments)), 2)


def test_a_single_sample_has_no_rate(tmp_path: Path, inside: Cli) -> None:
    (tmp_path / "one.csv").write_text("t,p,q,r\n0,0,0,0\n0.02,x,0,0\n", encoding="utf-8")
    shown = inside("inspect", tmp_path / "one.csv")
    out = " ".join(f"{shown.out} {shown.err}".split())
    assert "nan" not in out
    assert "one sample is too little" in out
    assert "1 line with missing" in out


def test_motion_is_not_told_where_the_rotors_come_too_slowly() -> None:
    whole = Flight().recording(seconds=10.0)
    speed = whole.channels["rotor_speed"]
    few = replace(speed, t=speed.t[::5], values=speed.values[::5])
    rows = tuple({"name": name, "relative_sigma": 0.001} for name in NOMINAL_NAMES)
    for channel, shown in ((speed, 6), (few, 1)):
        found = inspect(replace(whole, channels={**whole.channels, "rotor_speed": channel}))
        table = parameter_outlook_table(replace(found, excitation=rows))
        assert [row[2] for row in table.rows].count("0.1 %") == shown


def test_times_for_people_are_those_of_a_span(tmp_path: Path, inside: Cli) -> None:
    """The clock of this log began 1000 s before it: what is printed can be asked for as LOG@from:to."""
    flown = Flight().recording(seconds=10.0)
    booted = {name: replace(c, t=c.t + 1000.0) for name, c in flown.channels.items()}
    path = tmp_path / "late.csv"
    write_csv(path, replace(flown, channels=booted))
    out = inside("inspect", path, "--vehicle", "pelican").out
    assert "flying from-to (s): 0.0-10.0" in out
    assert "1000.0" not in out
    assert "flying from-to (s): 2.0-5.0" in inside("inspect", f"{path}@2:5").out
    refused = inside("identify", f"{path}@1002:1005", "--vehicle", "pelican")
    assert "nothing to use between 1002 and 1005 s; allowed: 0.0 to 10.0 s after its first" in one_line(refused, 2)


def test_a_long_source_stays_where_it_says_what_the_motors_are() -> None:
    flown = inspect(Flight().recording(seconds=10.0))
    source = "vehicle_torque_setpoint (allocated as actuator_motors, normalized)"
    told = replace(flown, channels=tuple(replace(c, source=source) for c in flown.channels))
    assert source in channel_table(told).text(120)
