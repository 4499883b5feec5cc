"""Child process that fits beside the service, and inline fits for replays.

The child is this module run as a program (`python -m quadid_node.worker MEBIBYTES`): it lowers its priority, leaves a
core to others, bounds its memory, warms the kernels, says that it is ready, and ends when its input ends.  Requests and
replies are pickles.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from quadid.online.records import UNEXPECTED, Job, JobReply
from quadid.vehicle import Vehicle
from quadid_node.process import THREADS

# --- Whether a child that starts gets anywhere: compiling may take long on a slow machine, standing still may not


STILL = 180.0
"""A child that is not ready and has not worked for so long [s] is given up,"""
STEP = 1.0
"""... less than this [s of the processor] being no work: a child that hangs still wakes up now and then,"""
WORK = 600.0
"""... and so is one that has worked for so long [s of the processor]; compiling takes a minute or two of it."""


class WarmUp:
    """Watches one child until it is ready."""

    def __init__(self, pid: int, clock: Callable[[], float]) -> None:
        """Begins to watch the process `pid`; `clock` returns seconds."""
        self._pid, self._clock = pid, clock
        self._used, self._moved = 0.0, clock()

    def given_up(self) -> str:
        """Reason why the child is given up; empty while it may go on."""
        now, used = self._clock(), processor_seconds(self._pid)
        if used is not None and used >= self._used + STEP:
            self._used, self._moved = used, now
        if now - self._moved > STILL:
            return f"not ready, and idle for {STILL:g} s"
        return f"not ready after {WORK:g} s of work" if (used or 0.0) > WORK else ""


def processor_seconds(pid: int) -> float | None:
    """Processor time that a process has used [s]; None where the system does not tell (other than Linux)."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError):
        return None


# --- Where fits run: a child process beside the service, or inline for replays
#
# The child is polled, never waited for.  One that dies, hangs or eats its memory is replaced after a growing pause, and
# the request that it had, or that waits for it, goes to the next one; after three the session is informed.


FIT_LIMIT = 30.0
"""A fit that takes longer [s] counts as hung,"""
STUDY_LIMIT = 600.0
"""... and a diagnosis."""
TRIES = 3
"""Workers that may fail on one request, or while it waits for one to be ready, before it is given up."""
BACKOFF = (0.2, 1.0, 5.0, 20.0, 60.0)
"""Pauses before the next start [s], by failures in a row."""
CALM = 60.0
"""Failures this long ago [s] are forgiven."""
MEMORY_MB = 1000
NICE = 15
READY = "ready"
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Trouble:
    """Message about the worker for people: level (warning, error, info) and a sentence."""

    level: str
    text: str


class InlineWorker:
    """Fits in the caller's own process, when polled: for replays, where only the result matters."""

    ready, state, restarts = True, "inline", 0

    def __init__(self) -> None:
        self._waiting: list[Job] = []

    def submit(self, request: Job) -> None:
        """Takes a request, to be fitted by the next `poll`."""
        self._waiting.append(request)

    def poll(self) -> list[JobReply | Trouble]:
        """Does all fits that wait."""
        waiting, self._waiting = self._waiting, []
        return [job.run() for job in waiting]

    def sibling(self) -> InlineWorker:
        """Another one, for diagnoses, which take longer than fits may wait."""
        return InlineWorker()

    def close(self) -> None:
        """Nothing to end."""


