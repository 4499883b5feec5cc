"""Opens logs: every log is read in a child process of its own, so that no file can take more than it is allowed, or the
caller down.

The child has limits of processor time, time by the clock, memory, files open and bytes written, which the kernel
holds, whatever the format; readers need no such guards of their own.  It is forked, with a process that watches it, by
one that stands ready (`python -m quadid_replay.opening FD`), one for each program that reads logs, from its first log
on, so that a small log pays for forks and not for an interpreter.  That process only imports readers and forks; it
never looks into a log.
"""

import atexit
import contextlib
import errno
import gc
import json
import math
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.ma
from numpy.typing import ArrayLike

from quadid.data.window import Recording
from quadid.errors import LogError, QuadidError
from quadid.sanitise import LONGEST_LINE, plain
from quadid.types import FloatArray
from quadid_replay.formats import kind_of, parts_of, read_here, reader_of
from quadid_replay.ros_messages import AUTO, preset_rank

LARGE = 4 << 20
"""Files of this size [bytes] are looked at for missing parts; of small ones a file system may store nothing apart."""
_STORED = 0.02
"""A large file of which less than this share is stored holds nothing but zeros: its copy was not finished."""
MEMORY, SECONDS = "QUADID_READ_MEMORY_MB", "QUADID_READ_SECONDS"
"""Environment variables that override the limits."""
LARGEST_MEMORY_MB = 8192
LEAST_MEMORY_MB, MEMORY_A_MIB = 768.0, 16.0
LEAST_SECONDS, SECONDS_A_MIB = 10.0, 4.0
STANDING = 20.0
"""Times the limit of processor time that a reader may take by the clock: a busy machine is no fault of the log."""
OPEN_FILES = 512
"""Files that a child may have open at once: a recording of rosbag2 is in some tens."""
_MIB = 1 << 20
_STATUS_BYTES = 4
LONGEST_NAME = 64
"""Bytes of the name of a format."""


