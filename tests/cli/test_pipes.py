"""A pipe, a device or a folder where a file is asked for: refused, and not waited for."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from quadid_node.history import read_history
from quadid_node.mavlink_wire import read_key
from quadid_node.zenoh import config_of
from quadid_replay import open_log

from quadid.app.logs import load_vehicle
from quadid.app.simulate import read_manoeuvre
from quadid.errors import QuadidError

READERS: dict[str, Callable[[Path], object]] = {
    "vehicle file": lambda path: load_vehicle(str(path)),
    "manoeuvre": read_manoeuvre,
    "signing key": read_key,
    "log": open_log,
    "history that is shown": lambda path: read_history(path, "pelican"),
    "configuration of Zenoh": lambda path: config_of(str(path)),
}


@pytest.mark.parametrize("what", READERS)
def test_what_is_no_file_is_refused(what: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    for path in (tmp_path / "pipe.yaml", Path("/dev/zero"), tmp_path):
        with pytest.raises(QuadidError, match="regular file|[Ii]s a directory|no history|no Zenoh"):
            READERS[what](path)
