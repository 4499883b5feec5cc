"""CSV of the contract: groups, Euler angles, blanks, damage, and errors that say what to do."""

from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log
from quadid_replay.columns import from_euler

from quadid.data.grid import grid_recording
from quadid.errors import LogError
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened

HEADER = "t,p,q,r,ax,ay,az,phi,theta,psi,w1,w2,w3,w4\n"


def rows(count: int = 100, step: float = 0.02) -> list[str]:
    numbers = 0.3 * np.random.default_rng(2).normal(size=(count, 13))
    return [f"{i * step:.6g}," + ",".join(f"{v:.7g}" for v in row) + "\n" for i, row in enumerate(numbers)]


def written(tmp_path: Path, text: str, name: str = "log.csv") -> Path:
    path = tmp_path / name
    path.write_bytes(text.encode())
    return path


def test_every_number_is_the_one_in_the_file(tmp_path: Path) -> None:
    lines = rows()
    recording = open_log(written(tmp_path, HEADER + "".join(lines)))
    table = np.array([[float(c) for c in line.split(",")] for line in lines])
    np.testing.assert_array_equal(recording.channels["gyro"].values, table[:, 1:4])
    np.testing.assert_array_equal(recording.channels["rotor_speed"].values, table[:, 10:14])
    np.testing.assert_allclose(
        np.abs(np.sum(recording.channels["attitude"].values * from_euler(table[:, 7:10]), 1)), 1.0
    )
    assert recording.grid == pytest.approx(0.02)
    assert recording.channels["gyro"].source == "p q r"
    assert recording.sha256
    assert recording.warnings == ()


@pytest.mark.parametrize("name", ["flight.bin", "flight.mcap", "flight", "flight.tlog"])
def test_the_suffix_is_never_believed(tmp_path: Path, name: str) -> None:
    assert open_log(written(tmp_path, HEADER + "".join(rows()), name)).format == "csv"


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_other_delimiters_line_ends_comments_and_a_byte_order_mark(tmp_path: Path, delimiter: str) -> None:
    text = ("# a comment\n" + HEADER + "".join(rows())).replace(",", delimiter).replace("\n", "\r\n")
    path = tmp_path / "log.csv"
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    recording = open_log(path)
    assert len(recording.channels["gyro"].t) == 100
    assert len(recording.channels["rotor_speed"].values[0]) == 4


def test_empty_cells_are_channels_at_their_own_rate(tmp_path: Path) -> None:
    lines = ["t,p,q,r,x,y,z\n"]
    for i in range(100):
        position = f"{i},2,3" if i % 5 == 0 else ",,"
        lines.append(f"{i * 0.01:.2f},1,2,3,{position}\n")
    recording = open_log(written(tmp_path, "".join(lines)))
    assert len(recording.channels["position"].t) == 20
    assert len(recording.channels["gyro"].t) == 100
    assert recording.warnings == ()
    assert recording.grid is None


def test_damaged_lines_are_dropped_and_named(tmp_path: Path) -> None:
    lines = rows()
    lines[30] = "0.6,abc\n"
    lines[31] = lines[31].replace(",", ",,", 1)
    recording = open_log(written(tmp_path, HEADER + "".join(lines)))
    assert len(recording.channels["gyro"].t) == 98
    assert any("2 lines" in w and "line 32" in w for w in recording.warnings)


def test_a_cut_last_line_is_no_measurement(tmp_path: Path) -> None:
    text = HEADER + "".join(rows())
    recording = open_log(written(tmp_path, text[:-6]))
    assert len(recording.channels["gyro"].t) == 99
    assert any("cut" in w for w in recording.warnings)
    whole = open_log(written(tmp_path, text.rstrip("\n") + "0", "whole.csv"))
    assert len(whole.channels["gyro"].t) == 100  # no line end, but nothing seems missing


def test_nan_and_inf_are_dropped_and_counted(tmp_path: Path, happened: Happened) -> None:
    lines = rows()
    cells = lines[10].split(",")
    lines[10] = ",".join([*cells[:1], "nan", "0", "inf", *cells[4:]])
    recording = open_log(written(tmp_path, HEADER + "".join(lines)))
    assert dict(recording.channels["gyro"].faults) == {"not_finite": 1}
    assert len(recording.channels["accel"].t) == 100
    assert any("gyro" in w and "1 not finite" in w for w in recording.warnings)
    happened(6, "NaN and Inf in a CSV: dropped and counted by the reader")


