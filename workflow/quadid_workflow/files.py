"""Files written whole or not at all; files of users read without waiting for one that is none."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from quadid.errors import QuadidError


class OutputError(QuadidError):
    """A place that cannot be written to."""


def read_regular(path: str | Path, most: int = 1 << 20) -> bytes:
    """Reads at most `most` bytes of a file.

    Raises:
        OSError: it cannot be read, or is a pipe, a device or a folder, which may have no end and need never begin.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file", str(path))
        return file.read(most)


def write_text(path: str | Path, text: str) -> Path:
    """Writes a file whole or not at all; returns its absolute path."""
    target = Path(path).absolute()
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, target)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(
            f"{target} cannot be written ({error.strerror})", fix="check permissions and free space"
        ) from error
    return target


def file_name(name: str) -> str:
    """A vehicle's name as part of a file name: letters, digits and ``-_+.`` only."""
    return "".join(c if c.isalnum() or c in "-_+." else "_" for c in name).lstrip(".")[:100] or "vehicle"
