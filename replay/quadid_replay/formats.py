"""The formats of logs: how each begins, for the suffix is never believed, and what reads it."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from quadid.data.window import Recording
from quadid.errors import LogError
from quadid.sanitise import plain
from quadid_replay.columns import EARLIEST_US, LATEST_US
from quadid_replay.rosbag import bag_files, is_bag_folder

HEAD_BYTES = 65536
"""Bytes of the file that are looked at."""
ALLOWED = (
    "ROS 2 MCAP and rosbag2 (.db3 or folder), MAVLink .tlog, ArduPilot DataFlash .bin, PX4 .ulg, "
    "Crazyflie µSD log, Betaflight blackbox, CSV with a header row and a column t"
)

_FOREIGN: tuple[tuple[bytes, str, str], ...] = (
    (b"#ROSBAG V2.0", "a ROS 1 bag", "convert it: rosbags-convert --src FILE --dst DIR, then to MCAP"),
    (b"\x1f\x8b", "gzip-compressed", "unpack it: gunzip FILE"),
    (b"\x28\xb5\x2f\xfd", "zstd-compressed", "unpack it: zstd -d FILE"),
    (b"PK\x03\x04", "a zip archive", "unpack it: unzip FILE"),
    (b"\x89HDF\r\n", "HDF5", "export it as CSV"),
    (b"MATLAB 5.0", "a MATLAB file", "export it as CSV, or use the .bin it was made from"),
    (b"FMT, 128,", "a DataFlash text log", "use the binary .bin log"),
    (b"\xff\xfe", "UTF-16 text", "save it as UTF-8"),
    (b"\xfe\xff", "UTF-16 text", "save it as UTF-8"),
    (b"\xbc\x01\x00", "a Crazyflie µSD log of version 1", "record it with newer firmware"),
)
_FEW_COLUMNS = 3
"""Text with more commas than these in its first line is a table."""


class LogFormat(NamedTuple):
    """A format of logs: its name, how it begins, and what reads it.

    Attributes:
        name: as `Recording.format` has it.
        begins: its first bytes, or what recognises it from its first `HEAD_BYTES` and the column of time of a CSV.
        reader: module of this package and function in it, which takes the path and returns a `Recording`.
        takes: arguments of `quadid_replay.open_log` that the function takes beside the path.
    """

    name: str
    begins: bytes | Callable[[bytes, str], bool]
    reader: str
    takes: tuple[str, ...] = ()

    def fits(self, head: bytes, time: str) -> bool:
        """Tells whether a log that begins with `head` is of this format."""
        return head.startswith(self.begins) if isinstance(self.begins, bytes) else self.begins(head, time)


def recognise(head: bytes, name: str, time: str = "t") -> LogFormat:
    """Returns the format of a log that begins with `head`.

    Args:
        head: first `HEAD_BYTES` of the file (fewer if it is short).
        name: file name, for errors only.
        time: name of a CSV's column of time.

    Raises:
        LogError: none of the known formats; says what it is when that is known.
    """
    if not head:
        raise LogError(f"{name}: empty file", ALLOWED, "check that the logger finished writing, then copy it again")
    for magic, what, fix in _FOREIGN:
        if head.startswith(magic):
            raise LogError(f"{name}: {what}", ALLOWED, fix)
    for known in FORMATS:
        if known.fits(head, time):
            return known
    cells = _cells(head)
    if len(cells) > _FEW_COLUMNS and all(cell.isprintable() for cell in cells):
        raise LogError(
            f"{name}: a CSV without the column '{time}' (its first are {plain(', '.join(cells[:3]))})",
            "the time [s] in a column t",
            f"name it: --columns {plain(cells[0])}=t",
        )
    if head.count(b",", 0, 1000) > _FEW_COLUMNS and b"\n" in head and b"\0" not in head:
        found = "a table whose header is no plain text (UTF-8, characters that print)"
        raise LogError(f"{name}: {found}", ALLOWED, "write plain names of columns, and save it as UTF-8")
    shown = head[:8].hex(" ")
    raise LogError(f"{name}: unknown format (begins with {shown})", ALLOWED, "see docs/logs.md for what each needs")


def _is_dataflash(head: bytes) -> bool:
    """Two format messages (A3 95 80) 89 bytes apart, or one at the very start."""
    if head[:3] == b"\xa3\x95\x80":
        return True
    at = head.find(b"\xa3\x95\x80")
    return at >= 0 and head[at + 89 : at + 91] == b"\xa3\x95"


def _is_tlog(head: bytes) -> bool:
    """An 8-byte receive time (microseconds, big endian) before a MAVLink frame, twice in a row where there is room."""
    for at in range(0, min(len(head) - 12, 2048)):
        length = _frame_length(head, at)
        if length is None:
            continue
        following = at + length
        if following + 12 > len(head) or _frame_length(head, following) is not None:
            return at == 0 or following + 12 <= len(head)
    return False


def _frame_length(head: bytes, at: int) -> int | None:
    """Returns the length of receive time and frame at `at`, or None when there is no such thing."""
    if at + 12 > len(head) or head[at + 8] not in (0xFE, 0xFD):
        return None
    stamp = int.from_bytes(head[at : at + 8], "big")
    if not EARLIEST_US < stamp < LATEST_US:
        return None
    payload = head[at + 9]
    if head[at + 8] == 0xFE:
        return 8 + 8 + payload
    return 8 + 12 + payload + (13 if head[at + 10] & 1 else 0)


def _cells(head: bytes) -> list[str]:
    """Cells of the header of a CSV; none where it is not text."""
    line = (header_line(head) or "").replace(";", ",").replace("\t", ",")
    return [cell.strip().strip('"') for cell in line.split(",")]


def header_line(head: bytes) -> str | None:
    """Returns the first line that is neither empty nor a comment (#), or None when it is not text."""
    for line in head.removeprefix(b"\xef\xbb\xbf").splitlines():
        if line.strip() and not line.lstrip().startswith(b"#"):
            try:
                text = line.decode("utf-8")
            except UnicodeDecodeError:
                return None
            return text if text.replace("\t", " ").isprintable() else None
    return None


FORMATS = (
    LogFormat("mcap", b"\x89MCAP0\r\n", "rosbag:read_mcap", ("preset",)),
    LogFormat("rosbag2", b"SQLite format 3\x00", "rosbag:read_mcap", ("preset",)),
    LogFormat("ulog", b"ULog\x01\x12\x35", "ulog:read_ulog"),
    LogFormat("blackbox", b"H Product:Blackbox", "blackbox:read_blackbox"),
    LogFormat("usdlog", b"\xbc\x02\x00", "usd:read_usd"),
    LogFormat("dataflash", lambda head, time: _is_dataflash(head), "dataflash:read_dataflash"),
    LogFormat("tlog", lambda head, time: _is_tlog(head), "tlog:read_tlog"),
    LogFormat("csv", lambda head, time: time in _cells(head), "csv_reader:read_csv", ("columns",)),
)
"""In the order in which they are tried."""


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
        digest = hashlib.sha256()
        for part in parts_of(file):
            with part.open("rb") as stream:
                hashlib.file_digest(stream, lambda: digest)
        return replace(recording, sha256=digest.hexdigest())
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
    """The files of a log: of a folder those of its recording."""
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
