"""Files written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from quadid.errors import QuadidError


class OutputError(QuadidError):
    """A place that cannot be written to."""


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
