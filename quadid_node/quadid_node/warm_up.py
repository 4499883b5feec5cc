"""Whether a child that starts gets anywhere: compiling may take long on a slow machine, standing still may not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

STILL = 180.0
"""A child that is not ready and has not worked for so long [s] is given up,"""
STEP = 1.0
"""... less than this [s of the processor] being no work: a child that hangs still wakes up now and then,"""
WORK = 600.0
"""... and so is one that has worked for so long [s of the processor]; compiling takes a minute or two of it."""


class WarmUp:
    """Watches one child until it is ready."""

    def __init__(self, pid: int, clock: Callable[[], float]) -> None:
        """Begins to watch the process `pid`; `clock` tells seconds."""
        self._pid, self._clock = pid, clock
        self._used, self._moved = 0.0, clock()

    def given_up(self) -> str:
        """Why the child is given up; empty while it may go on."""
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