def open_log(path: str | Path, preset: str = AUTO, columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a flight log of any known format into core units and frames (SI, world NED, body FRD).

    Args:
        path: the file, whose format is recognised by its content and never by its suffix, or the folder of a rosbag2
            recording.
        preset: for ROS logs, whose topic names to expect (see `quadid_replay.ros_messages`); auto finds them by type.
        columns: for CSV, names in the file for those of the contract, as in the vehicle file.

    Raises:
        LogError: no such file, a directory, an empty file, an unknown format, nothing readable in it, or a file whose
            reading takes more memory or time than is allowed.
    """
    file = Path(path)
    preset_rank(preset, "gyro", "")  # an unknown preset is an error whatever the file is
    if columns:
        from quadid_replay.csv_reader import check_columns

        check_columns(columns)
    kind = kind_of(file, columns)
    allowed = limits(stored_size(file))
    request = {"path": str(file.absolute()), "preset": preset, "columns": dict(columns or {}), **allowed._asdict()}
    # Asked twice where nobody answers at all: the process that stands ready ended with the request in its hands.
    answer = _answer(file, kind.name, request, allowed) or _answer(file, kind.name, request, allowed)
    if not answer:
        raise _stopped(file, -signal.SIGKILL, allowed)
    if len(answer) == allowed.memory * _MIB:
        raise _limited(file, "memory", allowed)
    try:
        if ended := os.waitstatus_to_exitcode(int.from_bytes(answer[-_STATUS_BYTES:], "little")):
            raise _stopped(file, ended, allowed)
        return unpack(answer[:-_STATUS_BYTES])
    except ValueError as error:
        raise LogError(
            f"{file.name}: what its reader returned is no recording ({plain(str(error))})",
            "a log",
            "try again, or report it with the file",
        ) from error


def stored_size(file: Path) -> int:
    """Size of a log, of a folder that of its files [bytes]; raises LogError where hardly any of it is stored."""
    sizes = [part.stat() for part in parts_of(file)]
    size = sum(part.st_size for part in sizes)
    stored = 512 * sum(part.st_blocks for part in sizes)
    if size >= LARGE and stored < _STORED * size:
        raise LogError(
            f"{file.name}: {size >> 20} MiB of which {stored >> 20} MiB are stored",
            "a whole file",
            "copy it again: the copy or the logger stopped before the end",
        )
    return size


# --- Limits, and why there is no answer


class ReadLimits(NamedTuple):
    """Limits of reading one log: memory [MiB], processor time [s]."""

    memory: int
    seconds: float


def limits(size: int) -> ReadLimits:
    """Limits for a file of `size` bytes: 768 MiB and 16 times its size, at most half of this machine's memory and
    8 GiB; 10 s and 4 s a MiB of processor time.

    Raises:
        LogError: an environment variable that is no positive number.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // _MIB
    memory = _given(MEMORY, min(machine / 2, LARGEST_MEMORY_MB, LEAST_MEMORY_MB + MEMORY_A_MIB * size / _MIB))
    return ReadLimits(int(memory), _given(SECONDS, LEAST_SECONDS + SECONDS_A_MIB * size / _MIB))


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


_BY_SIGNAL = {
    signal.SIGXCPU: "seconds",
    signal.SIGALRM: "standing",
    signal.SIGXFSZ: "written",
    signal.SIGABRT: "memory",  # how Python ends where there is not even enough for an error
}
_BY_ERROR = {errno.EFBIG: "written", errno.EMFILE: "open files"}


def _stopped(path: Path, ended: int, allowed: ReadLimits) -> LogError:
    """Why there is no answer, by how the child ended: minus the signal that ended it, as in `subprocess`."""
    if -ended in _BY_SIGNAL:
        return _limited(path, _BY_SIGNAL[signal.Signals(-ended)], allowed)
    how = signal.Signals(-ended).name if ended < 0 else f"exit code {ended}"
    return LogError(
        f"{path.name}: its reader ended with {how}",
        f"logs that are read within {allowed.memory} MiB of memory",
        f"copy the file again, allow more with {MEMORY}, or report it with the file",
    )


def _limited(path: Path, name: str, allowed: ReadLimits) -> LogError:
    """That reading met a limit: seconds (of the processor), standing (by the clock), memory, written, open files."""
    slow = "logs that are read faster", f"cut it into parts, or allow more time with {SECONDS}"
    only_read = "logs that are only read", "cut it into parts, or copy it again"
    found, fits, fix = {
        "seconds": (f"takes longer than {math.ceil(allowed.seconds)} s of processor time", *slow),
        "standing": (f"takes longer than {math.ceil(STANDING * allowed.seconds)} s by the clock", *slow),
        "memory": (
            f"takes more than {allowed.memory} MiB of memory",
            "logs that fit",
            f"cut it into parts or drop topics that are not needed, or allow more with {MEMORY}",
        ),
        "written": ("writes files", *only_read),
        "open files": ("opens too many files", *only_read),
    }[name]
    return LogError(f"{path.name}: reading it {found}", fits, fix)


def _answer(file: Path, kind: str, request: Mapping[str, Any], allowed: ReadLimits) -> memoryview:
    """Answer of a child and its wait status; nothing where whoever took the request has ended without a word."""
    ours, theirs = socket.socketpair()
    with ours:
        with theirs:
            _PROCESS.ask(kind, theirs)
        ours.settimeout(STANDING * allowed.seconds + LEAST_SECONDS)  # the child's own clock stops it before
        try:
            ours.sendall(json.dumps(request).encode() + b"\n")
            with ours.makefile("rb") as stream:
                return memoryview(stream.read(allowed.memory * _MIB))
        except TimeoutError as error:
            raise _stopped(file, -signal.SIGALRM, allowed) from error
        except ConnectionError:
            return memoryview(b"")


# --- The answer of a child: a recording, or the reason why there is none
#
# It is data and nothing else, for the process that wrote it has read a stranger's file: msgpack of these types, the
# numbers of the channels as little-endian doubles, all of it checked once more by the one that asked.


_DOUBLE = "<f8"


class BadAnswerError(ValueError):
    """An answer that is none: sizes that do not fit, numbers that are not finite, a name that is not known."""


class Answer(msgspec.Struct, omit_defaults=True):
    """One of these: the recording, or why there is none: found, allowed and fix, as of `LogError`."""

    recording: Recording | None = None
    refused: tuple[str, str, str] | None = None


def pack(answer: Answer) -> bytes:
    """An answer as bytes."""
    return msgspec.msgpack.encode(
        answer, enc_hook=lambda rows: (rows.shape, np.ascontiguousarray(rows, _DOUBLE).data.cast("B"))
    )


def unpack(data: bytes | memoryview) -> Recording:
    """Checks an answer and returns the recording.

    Raises:
        LogError: the refusal that the answer holds.
        BadAnswerError: anything that is no answer.
    """

    def shown(value: Any) -> Any:
        """Text that may be shown, wherever it stands."""
        if isinstance(value, str):
            return plain(value, LONGEST_LINE)
        if isinstance(value, dict):
            return {shown(key): shown(inner) for key, inner in value.items()}
        return [shown(inner) for inner in value] if isinstance(value, list) else value

    def rows_of(kind: Any, value: tuple[Sequence[int], bytes]) -> FloatArray:
        rows = np.frombuffer(value[1], _DOUBLE).reshape(value[0])
        finite(rows)
        return rows

    def finite(numbers: ArrayLike) -> None:
        if not np.isfinite(numbers).all():
            raise ValueError("numbers that are not finite")

    try:
        told = msgspec.convert(shown(msgspec.msgpack.decode(data)), Answer, dec_hook=rows_of)
        if (found := told.recording) is not None:
            finite([*found.breaks, *(t for t, _ in found.modes), *filter(None, (found.grid, found.epoch))])
            for name, channel in found.channels.items():
                if name != channel.name or min(channel.faults.values(), default=0) < 0:
                    raise ValueError("a channel under another's name, or a count that is none")
    except (msgspec.DecodeError, RecursionError, ValueError, QuadidError) as error:
        raise BadAnswerError(str(error)) from error
    if told.refused is not None:
        raise LogError(*told.refused)
    if found is None:
        raise BadAnswerError("nothing in it")
    return found


# --- The process that stands ready, as the program sees it


class _Process:
    """The process that forks what reads logs; started when first asked, and again if it was lost."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._control: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def ask(self, kind: str, answer: socket.socket) -> None:
        """Hands over the name of a format, and the socket on which a request and its answer go."""
        with self._lock:
            try:
                socket.send_fds(self._control or self._start(), [kind.encode()], [answer.fileno()])
            except OSError:
                self._stop()
                socket.send_fds(self._start(), [kind.encode()], [answer.fileno()])

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
        self._control, theirs = socket.socketpair(type=socket.SOCK_SEQPACKET)
        # Nothing leads to the folder we stand in by an empty name, and NumPy starts no threads.
        path = [os.path.abspath(part) for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part]
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "quadid_replay.opening", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path), "OPENBLAS_NUM_THREADS": "1"},
            )
        return self._control

    def _stop(self) -> None:
        if self._control is not None and self._process is not None:
            self._control.close()
            self._process.wait()
        self._control = self._process = None


_PROCESS = _Process()
start, stop = _PROCESS.start, _PROCESS.stop
atexit.register(stop)
os.register_at_fork(after_in_child=_PROCESS.forget)


# --- The process that stands ready, and the children that it forks
#
# A request comes as the name of a format with a socket beside it; on that socket follow a line of JSON from the
# program, the answer of the child, and at last its wait status in four bytes.


def serve(control: socket.socket) -> None:
    """Takes requests until the program that makes them ends, and all that is read with it."""
    while kind := (received := socket.recv_fds(control, LONGEST_NAME, 1))[0]:
        with contextlib.suppress(Exception):  # the child meets it again, and says so
            reader_of(kind.decode())  # imported once, here
        gc.freeze()
        (answer,) = received[1]
        if os.fork() == 0:
            try:
                _attend(socket.socket(fileno=answer), control)
            finally:
                os._exit(1)
        os.close(answer)
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:  # of those before
                pass
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, 0)[0]:
            pass


def _attend(answer: socket.socket, control: socket.socket) -> None:
    """Forks the child that reads what is asked on this socket, and tells how it ended."""
    with answer.makefile("rb", buffering=0) as stream:  # nothing behind the line is taken
        request = json.loads(stream.readline())
    alive, ends_with_child = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            _read(answer, **request)
        finally:
            os._exit(1)
    os.close(ends_with_child)
    ended = select.poll()
    for other_side in (alive, answer.fileno(), control.fileno()):
        ended.register(other_side, 0)  # only that it hangs up
    if alive not in dict(ended.poll()):
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    with contextlib.suppress(OSError):  # who asked has gone
        answer.sendall(status.to_bytes(_STATUS_BYTES, "little"))
        answer.shutdown(socket.SHUT_RDWR)  # also for copies that a fork elsewhere has made


def _read(
    answer: socket.socket, path: str, preset: str, columns: Mapping[str, str], memory: int, seconds: float
) -> None:
    """Runs the child.  It never returns."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):  # whatever a library prints
        os.dup2(nothing, stream)
    processor = math.ceil(seconds)
    for limit, soft, hard in (
        (resource.RLIMIT_DATA, memory * _MIB, memory * _MIB),
        (resource.RLIMIT_FSIZE, 0, 0),
        (resource.RLIMIT_CORE, 0, 0),
        (resource.RLIMIT_NOFILE, OPEN_FILES, OPEN_FILES),
        (resource.RLIMIT_CPU, processor, processor + 5),
    ):
        resource.setrlimit(limit, (soft, hard))
    signal.setitimer(signal.ITIMER_REAL, STANDING * seconds)
    file, allowed = Path(path), ReadLimits(memory, seconds)

    def refused(error: QuadidError) -> bytes:
        return pack(Answer(refused=(error.found, error.allowed, error.fix)))

    told = refused(_limited(file, "memory", allowed))  # made while there is memory
    with contextlib.suppress(MemoryError):
        try:
            told = pack(Answer(read_here(file, preset, columns)))
        except QuadidError as error:
            met = _BY_ERROR.get(getattr(error.__cause__, "errno", 0) or 0)
            told = refused(_limited(file, met, allowed) if met else error)
        except MemoryError:
            pass
        except Exception as error:  # noqa: BLE001 - the reader of a stranger's file: told, with the place it is met at
            where = " < ".join(f"{f.filename}:{f.lineno}" for f in traceback.extract_tb(error.__traceback__)[:-4:-1])
            found = f"{file.name}: its reader failed ({type(error).__name__}: {error}) at {where}"
            told = refused(LogError(found, "", "report it with the file: the reader of this format failed on it"))
    answer.sendall(told)
    os._exit(0)


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
