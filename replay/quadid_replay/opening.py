"""The one door for logs: `open_log`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from quadid.errors import LogError
from quadid.window import Recording
from quadid_replay.presets import AUTO, preset_rank
from quadid_replay.recognise import ALLOWED, HEAD_BYTES, Format, recognise


def open_log(path: str | Path, preset: str = AUTO) -> Recording:
    """Reads a flight log of any known format into core units and frames (SI, world NED, body FRD).

    Args:
        path: the file; its format is told by its content, never by its suffix.
        preset: for ROS logs, whose topic names to expect (see `quadid_replay.presets`); auto finds them by type.

    Raises:
        LogError: no such file, a directory, an empty file, an unknown format, or nothing readable in it.
    """
    file = Path(path)
    preset_rank(preset, "gyro", "")  # an unknown preset is an error whatever the file is
    head, sha256 = _head_and_hash(file)
    kind = recognise(head, file.name)
    if kind == "mcap":
        from quadid_replay.mcap_reader import read_mcap

        return read_mcap(file, sha256, preset)
    return _reader(kind)(file, sha256)


def _reader(kind: Format) -> Callable[[Path, str], Recording]:
    """Imports only the library that this format needs."""
    if kind == "csv":
        from quadid_replay.csv_reader import read_csv as read
    elif kind == "dataflash":
        from quadid_replay.dataflash_reader import read_dataflash as read
    elif kind == "ulog":
        from quadid_replay.ulog_reader import read_ulog as read
    else:
        from quadid_replay.tlog_reader import read_tlog as read
    return read


def _head_and_hash(file: Path) -> tuple[bytes, str]:
    if file.is_dir():
        raise LogError(f"{file} is a directory", ALLOWED, "name one log file; for a folder use `quadid fleet`")
    if file.exists() and not file.is_file():
        raise LogError(f"{file} is no regular file", ALLOWED, "copy what it yields to a file first")
    digest = hashlib.sha256()
    head = b""
    try:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                head = head or block[:HEAD_BYTES]
                digest.update(block)
    except FileNotFoundError as error:
        raise LogError(f"no file {file}", ALLOWED, "check the path") from error
    except OSError as error:
        raise LogError(f"{file} cannot be read ({error.strerror})", ALLOWED, "check its permissions") from error
    return head, digest.hexdigest()
