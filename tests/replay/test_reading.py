"""Large logs are read in a child with limits of memory and time; what no log is, is refused before it is read."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import quadid_replay.opening
import quadid_replay.reading
from quadid_replay import open_log, write_csv, write_mcap, write_tlog
from quadid_replay.reading import Limits, limits, read_in_child

from quadid.errors import LogError
from tests.faults.evidence import Happened
from tests.fuzz.seeds import seeds
from tests.replay.synthetic import full_recording


@pytest.fixture
def all_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every log counts as large."""
    monkeypatch.setattr(quadid_replay.opening, "LARGE", 0)


def test_a_child_reads_what_is_read_here(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_mcap(path, full_recording(1.0, 50.0))
    here, there = open_log(path), read_in_child(path, path.stat().st_size, "auto")
    assert (here.name, here.sha256, here.warnings, here.breaks) == (
        there.name,
        there.sha256,
        there.warnings,
        there.breaks,
    )
    for name, channel in here.channels.items():
        np.testing.assert_array_equal(there.channels[name].values, channel.values)
        np.testing.assert_array_equal(there.channels[name].t, channel.t)
        assert not there.channels[name].values.flags.writeable


def test_a_folder_may_take_what_its_files_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limits were those of the folder's own entry, 4 kB: a recording of 500 MB had 10 s and 768 MiB."""
    folder, allowed = tmp_path / "bag", list[int]()
    folder.mkdir()
    for part in range(2):
        write_mcap(folder / f"bag_{part}.mcap", full_recording(4.0, 500.0))
    files = ", ".join(f"bag_{part}.mcap" for part in range(2))
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths: [{files}]\n")

    def noted(size: int) -> Limits:
        allowed.append(size)
        return limits(size)

    monkeypatch.setattr(quadid_replay.opening, "LARGE", 0)
    monkeypatch.setattr(quadid_replay.reading, "limits", noted)
    assert open_log(folder).channels
    assert allowed == [sum(file.stat().st_size for file in folder.glob("*.mcap"))]


def test_no_code_of_the_folder_we_stand_in_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    """Whoever packs a folder of logs may put a numpy.py into it: `python -m` would import that one."""
    write_mcap(tmp_path / "a.mcap", full_recording(1.0, 50.0))
    (tmp_path / "numpy.py").write_text("open('ran', 'w').close()\nraise SystemExit\n")
    monkeypatch.chdir(tmp_path)
    assert read_in_child(tmp_path / "a.mcap", 1 << 20, "auto").channels
    assert not (tmp_path / "ran").exists()
    happened(25, "a log beside a numpy.py in the folder we stand in: read, and that file is not run")


@pytest.mark.usefixtures("all_large")
def test_more_memory_than_allowed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    path = tmp_path / "big.csv"
    path.write_text("t,p,q,r\n" + "".join(f"{k * 1e-3:.3f},0,0,0\n" for k in range(20_000)) * 40)
    monkeypatch.setenv("QUADID_READ_MEMORY_MB", "60")
    with pytest.raises(LogError, match="big.csv: reading it takes more than 60 MiB of memory.*QUADID_READ_MEMORY_MB"):
        open_log(path)
    happened(5, f"CSV of {path.stat().st_size >> 20} MB under a limit of 60 MiB: the child is stopped, the log refused")


@pytest.mark.usefixtures("all_large")
def test_more_time_than_allowed_is_refused_and_errors_are_those_of_the_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, happened: Happened
) -> None:
    (tmp_path / "b.csv").write_text("t,p\n0,1\n")
    with pytest.raises(LogError, match="gyro lacks column q, r; allowed: all of p q r"):
        open_log(tmp_path / "b.csv")
    monkeypatch.setenv("QUADID_READ_SECONDS", "0.0001")  # 2 ms by the clock: no interpreter starts in that
    with pytest.raises(LogError, match="b.csv: reading it takes longer than 0 s.*QUADID_READ_SECONDS"):
        open_log(tmp_path / "b.csv")
    monkeypatch.setenv("QUADID_READ_SECONDS", "soon")
    with pytest.raises(LogError, match="QUADID_READ_SECONDS='soon'; allowed: a positive number"):
        limits(1)
    happened(5, "a log that takes longer than its time limit is refused, its reader killed")


def sparse(path: Path, head: bytes, size: int) -> Path:
    path.write_bytes(head)
    os.truncate(path, size)
    return path


@pytest.mark.parametrize("kind", ["mcap", "tlog", "dataflash", "ulog", "usdlog", "csv"])
def test_a_log_of_10_gb_that_holds_nothing_is_refused_unread(tmp_path: Path, kind: str, happened: Happened) -> None:
    head = b"t,p,q,r\n0,0,0,0\n0.1,0,0,0\n" if kind == "csv" else seeds(kind)[0]
    path = sparse(tmp_path / "huge", head, 10 << 30)
    with pytest.raises(LogError, match="10240 MiB of which 0 MiB are stored"):
        open_log(path)
    happened(5, f"10 GB {kind} (a true head, then nothing): refused before it is read")


def test_a_line_without_end_is_refused(tmp_path: Path, happened: Happened) -> None:
    path = tmp_path / "zeros.csv"
    path.write_bytes(b"t,p,q,r\n0,0,0,0\n" + bytes(8 << 20))
    with pytest.raises(LogError, match="line 3 is longer than 1 MiB"):
        open_log(path)
    happened(5, "CSV whose third line has 8 MB: refused at 1 MiB of it")


def test_paths_that_are_no_logs(tmp_path: Path, happened: Happened) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe")
    names = {
        "a loop of links": str(tmp_path / "loop"),
        "a pipe nobody writes": str(tmp_path / "pipe"),
        "an endless device": "/dev/zero",
        "a directory": str(tmp_path),
        "a NUL in the name": "a\x00b.csv",
        "a name of 5000 characters": "x" * 5000,
        "a process's memory": "/proc/self/mem",
        "nothing": "",
    }
    for path in names.values():
        with pytest.raises(LogError):
            open_log(path)
    happened(5, f"{', '.join(names)} given as log: each refused with its reason, none opened for long")


def test_round_trips_do_not_notice(tmp_path: Path, all_large: None) -> None:
    for write in (write_csv, write_tlog):
        write(tmp_path / "log", full_recording(1.0, 50.0))
        assert len(open_log(tmp_path / "log").channels) > 4
