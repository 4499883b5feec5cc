"""What a service does again and again, cut into pieces and done in steps that keep nobody waiting for long.

A round takes all messages that wait, reads them, works on them, and reports now and then.  Fewer rounds with more
messages each cost less of the processor; short steps keep services and timers from waiting for a whole round.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

STEP_SECONDS = 0.0125
"""A step is taken this often [s]."""
STEPS = 8
"""Steps from the beginning of a round to that of the next."""
ROUND_SECONDS = STEPS * STEP_SECONDS
"""Messages are taken from the middleware this often [s]: rows of the grid wait five times as long for late channels."""
WORK_SECONDS = 0.0015
"""No piece of a round begins later than this in a step [s]."""


class Scheduler:
    """Does one round after the other."""

    def __init__(self, begin: Callable[[], Iterator[None]], clock: Callable[[], float] = time.monotonic) -> None:
        """Starts with a round that is due.

        Args:
            begin: begins a round; it is done to the end piece by piece.
            clock: seconds, monotonic.
        """
        self._begin, self._clock = begin, clock
        self._round: Iterator[None] | None = None
        self._steps = STEPS

    @property
    def overdue(self) -> bool:
        """Whether the round lasts twice as long as it should, and work that can wait should be left to the next."""
        return self._steps >= 2 * STEPS

    @property
    def resting(self) -> bool:
        """Whether there is nothing to do until the next round."""
        return self._round is None and self._steps + 1 < STEPS

    def step(self, seconds: float = WORK_SECONDS) -> None:
        """Goes on with the round, or begins the next one when its time has come.

        Args:
            seconds: no piece begins later than this [s]; one always does.
        """
        end = self._clock() + seconds
        self._steps += 1
        if self._round is None:
            if self._steps < STEPS:
                return
            self._round, self._steps = self._begin(), 0
        for _ in self._round:
            if self._clock() >= end:
                return
        self._round = None

    def drop(self) -> None:
        """Forgets the round that is being done."""
        self._round = None
