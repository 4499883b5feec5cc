"""The one door for logs: `open_log`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from quadid.errors import LogError
from quadid.window import Recording
from quadid_replay.bag_folder import bag_files, is_bag_folder
from quadid_replay.presets import AUTO, preset_rank
from quadid_replay.recognise import ALLOWED, HEAD_BYTES, Format, recognise

LARGE = 4 << 20
"""Files of this size [bytes] are read in a child process with limits."""
_STORED = 0.02
"""A large file of which less than this share is stored holds nothing but zeros: its copy was not finished."""


def open_log(path: str | Path, preset: str = AUTO, columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a flight log of any known format into core units and frames (SI, world NED, body FRD).

    A large one (`LARGE`) is read in a child process with limited memory and time, see `quadid_replay.reading`.

    Args:
        path: the file, whose format is told by its content and never by its suffix, or the folder of a rosbag2
            recording.
        preset: for ROS logs, whose topic names to expect (see `quadid_replay.presets`); auto finds them by type.
        columns: for CSV, names in the file for those of the contract, as in the vehicle file.

    Raises:
        LogError: no such file, a directory, an empty file, an unknown format, nothing readable in it, or a file whose
            reading takes more memory or time than is allowed.
    """
    file = Path(path)
    preset_rank(preset, "gyro", "")  # an unknown preset is an error whatever the file is
    _kind(file, columns)
    sizes = [part.stat() for part in _parts(file)]
    size = sum(part.st_size for part in sizes)
    if size >= LARGE:
        stored = 512 * sum(part.st_blocks for part in sizes)
        if stored < _STORED * size:
            raise LogError(
                f"{file.name}: {size >> 20} MiB of which {stored >> 20} MiB are stored", "a whole file",
                "copy it again: the copy or the logger stopped before the end",
            )  # fmt: skip
        from quadid_replay.reading import read_in_child

        return read_in_child(file, size, preset, columns)
    return read_here(file, preset, columns)


def read_here(file: Path, preset: str, columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a log in this process, whatever its size; else as `open_log`."""
    kind = _kind(file, columns)
    try:
        if kind in ("mcap", "rosbag2"):
            from quadid_replay.mcap_reader import read_mcap

            recording = read_mcap(file, preset=preset)
        elif kind == "csv":
            from quadid_replay.csv_reader import read_csv

            recording = read_csv(file, columns)
        else:
            recording = _reader(kind)(file)
        return replace(recording, sha256=_sha256(file))
    except OSError as error:
        raise _unreadable(file, error) from error


def _reader(kind: Format) -> Callable[[Path], Recording]:
    """Imports only the library that this format needs."""
    if kind == "dataflash":
        from quadid_replay.dataflash_reader import read_dataflash as read
    elif kind == "ulog":
        from quadid_replay.ulog_reader import read_ulog as read
    elif kind == "blackbox":
        from quadid_replay.blackbox_reader import read_blackbox as read
    elif kind == "usdlog":
        from quadid_replay.usd_reader import read_usd as read
    else:
        from quadid_replay.tlog_reader import read_tlog as read
    return read


def _kind(file: Path, columns: Mapping[str, str] | None) -> Format:
    """The format of a file; of a folder, that it is a recording of rosbag2."""
    try:
        if file.is_dir() and is_bag_folder(file):
            return "rosbag2"
    except (OSError, ValueError):  # `_head` says what is wrong with such a path
        pass
    return recognise(_head(file), file.name, (columns or {}).get("t", "t"))


def _parts(file: Path) -> list[Path]:
    return bag_files(file) if file.is_dir() else [file]


def _head(file: Path) -> bytes:
    try:
        if file.is_dir():
            raise LogError(
                f"{file} is a directory",
                ALLOWED,
                "name one log file, or the folder of a rosbag2 recording; for many logs use `quadid fleet`",
            )
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
    digest = hashlib.sha256()
    for part in _parts(file):
        with part.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