class ProcessWorker:
    """Fits in a child process of low priority.

    Attributes:
        restarts: how often a child was replaced.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        memory_mb: int = MEMORY_MB,
        clock: Callable[[], float] = time.monotonic,
        name: str = "fit",
        limit: float = FIT_LIMIT,
    ) -> None:
        """Starts the child; `ready` is True once its kernels are warm.

        Args:
            memory_mb: most memory of the child [MiB]; 0 for no limit.
            name: what it is called in messages.
            limit: a request that takes longer [s] counts as hung.
        """
        self._vehicle, self._memory, self._clock = vehicle, memory_mb, clock
        self._name, self._limit = name, limit
        self._child: subprocess.Popen[bytes] | None = None
        self._asked, self._heard = SimpleQueue[Any](), SimpleQueue[Any]()
        self._request: Job | None = None
        self._tries = self._failures = self.restarts = 0
        self._since = self._last_failure = -1e9
        self._out: list[JobReply | Trouble] = []
        self._state = "starting"
        self._start()

    @property
    def state(self) -> str:
        """One word for monitors: ``starting``, ``idle``, ``busy``, ``resting`` (before a restart) or ``closed``."""
        return self._state

    @property
    def ready(self) -> bool:
        """Checks whether kernels are warm and a fit can begin at once."""
        return self._state in ("idle", "busy")

    @property
    def pid(self) -> int:
        """Process id of the child; 0 while there is none."""
        return self._child.pid if self._child is not None else 0

    def submit(self, request: Job) -> None:
        """Gives the child a request, or keeps it until there is a child that can take it."""
        self._request, self._tries = request, 0
        if self._state == "idle":
            self._give()

    def poll(self) -> list[JobReply | Trouble]:
        """Takes answers, checks on the child, restarts it when it is time; never blocks."""
        if self._state == "resting" and self._clock() >= self._since:
            self._start()
        if self._child is not None:
            self._receive()
            if why := self._failure(self._child):
                self._replace(why, self._child.poll() is not None)
        out, self._out = self._out, []
        return out

    def sibling(self) -> ProcessWorker:
        """A child of its own for diagnoses."""
        return ProcessWorker(self._vehicle, self._memory, self._clock, "diagnosis", STUDY_LIMIT)

    def close(self) -> None:
        """Ends the child."""
        self._end_child()
        self._state = "closed"

    # --- the child

    def _start(self) -> None:
        environment = {**os.environ, **dict.fromkeys(THREADS, "1")}
        self._child = subprocess.Popen(
            [sys.executable, "-P", "-m", "quadid_node.worker", str(self._memory)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        self._asked, self._heard = SimpleQueue(), SimpleQueue()
        self._asked.put(self._vehicle)
        talk = (self._child, self._asked, self._heard)
        threading.Thread(target=_talk, args=talk, name=self._name, daemon=True).start()
        self._state, self._since = "starting", self._clock()
        self._warm_up = WarmUp(self._child.pid, self._clock)

    def _give(self) -> None:
        self._asked.put(self._request)
        self._state, self._since = "busy", self._clock()

    def _receive(self) -> None:
        """Takes answers, and gives the child what waits for it."""
        while not self._heard.empty():
            item, self._state = self._heard.get(), "idle"
            if item != READY:
                self._out.append(item)
                if self._request is not None and item.number == self._request.number:
                    self._request = None  # else: asked while this one took too long
            if self._request is not None:
                self._give()
        if self._failures and self._clock() - self._last_failure > CALM and self._state == "idle":
            self._failures = 0

    def _failure(self, child: subprocess.Popen[bytes]) -> str:
        """Why the child is of no use any more; empty while it is."""
        code = child.poll()
        if code is not None:
            return f"ended by signal {-code}" if code < 0 else f"ended with code {code}"
        if self._state == "starting":
            return self._warm_up.given_up()
        hangs = self._state == "busy" and self._clock() - self._since > self._limit
        return f"hung for {self._limit:g} s" if hangs else ""

    def _replace(self, why: str, died: bool) -> None:
        """Ends the child, the next one starts after a pause; its request is kept, or given up after some tries."""
        self._end_child()
        pause = BACKOFF[min(self._failures, len(BACKOFF) - 1)]
        self._failures, self.restarts = self._failures + 1, self.restarts + 1
        self._last_failure = self._clock()
        self._state, self._since = "resting", self._clock() + pause
        self._out.append(Trouble("warning", f"the {self._name} process {why}; the next one starts in {pause:g} s"))
        self._tries += 1
        if self._request is not None and self._tries >= TRIES:
            problem = f"{TRIES} {self._name} processes failed before this window was done (the last one {why})"
            problem = UNEXPECTED + problem if died else problem
            self._out += [self._request.failed(problem), Trouble("error", problem)]
            self._request = None

    def _end_child(self) -> None:
        child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        child.wait()
        self._asked.put(None)


Worker = InlineWorker | ProcessWorker
"""Who fits for a service."""


def _talk(child: subprocess.Popen[bytes], asked: SimpleQueue[Any], heard: SimpleQueue[Any]) -> None:
    """Gives a child one item after another and takes its answers, until it ends; a thread may wait for it."""
    assert child.stdin is not None
    assert child.stdout is not None
    with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError), child.stdout, child.stdin:
        while (item := asked.get()) is not None:
            pickle.dump(item, child.stdin, pickle.HIGHEST_PROTOCOL)
            child.stdin.flush()
            heard.put(pickle.load(child.stdout))


def main() -> None:
    """Serves requests until the input ends: the child."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever prints must not end up between replies
    requests = os.fdopen(os.dup(0), "rb")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Lowers priority, leaves the first core to others, bounds memory.
    os.nice(NICE)
    if hasattr(os, "sched_getaffinity") and len(cores := sorted(os.sched_getaffinity(0))) > 1:
        os.sched_setaffinity(0, cores[1:])
    if sys.platform.startswith("linux"):  # dies with its parent even while kernels compile and nobody reads the input
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if limit := int(sys.argv[1]) << 20:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from quadid.online.fit_job import warm_up  # the parent needs no kernels

    def answer(item: object) -> None:
        pickle.dump(item, answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()

    try:
        warm_up(pickle.load(requests))
        answer(READY)
        while True:
            answer(pickle.load(requests).run())
    except (EOFError, pickle.UnpicklingError):  # the parent has ended
        return
    except MemoryError:
        sys.exit("the fit process needs more memory than it may have")  # one line; the parent says what follows


if __name__ == "__main__":
    main()
