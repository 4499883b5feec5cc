"""Folders that `ros2 bag record` makes: which files of them are read, in which order."""

from __future__ import annotations

import re
from pathlib import Path

from quadid.errors import LogError


def is_bag_folder(path: Path) -> bool:
    """Tells whether a folder holds a recording of rosbag2, by its metadata."""
    return (path / "metadata.yaml").is_file()


def bag_files(folder: Path) -> list[Path]:
    """The files of a recording, in the order of their numbers; raises LogError where there is none to read."""
    files = _files(folder)
    packed = sorted(p.name for p in folder.glob("*.zstd"))
    if packed:
        raise LogError(
            f"{folder.name}: {packed[0]} is compressed", "files that are not", f"unpack it: zstd -d {packed[0]}"
        )
    if not files:
        raise LogError(f"{folder.name}: neither .mcap nor .db3 in it", "a folder of ros2 bag record", "check the path")
    return sorted(files, key=lambda p: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", p.name)])


def _files(folder: Path) -> list[Path]:
    return [p for end in ("mcap", "db3") for p in folder.glob(f"*.{end}") if p.is_file()]
