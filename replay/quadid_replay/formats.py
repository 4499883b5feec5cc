"""Reads a log in this process: the reader of its format, and why a file cannot be read."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from quadid.errors import LogError
from quadid.window import Recording
from quadid_replay.bag_folder import bag_files, is_bag_folder
from quadid_replay.recognise import ALLOWED, HEAD_BYTES, Format, recognise


def read_here(file: Path, preset: str, columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a log in this process, whatever its size; else as `open_log`."""
    kind = kind_of(file, columns)
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


def kind_of(file: Path, columns: Mapping[str, str] | None) -> Format:
    """The format of a file; of a folder, that it is a recording of rosbag2."""
    try:
        if file.is_dir() and is_bag_folder(file):
            return "rosbag2"
    except (OSError, ValueError):  # `_head` says what is wrong with such a path
        pass
    return recognise(_head(file), file.name, (columns or {}).get("t", "t"))


def parts_of(file: Path) -> list[Path]:
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
    for part in parts_of(file):
        with part.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
