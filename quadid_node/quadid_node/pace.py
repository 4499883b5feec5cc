"""Whether the messages of a topic come evenly: by when they are there, and by their stamps."""

from __future__ import annotations

from collections import deque

import numpy as np

from quadid.types import FloatArray

QUIET = 0.25
"""Messages that come together after more than this [s] without any are a burst: half of what rows wait for."""
TOGETHER = 5
"""... of so many at least."""
AGAIN, MEMORY = 3, 10.0
"""So many bursts within this [s] are no accident.  What was wrong with a message is told for as long."""
STAMPS = 100
"""Newest stamps that are compared."""
GAP = 1.0
"""A step between stamps of more than this [s] is a pause."""
CLOSE, CROWDED = 0.2, 0.4
"""Stamps closer than this share of the mean step, and the share of them that even a random stream does not have."""


class Pace:
    """The pace of one topic.

    Attributes:
        looked: when somebody looked for its messages last [s].
    """

    def __init__(self) -> None:
        self.looked, self._quiet = 0.0, 0.0
        self._bursts: deque[tuple[float, int, float]] = deque(maxlen=AGAIN)
        self._stamps: deque[float] = deque(maxlen=STAMPS)

    def look(self, now: float, since: float, count: int) -> None:
        """Somebody looked for messages.

        Args:
            now: time of the look [s].
            since: of the look before [s].
            count: messages that were there.
        """
        self.looked = now
        if not count:
            self._quiet += now - since
            return
        if self._quiet > QUIET and count >= TOGETHER:
            self._bursts.append((now, count, self._quiet))
        self._quiet = 0.0

    def stamped(self, t: FloatArray) -> None:
        """Takes the stamps of messages [s], shape (n,)."""
        self._stamps.extend(t[-STAMPS:].tolist())

    @property
    def trouble(self) -> str:
        """How they bunch; empty where they do not."""
        if len(self._bursts) == AGAIN and self._bursts[0][0] > self.looked - MEMORY:
            _, count, quiet = self._bursts[-1]
            return f"comes in bursts: {count} messages at once after {quiet:.1f} s without one: send each when measured"
        steps = np.diff(np.sort(np.array(self._stamps)))
        steps = steps[steps < GAP]
        if len(steps) < STAMPS // 2:
            return ""
        close = int(np.count_nonzero(steps < CLOSE * steps.mean()))
        if close < CROWDED * len(steps):
            return ""
        return f"stamped in bursts: {close} of {len(steps)} follow at once on the one before: stamp when measured"
