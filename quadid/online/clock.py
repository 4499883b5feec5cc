"""Time of a live stream: one rising session time, led by the stamps of the gyro, which every row of the grid needs.

Other channels follow: their stamps are read in the gyro's time base and moved by nothing but the gyro.  One that is
further ahead of the gyro than any delay explains is refused; one that is late is left out when its rows are settled.
So no channel but the gyro decides what becomes of another's samples, and the gyro only with several stamps that agree.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from quadid.types import FloatArray

STEP_BACK = 1.0
"""A gyro stamp this far [s] before the newest one means a reboot or a clock step; less is late."""
STEP_AHEAD = 0.5
"""One this far [s] after the newest one is suspect: rows wait as long, so that a smaller step takes no sample away."""
AHEAD = 1.0
"""Other channels may be this far [s] ahead of the gyro: it comes later over a slower way, or some of it is lost."""
PAUSE_AHEAD = 30.0
"""A confirmed step ahead by no more than this [s] is a pause of the stream; any other begins a new time base."""
CONFIRMATIONS = 3
"""Further stamps that must agree before a step is believed: a single wild stamp moves nothing."""
PAUSE = 4.0
"""Session time [s] between the newest sample of one time base and the first of the next: more than rows look back on
(`resampler.HISTORY`) and followers run ahead."""
DAY = 86400.0
LARGEST = 1e11
"""Stamps beyond this [s] are no times."""
_BASES = 64
"""Newest time bases of which session times can be told as stamps."""
_SLICE = 256


class StreamClock:
    """Maps stamps [s] to session time [s], which counts from midnight of the gyro's first stamp and never runs back.

    Attributes:
        newest: newest session time of the gyro; minus infinity before its first sample.
        steps: number of time bases that began after the first (reboot, clock step).
        wild: gyro stamps refused because nothing confirmed them.
    """

    def __init__(self) -> None:
        self.newest = -math.inf
        self.steps = self.wild = 0
        self._bases: deque[tuple[float, float]] = deque([(-math.inf, 0.0)], maxlen=_BASES)
        self._suspects: list[float] = []

    def stamp(self, t: float) -> float:
        """The stamp that belongs to session time `t`, in the time base that held then."""
        shift = next((shift for start, shift in reversed(self._bases) if t >= start), self._bases[0][1])
        return t - shift

    def in_base(self, stamps: FloatArray) -> FloatArray:
        """Session times that stamps stand for in the present time base, shape (n,)."""
        return stamps + self._bases[-1][1]

    def began_in(self, after: float, until: float) -> bool:
        """Whether a time base began after one session time [s] and until another; the first one after all times."""
        return after == -math.inf or any(after < start <= until for start, _ in self._bases)

    def follow(self, stamps: FloatArray) -> FloatArray:
        """Session times of stamps of other channels, shape (n,); NaN for those too far ahead of the gyro."""
        t = self.in_base(stamps)
        return np.where(t <= self.newest + AHEAD, t, np.nan)

    def lead(self, stamps: FloatArray) -> FloatArray:
        """Session times of stamps of the gyro, shape (n,), in the order of arrival; NaN for those that are refused."""
        out = np.full(len(stamps), np.nan)
        at = 0
        while at < len(stamps):
            t = stamps[at : at + _SLICE] + self._bases[-1][1]
            reached = np.maximum.accumulate(np.concatenate([[self.newest], t]))[:-1]
            strange = ~((t > reached - STEP_BACK) & (t < reached + STEP_AHEAD))
            count = int(strange.argmax()) if strange.any() else len(t)
            if count:
                out[at : at + count] = t[:count]
                self.newest = max(self.newest, float(t[:count].max()))
                self.wild += len(self._suspects)
                self._suspects.clear()
            at += count
            if count < len(t):
                out[at] = self._suspect(float(stamps[at]))
                at += 1
        return out

    def _suspect(self, stamp: float) -> float:
        """Session time of a stamp that does not follow the one before: of the first ever, or once enough agree."""
        if not abs(stamp) <= LARGEST:
            self.wild += 1
            return math.nan
        if self.newest == -math.inf:
            self._bases[0] = (-math.inf, -math.floor(stamp / DAY) * DAY)
            self.newest = stamp + self._bases[0][1]
            return self.newest
        if self._suspects and abs(stamp - self._suspects[-1]) > STEP_AHEAD:
            self.wild += len(self._suspects)
            self._suspects.clear()
        self._suspects.append(stamp)
        if len(self._suspects) <= CONFIRMATIONS:
            return math.nan
        first, shift = min(self._suspects), self._bases[-1][1]
        self._suspects.clear()
        if not self.newest < first + shift <= self.newest + PAUSE_AHEAD:
            start = self.newest + PAUSE
            shift = start - first
            self._bases.append((start, shift))
            self.steps += 1
        self.newest = max(stamp + shift, self.newest)
        return stamp + shift
