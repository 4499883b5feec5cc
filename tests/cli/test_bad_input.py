"""Whatever is wrong with the input: one line that says what and how to mend it, exit code 2 or 3, no traceback.

What docs/mistakes.md shows is tested by `tests.cli.test_mistakes`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from quadid_replay import write_tlog

from quadid.vehicle import Vehicle
from tests.cli.conftest import Flights, table, write_table
from tests.commands import Cli, one_line
from tests.faults.evidence import Happened


def _pelican(**changes: object) -> str:
    data = yaml.safe_load(Vehicle.shipped("pelican").to_yaml())
    return str(yaml.safe_dump({**data, **changes}))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"\x00\x01\x02\x03" * 100, "unknown format"),
        (b"#ROSBAG V2.0\n" + b"\x00" * 100, "ROS 1 bag"),
        (b"t,speed\n0,1\n", "none of the columns"),
        (b"t,p,q,r,w1,w2,w3,w4\n", "no usable row"),
        (b"t,p,q,r,w1,w2,w3,w4\nx,x,x,x,x,x,x,x\n", "column t holds 'x', no number"),
    ],
)
def test_files_that_are_no_logs(inside: Cli, tmp_path: Path, content: bytes, expected: str) -> None:
    log = tmp_path / "log.csv"
    log.write_bytes(content)
    assert expected in one_line(inside("identify", log, "--vehicle", "pelican", "--out", tmp_path), 2)


def test_a_directory_as_log(quadid: Cli, tmp_path: Path) -> None:
    assert "quadid fleet" in one_line(quadid("score", tmp_path, "--vehicle", "pelican"), 2)


def test_a_truncated_log_is_used_as_far_as_it_goes(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    whole = flights.unseen.read_bytes()
    cut = tmp_path / "cut.csv"
    cut.write_bytes(whole[: len(whole) // 2])
    run = inside("score", cut, "--vehicle", "pelican", "--json", "-")
    assert run.code == 0
    assert 650 < run.data["samples"] < 750
    assert "cut.csv" in run.err


def test_what_is_allowed_is_said_once(inside: Cli, flights: Flights) -> None:
    line = one_line(inside("compare", flights.train, "--vehicle", "pelican", "--method", "magic"), 2)
    assert line.count("l_shade") == 1
    assert "fix" not in line


@pytest.mark.parametrize("kept", [60, 2000, 100_000])
def test_a_truncated_log_with_nothing_left(inside: Cli, flights: Flights, tmp_path: Path, kept: int) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flights.train.read_bytes()[:kept])
    one_line(inside("score", cut, "--vehicle", "pelican"), 2)


def test_a_corrupted_log(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    data = bytearray(flights.train.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    run = inside("score", broken, "--vehicle", "pelican")
    assert "Traceback" not in run.err
    assert run.code in (0, 2, 3)
    assert "broken.mcap" in run.err


@pytest.fixture(scope="module")
def whole_logs(flights: Flights, data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """One log of each format, by suffix."""
    folder = tmp_path_factory.mktemp("formats")
    write_tlog(folder / "log.tlog", flights.unseen_flight.recording)
    return {
        "mcap": flights.train.read_bytes(),
        "csv": flights.unseen.read_bytes(),
        "tlog": (folder / "log.tlog").read_bytes(),
        "bin": (data_dir / "ardupilot" / "log171.bin").read_bytes()[:400_000],
        "ulg": (data_dir / "px4" / "ascend_cubeorange_test.ulg").read_bytes()[:600_000],
    }


@pytest.mark.parametrize("suffix", ["mcap", "csv", "tlog", "bin", "ulg"])
def test_a_log_of_each_format_cut_in_its_first_bytes(
    inside: Cli, whole_logs: dict[str, bytes], tmp_path: Path, suffix: str
) -> None:
    for kept in (0, 1, 10, 30):
        log = tmp_path / f"cut.{suffix}"
        log.write_bytes(whole_logs[suffix][:kept])
        line = one_line(inside("inspect", log), 2)
        assert f"cut.{suffix}" in line


@pytest.mark.parametrize("suffix", ["mcap", "csv", "tlog", "bin", "ulg"])
def test_a_log_of_each_format_cut_in_the_middle(
    inside: Cli, whole_logs: dict[str, bytes], tmp_path: Path, suffix: str
) -> None:
    """What is before the cut is read, and the warning says so; without a whole chunk there is one clear line."""
    data = whole_logs[suffix]
    log = tmp_path / f"cut.{suffix}"
    log.write_bytes(data[: len(data) * 2 // 3 + 1])
    run = inside("inspect", log)
    assert "Traceback" not in run.err
    if run.code == 0:
        assert f"cut.{suffix}" in run.out
    else:
        assert f"cut.{suffix}" in one_line(run, 2)


@pytest.mark.parametrize("suffix", ["mcap", "csv", "tlog", "bin", "ulg"])
def test_a_corrupted_log_of_each_format(inside: Cli, whole_logs: dict[str, bytes], tmp_path: Path, suffix: str) -> None:
    """Zeros in the middle cost what they cover; noise behind a true beginning is refused with one line."""
    data = bytearray(whole_logs[suffix])
    log = tmp_path / f"broken.{suffix}"
    middle = len(data) // 2
    data[middle : middle + 512] = bytes(512)
    log.write_bytes(data)
    run = inside("inspect", log)
    assert "Traceback" not in run.err
    assert run.code == 0 or f"broken.{suffix}" in one_line(run, 2)
    noise = np.random.default_rng(1).bytes(20_000)
    log.write_bytes(bytes(data[:20]) + noise)
    assert f"broken.{suffix}" in one_line(inside("inspect", log), 2)


@pytest.mark.parametrize(("columns", "order"), [((2, 3, 0, 1), "3, 4, 1, 2"), ((3, 0, 1, 2), "2, 3, 4, 1")])
def test_swapped_motors(inside: Cli, flights: Flights, tmp_path: Path, columns: tuple[int, ...], order: str) -> None:
    """Two motors exchanged, opposite ones exchanged, all moved by one; the line names the columns to take."""
    names, rows = table(flights.unseen)
    place = [names.index(f"w{i}") for i in range(1, 5)]
    rows[:, place] = rows[:, [place[c] for c in columns]]
    log = write_table(tmp_path / "swapped.csv", names, rows)
    for command in ("identify", "diagnose"):
        line = one_line(inside(command, log, "--vehicle", "pelican", "--out", tmp_path), 2)
        assert f"in the order {order}" in line
        assert "order the rotors of the vehicle file" in line


def test_nan_in_a_log_is_left_out(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    names, rows = table(flights.unseen)
    rows[100:110, names.index("p")] = np.nan
    log = write_table(tmp_path / "holes.csv", names, rows)
    run = inside("score", log, "--vehicle", "pelican", "--json", "-")
    assert run.code == 0
    assert run.data["gaps"] >= 1
    assert "not finite" in run.err


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (_pelican(mass=-1.0), "mass"),
        (_pelican(parameters={"b": 2e-5, "d": 4e-7, "J_xx": -8e-3, "J_yy": 8e-3, "J_zz": 1e-2, "J_r": 3e-5}), "J_xx"),
        (_pelican(effects={"motor_lga": {"tau": 0.1}}), "did you mean 'motor_lag'?"),
        (_pelican(effects=[1]), "effects must map names"),
        (_pelican(rotors=[]), "rotors"),
        ("[1, 2", "not YAML"),
        ("just text", "mapping"),
        ("", "mapping"),
    ],
)
def test_impossible_vehicle_files(inside: Cli, flights: Flights, tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "vehicle.yaml"
    file.write_text(text, encoding="utf-8")
    assert expected in one_line(inside("identify", flights.train, "--vehicle", file, "--out", tmp_path), 2)


def test_places_that_cannot_be_written(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("", encoding="utf-8")
    common = ("identify", flights.train, "--vehicle", "pelican")
    assert "file" in one_line(inside(*common, "--out", file), 2)
    assert "directory" in one_line(inside(*common, "--report", tmp_path), 2)


def test_the_vehicle_file_read_is_never_overwritten(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    file = tmp_path / "pelican.fitted.yaml"
    text = Vehicle.shipped("pelican").to_yaml()
    file.write_text(text, encoding="utf-8")
    for command in ("identify", "diagnose"):
        run = inside(command, flights.train, "--vehicle", file, "--out", tmp_path, "--json", "-")
        assert run.code == 0, run.err
        assert run.data["vehicle_file"] == str(tmp_path / "pelican.fitted.new.yaml")
        assert file.read_text(encoding="utf-8") == text


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--rate", "0"), "grid rate"),
        (("--rate", "nan"), "grid rate"),
    ],
)
def test_impossible_options(
    inside: Cli, flights: Flights, tmp_path: Path, arguments: tuple[str, ...], expected: str
) -> None:
    run = inside("identify", flights.train, "--vehicle", "pelican", "--out", tmp_path, *arguments)
    assert expected in one_line(run, 2)


def test_impossible_horizons(inside: Cli, flights: Flights) -> None:
    for horizons in ("0", "1,x", "", "99999"):
        one_line(inside("score", flights.train, "--vehicle", "pelican", "--horizons", horizons), 2)
    line = one_line(inside("score", flights.train, "--vehicle", "pelican", "--horizons", "1900"), 3)
    assert "no run of 1900 samples fits" in line


def test_control_characters_in_names_do_not_reach_the_terminal(inside: Cli, tmp_path: Path, happened: Happened) -> None:
    run = inside("score", str(tmp_path / "evil\x1b[31m\nname.csv"), "--vehicle", "pelican")
    assert "\x1b" not in run.err
    one_line(run, 2)
    happened(20, "ANSI and line ends in a file name: none on the terminal, one line")


def test_the_vehicle_file_of_a_vehicle_thirty_times_as_heavy(inside: Cli, tmp_path: Path, data_dir: Path) -> None:
    """Its rotors stand in another order as well, but that is not what to mend."""
    log = data_dir / "crazyflie_rpm" / "figure8_17.csv"
    run = inside("identify", log, "--vehicle", "pelican", "--out", tmp_path)
    line = one_line(run, 2)
    assert "so b would be 1.26e-06" in line
    assert "fix: use the vehicle file of this log; else" in line
