"""A pipe, a device or a folder where a file is asked for: refused, and not waited for."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from quadid_node.history import read_history
from quadid_node.mavlink_wire import SigningMemory, read_key
from quadid_node.wire_format import repeat
from quadid_node.zenoh import config_of
from quadid_replay import open_log
from quadid_replay.writers import open_for_writing

from quadid.app.logs import load_vehicle, write_text
from quadid.app.simulate import read_manoeuvre
from quadid.errors import QuadidError
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened

READERS: dict[str, Callable[[Path], object]] = {
    "vehicle file": lambda path: load_vehicle(str(path)),
    "manoeuvre": read_manoeuvre,
    "signing key": read_key,
    "log": open_log,
    "history that is shown": lambda path: read_history(path, "pelican"),
    "configuration of Zenoh": lambda path: config_of(str(path)),
    "kept input of a failed fit": repeat,
}
WRITERS: dict[str, Callable[[Path], object]] = {
    "result": lambda path: write_text(path, "{}"),
    "log": open_for_writing,
    "vehicle file": Vehicle.shipped("pelican").save,
}


@pytest.mark.parametrize("what", READERS)
def test_what_is_no_file_is_refused(what: str, tmp_path: Path, happened: Happened) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    for path in (tmp_path / "pipe.yaml", Path("/dev/zero"), tmp_path):
        with pytest.raises((QuadidError, OSError), match="regular file|[Ii]s a directory|no history|no Zenoh"):
            READERS[what](path)
    happened(35, f"a pipe, /dev/zero and a folder as {what}: refused at once")


@pytest.mark.parametrize("what", WRITERS)
def test_a_pipe_that_nobody_reads_is_not_waited_for_and_stays(what: str, tmp_path: Path, happened: Happened) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises((QuadidError, OSError), match="No such device"):
        WRITERS[what](tmp_path / "pipe")
    assert (tmp_path / "pipe").is_fifo()
    happened(35, f"a {what} to a pipe that nobody reads: refused at once, the pipe is there")


def test_a_pipe_that_is_read_gets_the_result_and_no_device_becomes_a_file(tmp_path: Path) -> None:
    """As root a result for /dev/null took the place of the device."""
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_text(tmp_path / "pipe", "{}")
    assert os.read(reader, 99) == b"{}"
    os.close(reader)
    (tmp_path / "null").symlink_to("/dev/null")
    write_text(tmp_path / "null", "{}")
    assert (tmp_path / "null").is_char_device()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_a_pipe_where_time_stamps_of_signatures_were_kept_is_said(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "kept.json")
    signing = SimpleNamespace(stream_timestamps={}, timestamp=0)
    assert "no regular file" in SigningMemory(tmp_path / "kept.json", signing).problem
