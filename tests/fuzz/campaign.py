"""Runs numbered mutated inputs through `open_log`, each under a time and a memory guard, and judges what comes out.

Input number n of a format is the same on every machine: it is drawn with the random seed n.  Allowed are a recording
that keeps the promises of a recording, or a `QuadidError` in one line.  Everything else is a finding.
"""

from __future__ import annotations

import resource
import signal
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from types import FrameType
from typing import NamedTuple

import numpy as np
from quadid_replay import open_log

from quadid.errors import QuadidError
from quadid.window import Recording
from tests.fuzz.formats import FORMATS, mutated
from tests.fuzz.seeds import seeds

SECONDS, SECONDS_PER_BYTE = 0.5, 3e-6
"""Time guard of one input [s of CPU]: so much, and so much for each of its bytes; a few kB take milliseconds."""
GROWTH = 64 << 20
"""Memory guard: the process may not grow by more than this [bytes] over one input …"""
LIMIT = 1 << 30
"""… nor may it ever take this much more [bytes] than it had when the run began."""


class Finding(NamedTuple):
    """One input that broke a promise: its number, what happened in one line, and where."""

    number: int
    what: str
    trace: str


class Outcome(NamedTuple):
    """Result of a range of inputs: read, refused with a documented error, findings, seconds of this process, and the
    largest share of its allowed time that an input took."""

    read: int
    refused: int
    findings: tuple[Finding, ...]
    seconds: float
    slowest: float


def allowed_seconds(size: int) -> float:
    """Processor time that an input of this size [bytes] may take [s]."""
    return SECONDS + SECONDS_PER_BYTE * size


class _TooSlowError(BaseException):
    """Raised by the time guard; no reader can mistake it for an error of its own."""


def _expired(number: int, frame: FrameType | None) -> None:
    raise _TooSlowError("more time than its size allows")


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


def _peak_of_memory(since_now: bool = False) -> int:
    """Most resident memory [bytes] so far, or since the last call with `since_now` (Linux counts anew then)."""
    if since_now:
        Path("/proc/self/clear_refs").write_bytes(b"5")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def judge(path: Path) -> tuple[bool, str, str]:
    """Opens a log under the guards: whether it was read, what broke in one line (nothing: all well), and where."""
    before = _peak_of_memory(since_now=True)
    try:
        signal.setitimer(signal.ITIMER_PROF, allowed_seconds(path.stat().st_size))
        try:
            read, what, where = _attempt(path)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
    except _TooSlowError as error:
        read, what, where = False, str(error), traceback.format_exc(limit=-6)
    grown = _peak_of_memory() - before
    if not what and grown > GROWTH:
        what = f"{grown >> 20} MiB more memory for {path.stat().st_size} bytes"
    return read, what, where


def _attempt(path: Path) -> tuple[bool, str, str]:
    try:
        return True, broken_promise(open_log(path)), ""
    except QuadidError as error:
        wordy = "\n" in str(error) or len(str(error)) > 2000 or not error.found
        return False, f"an error that is not one short line: {str(error)[:80]!r}" if wordy else "", ""
    except Exception as error:  # noqa: BLE001 - whatever it is, it is the finding
        return False, f"{type(error).__name__}: {str(error)[:120]}", traceback.format_exc(limit=-6)


def run(kind: str, first: int, count: int) -> Outcome:
    """Tries inputs `first` to `first + count` of a format."""
    began = time.process_time()
    old = signal.signal(signal.SIGPROF, _expired)
    shared = Path("/dev/shm")
    read, refused, slowest = 0, 0, 0.0
    findings = []
    try:
        scratch = tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None)
        with scratch as folder, memory_limit(), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # numpy's word for numbers that went wrong unnoticed
            path = Path(folder) / "log"
            path.write_bytes(FORMATS[kind].finish(seeds(kind)[0]))
            judge(path)  # imports what the reader needs
            for number in range(first, first + count):
                path.write_bytes(input_of(kind, number))
                start = time.process_time()
                good, what, where = judge(path)
                slowest = max(slowest, (time.process_time() - start) / allowed_seconds(path.stat().st_size))
                read, refused = read + good, refused + (not good and not what)
                if what:
                    findings.append(Finding(number, what, where))
    finally:
        signal.signal(signal.SIGPROF, old)
    return Outcome(read, refused, tuple(findings), time.process_time() - began, slowest)
