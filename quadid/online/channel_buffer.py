"""Samples of one channel of a live stream, sorted by time."""

from __future__ import annotations

from collections import deque

import numpy as np

from quadid.rotation import continuous_sign
from quadid.types import FloatArray
from quadid.window import Channel


class ChannelBuffer:
    """Samples of one channel, sorted by time.

    Attributes:
        t, values: those sorted in, shapes (n,) and (n, columns).
        arrived: how many ever came.
        waiting: how many of them are not sorted in yet.
    """

    def __init__(self, columns: int) -> None:
        self.t = np.empty(0)
        self.values = np.empty((0, columns))
        self.arrived = 0
        self.waiting = 0
        self._chunks: deque[tuple[FloatArray, FloatArray]] = deque()
        self._single_t: list[float] = []
        self._single: list[tuple[float, ...]] = []

    def add(self, t: float, values: tuple[float, ...]) -> None:
        """Takes a sample in the order of arrival."""
        self._single_t.append(t)
        self._single.append(values)
        self.arrived += 1
        self.waiting += 1

    def extend(self, t: FloatArray, values: FloatArray) -> None:
        """Takes samples in the order of arrival: times, shape (n,), and values, shape (n, columns)."""
        self._gather()
        self._chunks.append((t, values))
        self.arrived += len(t)
        self.waiting += len(t)

    def restart(self, arrived: int) -> None:
        """Drops the first `arrived` samples that ever came."""
        self._take(arrived)
        self.t, self.values = self.t[:0], self.values[:0]

    def settle(self, oldest: float, arrived: int) -> tuple[int, int]:
        """Sorts in what is among the first `arrived` samples; returns how many of them were too late and doubles."""
        chunks = self._take(arrived)
        if not chunks:
            return 0, 0
        late = 0
        for k, (t, values) in enumerate(chunks):
            in_time = t >= oldest
            if not in_time.all():
                late += len(t) - int(np.count_nonzero(in_time))
                chunks[k] = t[in_time], values[in_time]
        t = np.concatenate([self.t, *(t for t, _ in chunks)])
        values = np.concatenate([self.values, *(v for _, v in chunks)])
        doubles = 0
        if np.any(t[1:] <= t[:-1]):
            order = np.argsort(t, kind="stable")
            t, values = t[order], values[order]
            keep = np.concatenate([[True], np.diff(t) > 0.0])
            doubles = len(t) - int(np.count_nonzero(keep))
            t, values = t[keep], values[keep]
        self.t, self.values = t, values
        return late, doubles

    def _take(self, arrived: int) -> list[tuple[FloatArray, FloatArray]]:
        """Takes what waits of the first `arrived` samples that ever came."""
        self._gather()
        count = self.waiting - (self.arrived - arrived)
        self.waiting -= max(count, 0)
        out = []
        while count > 0:
            t, values = self._chunks.popleft()
            if len(t) > count:
                self._chunks.appendleft((t[count:], values[count:]))
                t, values = t[:count], values[:count]
            out.append((t, values))
            count -= len(t)
        return out

    def _gather(self) -> None:
        """Makes a chunk of the samples that came one by one."""
        if self._single:
            self._chunks.append((np.array(self._single_t), np.array(self._single)))
            self._single_t, self._single = [], []

    def forget(self, before: float) -> None:
        """Drops samples before a time [s]."""
        first = int(np.searchsorted(self.t, before))
        if first:
            self.t, self.values = self.t[first:], self.values[first:]

    def between(self, name: str, a: float, b: float) -> Channel | None:
        """The samples in [a, b] as a channel; None when there are fewer than two."""
        low, high = int(np.searchsorted(self.t, a)), int(np.searchsorted(self.t, b, side="right"))
        if high - low < 2:
            return None
        values = self.values[low:high]
        return Channel(name, self.t[low:high], continuous_sign(values) if name == "attitude" else values, name)
