"""The right to publish the parameter sets of one vehicle: who comes second observes until the first is gone."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from typing import Any

FOUND_WITHIN = 4.0
"""Others are found by then [s]: Fast DDS announces a participant every 3 s, and half of the starts measured found a
service that ran already only by its next announcement (up to 2.9 s)."""
YOUNG = 10.0
"""Two that claimed at once, within this time [s], both let go, and try again after pauses of different length."""
PAUSES = (0.5, 4.0)
"""Least and most of such a pause [s]."""
OBSERVES = "another service publishes parameter sets here: this one observes until that one is gone"
BESIDE = "another service publishes parameter sets too: one of the two stops in a moment"
STRANGER = "someone else publishes parameter sets on our topic: check sequence and log_hash"


class Claim:
    """One topic that one service may publish on.

    Attributes:
        publisher: ours; None while another one is there.
        problem: what is wrong, or empty.
    """

    def __init__(
        self, count: Callable[[], int], kin: Callable[[], int], create: Callable[[], Any],
        destroy: Callable[[Any], Any], clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """Claims nothing yet.

        Args:
            count: publishers on the topic, ours included.
            kin: those of them that are services like this one, ours included.
            create: makes our publisher; destroy: takes it away.
            clock: seconds, monotonic.
        """
        self._count, self._kin, self._create, self._destroy, self._clock = count, kin, create, destroy, clock
        self._not_before, self._since = clock() + FOUND_WITHIN, 0.0
        self._leaves = math.inf
        self.publisher: Any = None
        self.problem = ""

    def step(self, wanted: bool = True) -> bool:
        """Looks who is there; returns True when the topic has just become ours.

        Args:
            wanted: False while nothing is to be published yet: only looks.
        """
        now = self._clock()
        others = self._count() - (self.publisher is not None)
        if self.publisher is None:
            if others > 0:
                self._wait(now)
            elif not wanted:
                self.problem = ""
            elif now >= self._not_before:
                self.publisher, self._since, self.problem = self._create(), now, ""
                return True
        elif others > 0:
            self._beside(now)
        else:
            self.problem, self._leaves = "", math.inf
        return False

    def _beside(self, now: float) -> None:
        """Gives way at once while young; later only to a service, each after a pause of its own: one of them stays."""
        if now - self._since >= YOUNG and self._kin() < 2:
            self.problem, self._leaves = STRANGER, math.inf
        elif now - self._since >= YOUNG and now < self._leaves:
            self.problem = BESIDE
            if math.isinf(self._leaves):
                self._leaves = now + random.uniform(*PAUSES)
        else:
            self.let_go()
            self._wait(now)

    def let_go(self) -> None:
        """Takes our publisher away."""
        if self.publisher is not None:
            self._destroy(self.publisher)
            self.publisher, self._leaves = None, math.inf

    def _wait(self, now: float) -> None:
        self._not_before = now + random.uniform(*PAUSES)
        self.problem = OBSERVES
