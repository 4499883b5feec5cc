"""Runs numbered mutated inputs through the readers, each under a guard of time and memory, and judges what comes out.

Input number n of a format is the same on every machine: it is drawn with the random seed n.  Allowed are a recording
that keeps the promises of a recording, a `QuadidError` in one line, and that the guard stops the reader, as the process
in which `open_log` reads would be.  Everything else is a finding.  Readers run in this process, for speed.
"""

import resource
import signal
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from types import FrameType
from typing import NamedTuple

import numpy as np
from quadid_replay.formats import read_here

from quadid.data.window import Recording
from quadid.errors import QuadidError
from tests.fuzz.formats import FORMATS, mutated
from tests.fuzz.seeds import seeds

SECONDS = 0.5
"""Time guard of one input [s of CPU]; a few kB take milliseconds."""
LIMIT = 1 << 30
"""Memory guard: the process never takes more than this [bytes] beyond what it had when the run began."""


class Finding(NamedTuple):
    """One input that broke a promise: its number, what happened in one line, and where."""

    number: int
    what: str
    trace: str


class Outcome(NamedTuple):
    """Result of a range of inputs: read, refused with a documented error, stopped by a guard, findings, and seconds of
    this process."""

    read: int
    refused: int
    stopped: int
    findings: tuple[Finding, ...]
    seconds: float


class _TooSlowError(BaseException):
    """Raised by the time guard; no reader can mistake it for an error of its own."""


def _expired(number: int, frame: FrameType | None) -> None:
    raise _TooSlowError


def _data() -> int:
    """Data this process has mapped [bytes], which is what RLIMIT_DATA counts: much of it was never touched."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return next(int(line.split()[1]) << 10 for line in status.splitlines() if line.startswith("VmData:"))


@contextmanager
def memory_limit() -> Iterator[None]:
    """Limits the data of this process to `LIMIT` bytes more than it has: a long test session has mapped much before."""
    old = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (_data() + LIMIT, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, old)


def input_of(kind: str, number: int) -> bytes:
    """The mutated input with this number."""
    return mutated(Random(number * 8 + zlib.crc32(kind.encode()) % 8), kind, seeds(kind))


def broken_promise(recording: Recording) -> str:
    """Says which promise of a recording is broken, or nothing."""
    if not recording.channels:
        return "a recording without channels"
    for name, channel in recording.channels.items():
        if len(channel.t) == 0:
            return f"{name}: no sample"
        if not (np.isfinite(channel.values).all() and np.isfinite(channel.t).all()):
            return f"{name}: values or times that are no numbers"
        if len(channel.t) > 1 and not bool((channel.t[1:] > channel.t[:-1]).all()):
            return f"{name}: time does not rise"
    return next((f"a warning of several lines: {w[:80]!r}" for w in recording.warnings if "\n" in w), "")


def judge(path: Path) -> tuple[str, str, str]:
    """Reads a log under the guards: read, refused, stopped or finding; what broke in one line, and where."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        broken = broken_promise(read_here(path, "auto"))
        return ("finding", broken, "") if broken else ("read", "", "")
    except QuadidError as error:
        wordy = "\n" in str(error) or len(str(error)) > 2000 or not error.found
        return (
            ("finding", f"an error that is not one short line: {str(error)[:80]!r}", "")
            if wordy
            else ("refused", "", "")
        )
    except (_TooSlowError, MemoryError):
        return "stopped", "", ""
    except Exception as error:  # noqa: BLE001 - whatever it is, it is the finding
        return "finding", f"{type(error).__name__}: {str(error)[:120]}", traceback.format_exc(limit=-6)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def run(kind: str, first: int, count: int) -> Outcome:
    """Tries inputs `first` to `first + count` of a format."""
    began = time.process_time()
    old = signal.signal(signal.SIGPROF, _expired)
    shared = Path("/dev/shm")
    ends: Counter[str] = Counter()
    findings = []
    try:
        scratch = tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None)
        with scratch as folder, memory_limit(), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # numpy's word for numbers that went wrong unnoticed
            path = Path(folder) / "log"
            path.write_bytes(FORMATS[kind].finish(seeds(kind)[0]))
            read_here(path, "auto")  # imports what the reader needs
            for number in range(first, first + count):
                path.write_bytes(input_of(kind, number))
                end, what, where = judge(path)
                ends[end] += 1
                if end == "finding":
                    findings.append(Finding(number, what, where))
    finally:
        signal.signal(signal.SIGPROF, old)
    seconds = time.process_time() - began
    return Outcome(ends["read"], ends["refused"], ends["stopped"], tuple(findings), seconds)
