"""Files and folders of users: nobody waits for a pipe, files are written whole, nothing in a folder is run."""

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path


def unwaited(name: str, flags: int) -> int:
    """Opens as `open` does (its argument ``opener``), but never waits for the other end of a pipe.

    Raises:
        OSError: a pipe to be written that nobody reads.
    """
    descriptor = os.open(name, flags | os.O_NONBLOCK, 0o666)
    os.set_blocking(descriptor, True)
    return descriptor


@contextlib.contextmanager
def written_whole(target: Path) -> Iterator[Path]:
    """A name under which to write a file whole or not at all; a pipe or device is written to where one stands there.

    Where a link stands, it is the link that is replaced.

    Raises:
        OSError: it cannot be written.
    """
    # /dev/stdout is a link that the system keeps, to a file where one was redirected.
    ways = os.path.realpath(target.parent) + "/", os.readlink(target) if target.is_symlink() else ""
    if target.exists() and (not target.is_file() or any(way.startswith("/proc/") for way in ways)):
        with open(target, "wb", opener=unwaited):  # held open: whatever writes it next need not wait for a reader
            yield target
        return
    part = target.with_name(f".{os.getpid()}.{target.name[-24:]}")
    try:
        part.unlink(missing_ok=True)  # a link that somebody laid there would be followed
        yield part
        os.replace(part, target)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def read_regular(path: str | Path, most: int = 1 << 20) -> bytes:
    """Reads at most `most` bytes of a file.

    Raises:
        OSError: it cannot be read, or is a pipe, a device or a folder, which may have no end and need never begin.
    """
    with open(path, "rb", opener=unwaited) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file", str(path))
        return file.read(most)


_NAMES_ANOTHER = bytes.fromhex("d9d505f920a163d7")
"""End of a journal that belongs to several databases: theirs is named in it, and removed once no journal names it.

Ours are never written together with others.
"""


def check_beside(database: str | Path) -> None:
    """Checks what SQLite keeps beside a database, and writes to whatever stands there.

    Raises:
        OSError: one of these files is a link, or has a second name by which it is another file of the user; or a
            journal that names another file, which SQLite would remove.
    """
    for end in ("-wal", "-shm", "-journal"):
        beside = f"{os.path.realpath(database)}{end}"
        with contextlib.suppress(FileNotFoundError):
            found = os.lstat(beside)
            if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                raise OSError(errno.EINVAL, "it is a link, or has a second name", beside)
    with contextlib.suppress(FileNotFoundError), open(beside, "rb", opener=unwaited) as journal:
        journal.seek(max(os.fstat(journal.fileno()).st_size - len(_NAMES_ANOTHER), 0))
        if journal.read(len(_NAMES_ANOTHER)) == _NAMES_ANOTHER:
            raise OSError(errno.EINVAL, "it names another file, which SQLite would remove", beside)


# --- The folder that a program runs in may have been packed by a stranger: nothing in it is run
#
# Looked at before anything else is imported, and with nothing but the standard library.


NUMBA_SETTINGS = Path(".numba_config.yaml")
"""numba reads this file in the working folder, and loads machine code from the folder that it names."""


def refuse() -> None:
    """Raises ImportError in a folder whose settings of numba would change what is computed."""
    if NUMBA_SETTINGS.exists():
        what = f"{NUMBA_SETTINGS} in this folder would change what is computed, and run code from elsewhere"
        raise ImportError(f"{what}; fix: change to another folder, or remove it", name="quadid")


def guard() -> None:
    """Refuses such a folder; no Python that this process starts imports from the one it stands in.

    Libraries start Python too (the fork servers and resource trackers of `multiprocessing`, of which Dask makes use):
    ``python -c`` and ``python -m`` look into the working folder first, unless PYTHONSAFEPATH is set.
    """
    refuse()
    os.environ["PYTHONSAFEPATH"] = os.environ.get("PYTHONSAFEPATH") or "1"
    searched = os.environ.get("PYTHONPATH", "")
    if "" in searched.split(os.pathsep) and searched:  # an empty entry is the working folder
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, searched.split(os.pathsep)))
