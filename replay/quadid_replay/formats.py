"""Formats of logs: the reader of each, and why a file cannot be read."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from quadid.data.window import Recording
from quadid.errors import LogError
from quadid_replay.recognise import ALLOWED, FORMATS, HEAD_BYTES, LogFormat, recognise
from quadid_replay.rosbag import bag_files, is_bag_folder


def reader_of(kind: str) -> Callable[..., Recording]:
    """The function that reads the format of this name, with only the libraries imported that it needs."""
    (module, name) = next(f.reader for f in FORMATS if f.name == kind).split(":")
    read: Callable[..., Recording] = getattr(import_module(f"quadid_replay.{module}"), name)
    return read


def read_here(file: Path, preset: str, columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a log in this process, without limits; else as `open_log`."""
    kind = kind_of(file, columns)
    given: dict[str, Any] = {"preset": preset, "columns": columns}
    try:
        recording = reader_of(kind.name)(file, **{name: given[name] for name in kind.takes})
        return replace(recording, sha256=_sha256(file))
    except OSError as error:
        raise _unreadable(file, error) from error


def kind_of(file: Path, columns: Mapping[str, str] | None) -> LogFormat:
    """The format of a file; of a folder, that it is a recording of rosbag2."""
    try:
        if file.is_dir() and is_bag_folder(file):
            return next(f for f in FORMATS if f.name == "rosbag2")
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
