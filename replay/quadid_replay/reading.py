"""Reads a large log in a child process with a limit of memory and time, so that no file can take the caller down.

Small logs are read where they are asked for: the readers bound what they keep by what the file holds.  A large one, or
an MCAP that may inflate, could still take more memory than there is; the child is stopped then and the log is refused.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import pickle
import resource
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from quadid.errors import LogError, QuadidError
from quadid.window import Recording

MEMORY, SECONDS = "QUADID_READ_MEMORY_MB", "QUADID_READ_SECONDS"
"""Environment variables that override the limits."""
LARGEST_MEMORY_MB = 8192
LEAST_MEMORY_MB, MEMORY_A_MIB = 768.0, 16.0
LEAST_SECONDS, SECONDS_A_MIB = 10.0, 4.0
STANDING = 20.0
"""Times the limit of processor time that a reader may take by the clock: a busy machine is no fault of the log."""
_MIB = 1 << 20


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
    if not 0.0 < value < 1e9:
        raise LogError(f"{name}={text[:40]!r}", "a positive number", f"unset {name} or correct it")
    return value


def read_in_child(path: Path, size: int, preset: str, columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a log of `size` bytes, of a folder those of its files, as `quadid_replay.open_log` does, in a child process
    within `limits`.

    Raises:
        LogError: what the reader says; or the log needs more memory or time than the limits, which the error names.
    """
    allowed = limits(size)
    request = json.dumps([str(path.absolute()), preset, dict(columns or {}), *allowed])
    command = [sys.executable, "-P", "-m", __name__, request]  # no module of the folder we stand in
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as child:
        try:
            answer, _ = child.communicate(timeout=STANDING * allowed.seconds)
        except subprocess.TimeoutExpired as error:
            raise _too_slow(path, STANDING * allowed.seconds) from error
        finally:
            child.kill()
    if child.returncode == -signal.SIGXCPU:
        raise _too_slow(path, allowed.seconds)
    try:
        result = pickle.loads(answer)  # written by our own child
    except (EOFError, pickle.UnpicklingError) as error:
        raise _too_large(path, allowed, f" (the reader ended with {child.returncode})") from error
    if isinstance(result, MemoryError):
        raise _too_large(path, allowed)
    if isinstance(result, tuple):
        raise LogError(*result)
    recording: Recording = result
    # Made anew, because arrays lose their write protection on the way.
    return replace(recording, channels={name: replace(channel) for name, channel in recording.channels.items()})


def _too_slow(path: Path, seconds: float) -> LogError:
    return LogError(
        f"{path.name}: reading it takes longer than {seconds:.0f} s", "logs that are read faster",
        f"cut it into parts, or allow more time with {SECONDS}",
    )  # fmt: skip


def _too_large(path: Path, allowed: Limits, how: str = "") -> LogError:
    return LogError(
        f"{path.name}: reading it takes more than {allowed.memory} MiB of memory{how}", "logs that fit",
        f"cut it into parts or drop topics that are not needed, or allow more with {MEMORY}",
    )  # fmt: skip


def _child(path: Path, preset: str, columns: dict[str, str], memory: int, seconds: float) -> None:
    """What the child does: the answer goes to stdout, and whatever a library prints to stderr."""
    from quadid_replay.formats import read_here

    resource.setrlimit(resource.RLIMIT_DATA, (memory * _MIB, memory * _MIB))
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 5))
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)
        try:
            result: object = read_here(path, preset, columns)
            answer = pickle.dumps(result, pickle.HIGHEST_PROTOCOL)
        except QuadidError as error:
            answer = pickle.dumps((error.found, error.allowed, error.fix))
        except MemoryError:
            result = None
            answer = pickle.dumps(MemoryError())
        with contextlib.suppress(BrokenPipeError):  # the parent gave up
            out.write(answer)


if __name__ == "__main__":
    where, *rest = json.loads(sys.argv[1])
    _child(Path(where), *rest)
