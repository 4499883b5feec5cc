"""Time from untrusted logs: wraps undone, reboots and clock steps found, wild stamps refused.

A log has one `LogClock`; stamps are fed in file order and come back as recording time [s], which never starts over.
"""

from __future__ import annotations

import numpy as np

from quadid.types import BoolArray, FloatArray

STEP_BACK = 1.0
"""A stamp this far [s] before the newest one means a reboot or a clock step."""
STEP_AHEAD = 30.0
"""A stamp this far [s] after the newest one is suspect until others confirm it."""
CONFIRMATIONS = 3
"""How many further stamps must agree before a new time base is believed; a single wild stamp moves nothing."""
PAUSE = 1.0
"""Recording time [s] put between the last sample before a reboot and the first one after it."""


def _alone(raw: FloatArray) -> bool:
    """Tells whether the first stamp is far from the second and the next ones follow that: it is wild, no time base."""
    if len(raw) <= 1 + CONFIRMATIONS:
        return False
    steps = np.diff(raw[: 2 + CONFIRMATIONS])
    return not -STEP_BACK < steps[0] < STEP_AHEAD and bool(np.all(np.abs(steps[1:]) < STEP_BACK))


class WrapCounter:
    """Unwraps a counter of limited width, such as 32-bit microseconds (71.6 minutes).

    Args:
        period: value at which the counter starts over, in its own unit.
    """

    def __init__(self, period: float = 2.0**32) -> None:
        self._period = period
        self._turns = 0
        self._last: float | None = None

    def unwrap(self, raw: float) -> float:
        """Returns `raw` plus whole periods; a fall by more than half a period is a wrap, a smaller one is disorder."""
        if self._last is not None:
            if raw < self._last - 0.5 * self._period:
                self._turns += 1
            elif raw > self._last + 0.5 * self._period and self._turns > 0:
                return raw + (self._turns - 1) * self._period
        self._last = raw
        return raw + self._turns * self._period

    def unwrap_near(self, raw: float, reference: float) -> float:
        """Returns `raw` plus the whole periods that bring it closest to a `reference` of the same unit."""
        return raw + self._period * round((reference - raw) / self._period)


class LogClock:
    """Maps raw stamps [s] to recording time [s].

    Attributes:
        breaks: recording times across which nothing may be joined.
        reboots: number of time bases that ended by a step back.
        jumps: number of steps ahead.
        wild: number of stamps refused because nothing confirmed them.
    """

    def __init__(self) -> None:
        self.breaks: list[float] = []
        self.reboots = 0
        self.jumps = 0
        self.wild = 0
        self._offset = 0.0
        self._newest: float | None = None
        self._suspects: list[float] = []

    def time(self, raw: float) -> float | None:
        """Returns recording time, or None for a stamp that is refused or still waits for confirmation."""
        if raw != raw or raw in (float("inf"), float("-inf")):
            self.wild += 1
            return None
        if self._newest is None:
            self._newest = raw
            return raw
        if self._newest - STEP_BACK < raw < self._newest + STEP_AHEAD:
            self.wild += len(self._suspects)
            self._suspects.clear()
            self._newest = max(self._newest, raw)
            return raw + self._offset
        return self._suspect(raw)

    def times(self, raw: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Maps many stamps in file order; returns recording times (NaN where refused) and which were accepted."""
        if len(raw) and self._newest is None and bool(np.isfinite(raw).all()):
            newest = np.maximum.accumulate(raw)
            steps = raw[1:] - newest[:-1]
            if len(raw) < 2 or (steps.min() > -STEP_BACK and steps.max() < STEP_AHEAD):
                self._newest = float(newest[-1])
                return raw, np.ones(len(raw), dtype=np.bool_)
        first = 1 if self._newest is None and _alone(raw) else 0
        self.wild += first
        mapped = [None] * first + [self.time(float(stamp)) for stamp in raw[first:]]
        out = np.array([np.nan if t is None else t for t in mapped], dtype=np.float64)
        return out, np.isfinite(out)

    def in_order(self, raw: FloatArray) -> FloatArray:
        """Maps stamps as `time` does one by one; NaN where refused."""
        plain = self.plain_times(raw)
        if plain is not None:
            return plain
        times = [self.time(stamp) for stamp in raw.tolist()]
        return np.array([np.nan if t is None else t for t in times], dtype=np.float64)

    def plain_times(self, raw: FloatArray) -> FloatArray | None:
        """Maps stamps as `time` does one by one; None, and nothing has changed, unless all follow without a step."""
        if self._suspects or not len(raw) or not np.isfinite(raw).all():
            return None
        first = raw[0] if self._newest is None else self._newest
        newest = np.maximum.accumulate(np.concatenate([[first], raw]))
        before = newest[:-1]
        if not np.all((before - STEP_BACK < raw) & (raw < before + STEP_AHEAD)):
            return None
        self._newest = float(newest[-1])
        return raw + self._offset

    def _suspect(self, raw: float) -> float | None:
        """Collects stamps of a possible new time base and moves to it when enough agree."""
        if self._suspects and abs(raw - self._suspects[-1]) > STEP_BACK:
            self.wild += len(self._suspects)
            self._suspects.clear()
        self._suspects.append(raw)
        if len(self._suspects) <= CONFIRMATIONS:
            return None
        assert self._newest is not None
        base = min(self._suspects)
        if base < self._newest:
            self.reboots += 1
            end = self._newest + self._offset
            self._offset = end + PAUSE - base
            self.breaks.append(end + 0.5 * PAUSE)
        else:
            self.jumps += 1
            self.breaks.append(base + self._offset)
        self._newest = max(self._suspects)
        self._suspects.clear()
        return raw + self._offset

    def warnings(self) -> list[str]:
        """Says in sentences what was wrong with the log's time."""
        out = []
        if self.reboots:
            out.append(f"time starts over {self.reboots} times (reboot or clock step): nothing is joined across that")
        if self.jumps:
            out.append(f"time jumps ahead by over {STEP_AHEAD:g} s {self.jumps} times: nothing is joined across that")
        if self.wild:
            out.append(f"{self.wild} stamps that no neighbour confirms were dropped")
        return out
