"""Time of a live stream: one rising session time out of stamps that may start over, jump, or be garbage."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from quadid.types import FloatArray

STEP_BACK = 1.0
"""A stamp this far [s] before the newest one of its channel means a reboot or a clock step; one that is only behind
other channels is late."""
STEP_AHEAD = 30.0
"""A stamp this far [s] after the newest one is suspect until others confirm it."""
CONFIRMATIONS = 3
"""Further stamps that must agree before a new time base is believed: a single wild stamp moves nothing."""
PAUSE = 1.0
"""Session time [s] between the last sample before a step and the first one after it."""
DAY = 86400.0
LARGEST = 1e11
"""Stamps beyond this [s] are no times."""


class StreamClock:
    """Maps stamps [s] to session time [s], which counts from midnight of the first stamp and never runs back.

    Attributes:
        newest: newest session time seen; minus infinity before the first sample.
        steps: times at which a new time base began (reboot, clock step).
        wild: stamps refused because nothing confirmed them.
    """

    def __init__(self) -> None:
        self.newest = -math.inf
        self.steps: list[float] = []
        self.wild = 0
        self._shift = 0.0
        self._suspects: list[float] = []
        self._newest_of: dict[str, float] = {}

    def stamp(self, t: float) -> float:
        """The stamp that belongs to session time `t` in the present time base."""
        return t - self._shift

    def time(self, stamp: float, channel: str) -> float | None:
        """Session time of a channel's stamp; None for one that is refused or waits for confirmation."""
        if not abs(stamp) <= LARGEST:
            self.wild += 1
            return None
        if self.newest == -math.inf:
            self._shift = -math.floor(stamp / DAY) * DAY
            self.note(stamp + self._shift, (channel,))
            return self.newest
        t = stamp + self._shift
        if self._earliest(channel) < t < self.newest + STEP_AHEAD:
            if self._suspects:
                self.wild += len(self._suspects)
                self._suspects.clear()
            self.note(t, (channel,))
            return t
        return self._suspect(stamp, channel)

    def note(self, newest: float, channels: Iterable[str]) -> None:
        """Takes note of a session time [s] that these channels have reached."""
        self.newest = max(self.newest, newest)
        for channel in channels:
            self._newest_of[channel] = max(newest, self._newest_of.get(channel, -math.inf))

    def plain(self, stamps: FloatArray, channels: Iterable[str]) -> FloatArray | None:
        """Session times of stamps, shape (n,), where every one simply follows; None where `time` must look at each.

        Nothing is noted.
        """
        if self.newest == -math.inf or self._suspects or not (np.abs(stamps) <= LARGEST).all():
            return None
        t = stamps + self._shift
        low, high = float(t.min()), float(t.max())
        earliest = max([high - STEP_BACK, *(self._earliest(channel) for channel in channels)])
        return t if earliest < low and high < self.newest + STEP_AHEAD else None

    def _earliest(self, channel: str) -> float:
        """Session time after which a stamp of a channel is no step back."""
        known = self._newest_of.get(channel)
        return self.newest - STEP_AHEAD if known is None else known - STEP_BACK

    def _suspect(self, stamp: float, channel: str) -> float | None:
        """Collects stamps of a possible new time base and moves to it when enough agree."""
        if self._suspects and abs(stamp - self._suspects[-1]) > STEP_BACK:
            self.wild += len(self._suspects)
            self._suspects.clear()
        self._suspects.append(stamp)
        if len(self._suspects) <= CONFIRMATIONS:
            return None
        start = self.newest + PAUSE
        self._shift = start - min(self._suspects)
        self.steps.append(start)
        self._suspects.clear()
        self._newest_of.clear()
        self.newest = start
        t = stamp + self._shift
        self.note(t, (channel,))
        return t
