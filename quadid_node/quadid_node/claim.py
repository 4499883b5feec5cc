"""The right to publish the parameter sets of one vehicle: who comes second observes until the first is gone."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

FOUND_WITHIN = 1.0
"""Others are found by then [s]."""
YOUNG = 10.0
"""Two that claimed at once, within this time [s], both let go, and try again after pauses of different length."""
PAUSES = (0.5, 4.0)


class Claim:
    """One topic that one service may publish on.

    Attributes:
        publisher: ours; None while another one is there.
        problem: what is wrong, or empty.
    """

    def __init__(
        self, count: Callable[[], int], create: Callable[[], Any], destroy: Callable[[Any], Any],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """Claims nothing yet.

        Args:
            count: publishers on the topic, ours included.
            create: makes our publisher; destroy: takes it away.
            clock: seconds, monotonic.
        """
        self._count, self._create, self._destroy, self._clock = count, create, destroy, clock
        self._not_before, self._since = clock() + FOUND_WITHIN, 0.0
        self.publisher: Any = None
        self.problem = ""

    def step(self) -> bool:
        """Looks who is there; returns True when the topic has just become ours."""
        now = self._clock()
        others = self._count() - (self.publisher is not None)
        if self.publisher is None:
            if others > 0:
                self._wait(now)
            elif now >= self._not_before:
                self.publisher, self._since, self.problem = self._create(), now, ""
                return True
        elif others > 0 and now - self._since < YOUNG:
            self.let_go()
            self._wait(now)
        elif others > 0:
            self.problem = "someone else publishes parameter sets on our topic: check sequence and log_hash"
        else:
            self.problem = ""
        return False

    def let_go(self) -> None:
        """Takes our publisher away."""
        if self.publisher is not None:
            self._destroy(self.publisher)
            self.publisher = None

    def _wait(self, now: float) -> None:
        self._not_before = now + random.uniform(*PAUSES)
        self.problem = "another service publishes parameter sets here: this one observes until that one is gone"
