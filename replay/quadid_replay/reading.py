"""Reads every log in a child process of its own, so that no file can take more than it is allowed, or the caller down.

The child has limits of processor time, time by the clock, memory, files open and bytes written, which the kernel
holds, whatever the format; readers need no such guards of their own.  It is forked by a process that stands ready
(`quadid_replay.reader_process`), one for each program that reads logs, from its first log on.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from quadid.data.window import Recording
from quadid.errors import LogError
from quadid.sanitise import plain
from quadid_replay.answer import unpack

MEMORY, SECONDS = "QUADID_READ_MEMORY_MB", "QUADID_READ_SECONDS"
"""Environment variables that override the limits."""
LARGEST_MEMORY_MB = 8192
LEAST_MEMORY_MB, MEMORY_A_MIB = 768.0, 16.0
LEAST_SECONDS, SECONDS_A_MIB = 10.0, 4.0
STANDING = 20.0
"""Times the limit of processor time that a reader may take by the clock: a busy machine is no fault of the log."""
_MIB = 1 << 20
_STATUS_BYTES = 4


class Limits(NamedTuple):
    """What reading one log may take: memory [MiB], processor time [s]."""

    memory: int
    seconds: float


def limits(size: int) -> Limits:
    """Limits for a file of `size` bytes: 768 MiB and 16 times its size, at most half of this machine's memory and
    8 GiB; 10 s and 4 s a MiB of processor time.

    Raises:
        LogError: an environment variable that is no positive number.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // _MIB
    memory = _given(MEMORY, min(machine / 2, LARGEST_MEMORY_MB, LEAST_MEMORY_MB + MEMORY_A_MIB * size / _MIB))
    return Limits(int(memory), _given(SECONDS, LEAST_SECONDS + SECONDS_A_MIB * size / _MIB))


def _given(name: str, otherwise: float) -> float:
    text = os.environ.get(name, "")
    if not text:
        return otherwise
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e6:
        raise LogError(f"{name}={text[:40]!r}", "a positive number", f"unset {name} or correct it")
    return value


