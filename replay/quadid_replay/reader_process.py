"""Serves one program: forks a child for each log it is asked to read, limits that child, and reports how it ended.

This process only imports readers and forks; it never looks into a log.  It stands ready (`python -m
quadid_replay.reader_process FD`) so that a small log pays for a fork and not for an interpreter, and ends with the
program it serves.  A request comes as one byte with a socket beside it; on that socket follow a line of JSON from the
program, the answer of the child (`quadid_replay.answer`), and at last its wait status in four bytes.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import json
import math
import os
import resource
import selectors
import signal
import socket
import struct
import sys
import traceback
from pathlib import Path
from typing import Any, NamedTuple

import numpy.ma  # noqa: F401 - numpy imports it when a median is first asked for, which would be in every child

from quadid.errors import QuadidError
from quadid_replay.answer import pack, pack_error, pack_fault, pack_limit
from quadid_replay.formats import read_here, reader_of

STATUS = struct.Struct("<i")
LONGEST_REQUEST = 1 << 20
_MIB = 1 << 20
OPEN_FILES = 512
"""Files that a child may have open at once: a recording of rosbag2 is in some tens."""
_LIMITS = {errno.EFBIG: "written", errno.EMFILE: "open files"}


class _Child(NamedTuple):
    """A child that reads, the socket its answer goes to, and a pipe that ends when it does."""

    pid: int
    answer: socket.socket
    alive: int


def serve(control: socket.socket) -> None:
    """Takes requests until the program that makes them ends; its children end with it."""
    children: set[_Child] = set()
    with selectors.DefaultSelector() as ready:
        ready.register(control, selectors.EVENT_READ)
        while True:
            for key, _ in ready.select():
                if key.fileobj is control:
                    said, sockets, _, _ = socket.recv_fds(control, 1, 1)
                    if not said:
                        for child in children:
                            os.kill(child.pid, signal.SIGKILL)
                        return
                    child = _begin(socket.socket(fileno=sockets[0]))
                    children.add(child)
                    ready.register(child.alive, selectors.EVENT_READ, child)
                    ready.register(child.answer, selectors.EVENT_READ, child)
                elif key.fileobj == key.data.alive:
                    _, status = os.waitpid(key.data.pid, 0)
                    with contextlib.suppress(OSError):  # who asked has gone
                        key.data.answer.sendall(STATUS.pack(status))
                        key.data.answer.shutdown(socket.SHUT_RDWR)  # also for copies that a fork elsewhere has made
                    with contextlib.suppress(KeyError):
                        ready.unregister(key.data.answer)
                    ready.unregister(key.data.alive)
                    key.data.answer.close()
                    os.close(key.data.alive)
                    children.remove(key.data)
                elif key.data in children:  # whoever asked has hung up
                    ready.unregister(key.data.answer)
                    os.kill(key.data.pid, signal.SIGKILL)


def _begin(answer: socket.socket) -> _Child:
    """Forks a child for the request on this socket."""
    with answer.makefile("rb", buffering=0) as stream:
        request = json.loads(_line(stream))
    with contextlib.suppress(Exception):  # the child meets it again, and says so
        reader_of(request["format"])  # imported once, here
    gc.freeze()
    alive, ends_with_child = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            _read(answer, **request)
        finally:
            os._exit(1)
    os.close(ends_with_child)
    return _Child(pid, answer, alive)


def _line(stream: Any) -> bytes:
    """The request, byte by byte as it comes, so that nothing behind it is taken."""
    parts: list[bytes] = []
    while not parts or not parts[-1].endswith(b"\n"):
        parts.append(stream.read(LONGEST_REQUEST))
        if not parts[-1]:
            return b'{"format": ""}'
    return b"".join(parts)


def _read(
    answer: socket.socket, format: str, path: str = "", preset: str = "", columns: dict[str, str] | None = None,
    memory: int = 0, seconds: float = 0.0, standing: float = 0.0,
) -> None:  # fmt: skip
    """Runs the child.  It never returns."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):  # whatever a library prints
        os.dup2(nothing, stream)
    for limit, most in (
        (resource.RLIMIT_DATA, memory * _MIB),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, OPEN_FILES),
    ):
        resource.setrlimit(limit, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 5))
    signal.setitimer(signal.ITIMER_REAL, standing)
    try:
        for part in _attempt(Path(path), preset, columns or {}):
            answer.sendall(part)
    except MemoryError:
        answer.sendall(pack_limit("memory"))
    os._exit(0)


def _attempt(path: Path, preset: str, columns: dict[str, str]) -> list[bytes | memoryview]:
    try:
        return [*pack(read_here(path, preset, columns))]
    except QuadidError as error:
        noticed = _LIMITS.get(getattr(error.__cause__, "errno", 0) or 0)
        return [pack_limit(noticed) if noticed else pack_error(error)]
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - the reader of a stranger's file: told, with the place, where it is met
        where = " < ".join(
            f"{frame.filename}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)[:-4:-1]
        )
        return [pack_fault(f"{path.name}: its reader failed ({type(error).__name__}: {error}) at {where}")]


def main() -> None:
    """Serves on the socket whose number is given."""
    for number in (signal.SIGALRM, signal.SIGXCPU, signal.SIGCHLD, signal.SIGPIPE):  # who started us may ignore them
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    with socket.socket(fileno=int(sys.argv[1])) as control:
        serve(control)


if __name__ == "__main__":
    main()
