"""The one door for logs: `open_log`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from quadid.errors import LogError
from quadid.window import Recording
from quadid_replay.presets import AUTO, preset_rank
from quadid_replay.recognise import ALLOWED, HEAD_BYTES, Format, recognise

LARGE = 4 << 20
"""Files of this size [bytes] are read in a child process with limits."""
_STORED = 0.02
"""A large file of which less than this share is stored holds nothing but zeros: its copy was not finished."""


def open_log(path: str | Path, preset: str = AUTO) -> Recording:
    """Reads a flight log of any known format into core units and frames (SI, world NED, body FRD).

    A large one (`LARGE`) is read in a child process with limited memory and time, see `quadid_replay.reading`.

    Args:
        path: the file; its format is told by its content, never by its suffix.
        preset: for ROS logs, whose topic names to expect (see `quadid_replay.presets`); auto finds them by type.

    Raises:
        LogError: no such file, a directory, an empty file, an unknown format, nothing readable in it, or a file whose
            reading takes more memory or time than is allowed.
    """
    file = Path(path)
    preset_rank(preset, "gyro", "")  # an unknown preset is an error whatever the file is
    recognise(_head(file), file.name)
    status = file.stat()
    if status.st_size >= LARGE:
        stored = 512 * status.st_blocks
        if stored < _STORED * status.st_size:
            raise LogError(
                f"{file.name}: {status.st_size >> 20} MiB of which {stored >> 20} MiB are stored", "a whole file",
                "copy it again: the copy or the logger stopped before the end",
            )  # fmt: skip
        from quadid_replay.reading import read_in_child

        return read_in_child(file, preset)
    return read_here(file, preset)


def read_here(file: Path, preset: str) -> Recording:
    """Reads a log in this process, whatever its size; else as `open_log`."""
    kind = recognise(_head(file), file.name)
    try:
        if kind == "mcap":
            from quadid_replay.mcap_reader import read_mcap

            recording = read_mcap(file, preset=preset)
        else:
            recording = _reader(kind)(file)
        return replace(recording, sha256=_sha256(file))
    except OSError as error:
        raise _unreadable(file, error) from error


def _reader(kind: Format) -> Callable[[Path], Recording]:
    """Imports only the library that this format needs."""
    if kind == "csv":
        from quadid_replay.csv_reader import read_csv as read
    elif kind == "dataflash":
        from quadid_replay.dataflash_reader import read_dataflash as read
    elif kind == "ulog":
        from quadid_replay.ulog_reader import read_ulog as read
    elif kind == "usdlog":
        from quadid_replay.usd_reader import read_usd as read
    else:
        from quadid_replay.tlog_reader import read_tlog as read
    return read


def _head(file: Path) -> bytes:
    try:
        if file.is_dir():
            raise LogError(f"{file} is a directory", ALLOWED, "name one log file; for a folder use `quadid fleet`")
        if file.exists() and not file.is_file():
            raise LogError(f"{file} is no regular file", ALLOWED, "copy what it yields to a file first")
        with file.open("rb") as stream:
            return stream.read(HEAD_BYTES)
    except FileNotFoundError as error:
        raise LogError(f"no file {file}", ALLOWED, "check the path") from error
    except OSError as error:
        raise _unreadable(file, error) from error
    except ValueError as error:  # a NUL in its name
        raise LogError(f"no file {str(file)!r}", ALLOWED, "check the path") from error


def _unreadable(file: Path, error: OSError) -> LogError:
    return LogError(f"{file} cannot be read ({error.strerror or error})", ALLOWED, "check its permissions")


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
