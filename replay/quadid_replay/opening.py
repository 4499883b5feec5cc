"""The one door for logs: `open_log`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from quadid.data.window import Recording
from quadid.errors import LogError
from quadid_replay.formats import kind_of, parts_of
from quadid_replay.presets import AUTO, preset_rank
from quadid_replay.reading import read_in_child

LARGE = 4 << 20
"""Files of this size [bytes] are looked at for missing parts; of small ones a file system may store nothing apart."""
_STORED = 0.02
"""A large file of which less than this share is stored holds nothing but zeros: its copy was not finished."""


def open_log(path: str | Path, preset: str = AUTO, columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a flight log of any known format into core units and frames (SI, world NED, body FRD).

    It is read in a child process with limited memory and time, see `quadid_replay.reading`; here only its first bytes
    are looked at.

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
    kind = kind_of(file, columns)
    sizes = [part.stat() for part in parts_of(file)]
    size = sum(part.st_size for part in sizes)
    stored = 512 * sum(part.st_blocks for part in sizes)
    if size >= LARGE and stored < _STORED * size:
        raise LogError(
            f"{file.name}: {size >> 20} MiB of which {stored >> 20} MiB are stored", "a whole file",
            "copy it again: the copy or the logger stopped before the end",
        )  # fmt: skip
    return read_in_child(file, kind.name, size, preset, columns)
