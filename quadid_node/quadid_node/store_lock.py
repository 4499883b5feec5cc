"""Who may write a history: one service a vehicle, by whatever name the file is called.

The lock lies on the database itself (a byte of the file beyond any content, one a vehicle), so that links, bind mounts
and cleaners change nothing.  It belongs to an open file description: other locks of this process, as SQLite's, and
their end leave it alone.
"""

from __future__ import annotations

import fcntl
import os
import stat
import struct
import threading
import zlib
from collections import Counter
from pathlib import Path

from quadid_node.store_file import StoreError

_FIRST = 1 << 60
"""First byte of the locks: SQLite's lie at 2^30."""
_LOCK = getattr(fcntl, "F_OFD_SETLK", fcntl.F_SETLK)
_File = tuple[int, int]
"""Device and inode."""
_guard = threading.Lock()
_descriptors: dict[_File, int] = {}
"""Files with a lock of this process: closing one would take SQLite's own locks of it away, so each is opened once."""
_users: Counter[_File] = Counter()
_held: set[tuple[_File, str]] = set()


def text(vehicle: str) -> str:
    """The name as it was given; raises StoreError for one that is no text (bytes of another encoding)."""
    try:
        vehicle.encode()
    except UnicodeEncodeError as error:
        raise StoreError(f"the name {vehicle!r} is no text", "a name in UTF-8", "give another --id") from error
    return vehicle


def real(path: Path) -> Path:
    """The file that a path leads to; raises StoreError where no file can have that name."""
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:
        raise StoreError(f"{str(path)!r} names no file ({error})", "a path", "give another --history") from error


class HistoryLock:
    """The right to write a vehicle's rows into the file that stands under a name."""

    def __init__(self, path: Path, vehicle: str) -> None:
        """Takes the lock; makes the file where there is none.

        Raises:
            StoreError: another service has it, or the file has a second name.
            OSError: the file cannot be written.
        """
        self._path, self._vehicle = path, vehicle
        self._file: _File | None = None
        self._take()

    def moved(self) -> bool:
        """Whether another file stands under the name now than before; then that one is locked.

        Raises:
            StoreError: another service has that one.
            OSError: it cannot be written.
        """
        try:
            found = self._path.stat()
        except FileNotFoundError:
            found = None
        if found is not None and (found.st_dev, found.st_ino) == self._file:
            return False
        self.close()
        self._take()
        return True

    def close(self) -> None:
        """Lets others write."""
        with _guard:
            file, self._file = self._file, None
            if file is None:
                return
            _held.discard((file, self._vehicle))
            fcntl.fcntl(_descriptors[file], _LOCK, self._byte(fcntl.F_UNLCK))
            _done_with(file)

    def _take(self) -> None:
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o644)
        found = os.fstat(descriptor)
        file = (found.st_dev, found.st_ino)
        with _guard:
            if file in _descriptors and _descriptors[file] != descriptor:
                os.close(descriptor)
            else:
                _descriptors[file] = descriptor
            _users[file] += 1
            try:
                if not stat.S_ISREG(found.st_mode):
                    raise OSError(0, "not a regular file")
                self._check(found.st_nlink, file)
                fcntl.fcntl(_descriptors[file], _LOCK, self._byte(fcntl.F_WRLCK))
            except BlockingIOError as error:
                _done_with(file)
                raise self._taken() from error
            except (StoreError, OSError):
                _done_with(file)
                raise
            _held.add((file, self._vehicle))
            self._file = file

    def _check(self, names: int, file: _File) -> None:
        if names > 1:
            raise StoreError(
                f"the history {self._path} has {names} names (hard links): by each it would be another database",
                "one name", "remove the other names, or copy the file instead of linking it",
            )  # fmt: skip
        if (file, self._vehicle) in _held:
            raise self._taken()

    def _taken(self) -> StoreError:
        return StoreError(
            f"another service writes the history of '{self._vehicle[:80]}' in {self._path}", "one service a vehicle",
            "stop the other one, give another history, or start as observer",
        )  # fmt: skip

    def _byte(self, kind: int) -> bytes:
        """A `struct flock` of the byte that stands for the vehicle."""
        return struct.pack("hhqqi", kind, os.SEEK_SET, _FIRST + zlib.crc32(self._vehicle.encode()), 1, 0)


def _done_with(file: _File) -> None:
    _users[file] -= 1
    if not _users[file]:
        del _users[file]
        os.close(_descriptors.pop(file))