class _Process:
    """The process that stands ready to read logs; started when first asked, and again if it was lost."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._control: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def ask(self, answer: socket.socket) -> None:
        """Hands over the socket on which a request and its answer go."""
        with self._lock:
            try:
                socket.send_fds(self._control or self._start(), [b"\0"], [answer.fileno()])
            except OSError:
                self._stop()
                socket.send_fds(self._start(), [b"\0"], [answer.fileno()])

    def start(self) -> None:
        """Starts the process, where there is none, without waiting for it: who calls has other things to import."""
        with self._lock:
            if self._control is None:
                self._start()

    def stop(self) -> None:
        """Ends the process and all that it reads; the next log starts another."""
        with self._lock:
            self._stop()

    def forget(self) -> None:
        """In a forked process: the parent's process is not this one's."""
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            self._process.returncode = 0  # not ours to wait for
        self.__init__()  # type: ignore[misc]

    def _start(self) -> socket.socket:
        self._control, theirs = socket.socketpair()
        command = [sys.executable, "-P", "-m", "quadid_replay.reader_process", str(theirs.fileno())]
        with theirs:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, pass_fds=[theirs.fileno()],
                start_new_session=True, env=_environment(),
            )  # fmt: skip
        return self._control

    def _stop(self) -> None:
        if self._control is not None and self._process is not None:
            self._control.close()
            self._process.wait()
        self._control = self._process = None


def _environment() -> dict[str, str]:
    """Ours, in which nothing leads to the folder we stand in by an empty name, and in which NumPy starts no threads."""
    path = [os.path.abspath(part) for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path), "OPENBLAS_NUM_THREADS": "1"}


_PROCESS = _Process()
start, stop = _PROCESS.start, _PROCESS.stop
atexit.register(stop)
os.register_at_fork(after_in_child=_PROCESS.forget)


def read_in_child(
    path: Path, kind: str, size: int, preset: str, columns: Mapping[str, str] | None = None
) -> Recording:  # fmt: skip
    """Reads a log in a child process within `limits`.

    Args:
        path: file or folder.
        kind: its format.
        size: bytes of it, of a folder those of its files.
        preset: as in `quadid_replay.open_log`; columns likewise.

    Raises:
        LogError: what the reader says; or the log needs more than the limits, of which the error names the one.
    """
    allowed = limits(size)
    standing = STANDING * allowed.seconds
    request = {
        "format": kind, "path": str(path.absolute()), "preset": preset, "columns": dict(columns or {}),
        "memory": allowed.memory, "seconds": allowed.seconds, "standing": standing,
    }  # fmt: skip
    ours, theirs = socket.socketpair()
    with ours:
        with theirs:
            _PROCESS.ask(theirs)
        ours.settimeout(standing + LEAST_SECONDS)  # the child's own clock stops it before
        try:
            ours.sendall(json.dumps(request).encode() + b"\n")
            with ours.makefile("rb") as stream:
                answer = memoryview(stream.read(allowed.memory * _MIB))
        except TimeoutError as error:
            raise _stopped(path, -signal.SIGALRM, allowed) from error
        except ConnectionError as error:
            raise _stopped(path, -signal.SIGKILL, allowed) from error
    if len(answer) == allowed.memory * _MIB:
        raise _limited(path, "memory", allowed)
    try:
        ended = os.waitstatus_to_exitcode(int.from_bytes(answer[-_STATUS_BYTES:], "little")) if len(answer) else 1
        if ended:
            raise _stopped(path, ended, allowed)
        result = unpack(answer[:-_STATUS_BYTES])
    except ValueError as error:
        raise LogError(
            f"{path.name}: what its reader returned is no recording ({plain(str(error))})", "a log",
            "try again, or report it with the file",
        ) from error  # fmt: skip
    if isinstance(result, str):
        raise _limited(path, result, allowed)
    return result


_BY_SIGNAL = {
    signal.SIGXCPU: "seconds", signal.SIGALRM: "standing", signal.SIGXFSZ: "written",
    signal.SIGABRT: "memory",  # how Python ends where there is not even enough for an error
}  # fmt: skip


def _stopped(path: Path, ended: int, allowed: Limits) -> LogError:
    """Why there is no answer, by how the child ended: minus the signal that ended it, as in `subprocess`."""
    if -ended in _BY_SIGNAL:
        return _limited(path, _BY_SIGNAL[signal.Signals(-ended)], allowed)
    how = signal.Signals(-ended).name if ended < 0 else f"exit code {ended}"
    return LogError(
        f"{path.name}: its reader ended with {how}", f"logs that are read within {allowed.memory} MiB of memory",
        f"copy the file again, allow more with {MEMORY}, or report it with the file",
    )  # fmt: skip


def _limited(path: Path, name: str, allowed: Limits) -> LogError:
    """That reading met a limit: seconds (of the processor), standing (by the clock), memory, written, open files."""
    if name in ("seconds", "standing"):
        seconds = math.ceil(allowed.seconds * (STANDING if name == "standing" else 1.0))
        clock = "by the clock" if name == "standing" else "of processor time"
        return LogError(
            f"{path.name}: reading it takes longer than {seconds} s {clock}", "logs that are read faster",
            f"cut it into parts, or allow more time with {SECONDS}",
        )  # fmt: skip
    if name == "memory":
        return LogError(
            f"{path.name}: reading it takes more than {allowed.memory} MiB of memory", "logs that fit",
            f"cut it into parts or drop topics that are not needed, or allow more with {MEMORY}",
        )  # fmt: skip
    found = "writes files" if name == "written" else "opens too many files"
    return LogError(
        f"{path.name}: reading it {found}", "logs that are only read", "cut it into parts, or copy it again"
    )