def test_repeated_and_backward_rows_are_dropped_a_reboot_is_a_break(tmp_path: Path, happened: Happened) -> None:
    lines = rows(200)
    mixed = [*lines[:100], lines[99], lines[98], *lines[100:]]
    recording = open_log(written(tmp_path, HEADER + "".join(mixed)))
    assert dict(recording.channels["gyro"].faults) == {"duplicate": 1, "backwards": 1}
    twice = open_log(written(tmp_path, HEADER + "".join(lines + lines), "twice.csv"))
    assert len(twice.breaks) == 1
    assert any("reboot" in w for w in twice.warnings)
    happened(7, "rows running backwards dropped and counted; a reboot becomes a break that nothing crosses")


def test_columns_nobody_knows_are_reported(tmp_path: Path) -> None:
    recording = open_log(written(tmp_path, "t,p,q,r,gyrox\n0,1,2,3,4\n1,2,3,4,5\n"))
    assert any("gyrox" in w for w in recording.warnings)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("t,p,q\n0,1,2\n", "gyro lacks column r"),
        ("t,w1,w3\n0,1,2\n", r"numbered \[1, 3\]"),
        ("t,p,p,r\n0,1,2,3\n", "p appears twice"),
        ("t,foo\n0,1\n", "none of the columns"),
        ("t,p,q,r,volt\x1b[31m\n0,1,2,3,4\n", "header is no plain text"),
        ("t,p,q,r\n", "no usable row"),
        ("t,p,q,r\nx,y,z,w\n", "column t holds 'x', no number"),
        ("t,p,q,r\nnan,1,2,3\n", "no usable flight data"),
        (f"t,p,q,r,{','.join(f'c{k}' for k in range(20_000))}\n0,1,2,3\n", "header row is longer than 64 KiB"),
    ],
)
def test_what_is_wrong_is_said_with_what_is_allowed(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(LogError, match=expected) as error:
        open_log(written(tmp_path, text))
    assert "\n" not in str(error.value)
    assert "log.csv" in str(error.value)
    assert error.value.allowed


@pytest.mark.parametrize("columns", ["phi,theta,psi", "p,q,r"])
def test_angles_beyond_a_turn_are_refused_as_degrees(tmp_path: Path, columns: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"t,{columns}\n" + "".join(f"{0.02 * k},30,-20,{k}\n" for k in range(50)))
    if columns == "p,q,r":
        assert "gyro" in open_log(path).channels  # rates may be any number
    else:
        with pytest.raises(LogError, match=r"columns phi and theta reach 30 and 20: degrees.*multiply phi"):
            open_log(path)


@pytest.mark.parametrize(
    ("step", "unit"), [(20, "milliseconds"), (2, "milliseconds"), (20_000, "microseconds"), (20_000_000, "nanoseconds")]
)
def test_time_in_another_unit_is_named_with_its_column(tmp_path: Path, step: int, unit: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,p,q,r\n" + "".join(f"{step * k},0,0,0\n" for k in range(50)))
    with pytest.raises(LogError, match=rf"column t rises by {step} a row: {unit}\?.*multiply t by"):
        open_log(path)


def test_commands_called_speeds_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = "".join(f"{0.02 * k:.2f},0,0,0,0.5,0.5,0.6,0.5\n" for k in range(100))
    path.write_text("t,p,q,r,w1,w2,w3,w4\n" + rows)
    with pytest.raises(LogError, match=r"rotor speeds up to 0\.6 .* commands from 0 to 1.*name the columns u1"):
        grid_recording(open_log(path), Vehicle.shipped("pelican"))


def test_opening_what_is_no_log(tmp_path: Path) -> None:
    cases = {
        "empty": b"",
        "noise": np.random.default_rng(0).bytes(5000),
        "text": b"hello world\nthis is no log\n",
        "bag": b"#ROSBAG V2.0\n" + bytes(100),
        "db3": b"SQLite format 3\x00" + bytes(100),
        "zip": b"PK\x03\x04" + bytes(100),
        "zeros": bytes(4096),
    }
    for name, data in cases.items():
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(LogError) as error:
            open_log(path)
        assert error.value.allowed, name
        assert error.value.fix, name
        assert "\n" not in str(error.value)
    with pytest.raises(LogError, match="is a directory.*quadid fleet"):
        open_log(tmp_path)
    with pytest.raises(LogError, match="no regular file"):
        open_log("/dev/zero")
    with pytest.raises(LogError, match="no file"):
        open_log(tmp_path / "absent.csv")
