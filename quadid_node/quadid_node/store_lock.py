"""Who may write a history: one service a vehicle, by whatever name the file is called."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO

from quadid_node.store_file import StoreError


def text(vehicle: str) -> str:
    """The name as it was given; raises StoreError for one that is no text (bytes of another encoding)."""
    try:
        vehicle.encode()
    except UnicodeEncodeError as error:
        raise StoreError(f"the name {vehicle!r} is no text", "a name in UTF-8", "give another --id") from error
    return vehicle


def real(path: Path) -> Path:
    """The file that a path leads to: services that reach one file by several links must meet at one lock.

    Raises:
        StoreError: no file can have that name.
    """
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:
        raise StoreError(f"{str(path)!r} names no file ({error})", "a path", "give another --history") from error


def take_lock(path: Path, vehicle: str) -> IO[str]:
    """The right to write a vehicle's rows, until the file returned is closed.

    Raises:
        StoreError: another service has it.
        OSError: no file can be made beside the history.
    """
    plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in vehicle)[:80]
    lock = path.with_name(f"{path.name}.{plain}.lock").open("a")  # empties nothing that a link leads to
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        lock.close()
        raise StoreError(
            f"another service writes the history of '{vehicle}' in {path}", "one service a vehicle",
            "stop the other one, give another history, or start as observer",
        ) from error  # fmt: skip
    return lock
