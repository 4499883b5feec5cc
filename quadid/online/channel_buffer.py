"""Samples of one channel of a live stream: those that wait in the order of arrival, and those sorted by time."""

from __future__ import annotations

from collections import deque

import numpy as np

from quadid.rotation import continuous_sign
from quadid.types import FloatArray
from quadid.window import Channel


class ChannelBuffer:
    """Samples of one channel.

    Attributes:
        t, values: those sorted in, shapes (n,) and (n, columns).
        waiting: how many are not sorted in yet.
        taken: how many ever were, late ones and doubles included.
    """

    def __init__(self, columns: int) -> None:
        self.t = np.empty(0)
        self.values = np.empty((0, columns))
        self.waiting = self.taken = 0
        self._chunks: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque()

    def add(self, reached: FloatArray, t: FloatArray, values: FloatArray) -> None:
        """Takes samples in the order of arrival.

        Args:
            reached: time that the stream had reached before each [s], never falling, shape (n,).
            t: times of the samples [s], shape (n,).
            values: shape (n, columns).
        """
        if len(t):
            self._chunks.append((reached, t, values))
            self.waiting += len(t)

    def settle(self, oldest: float, before: float, since: float = -np.inf) -> tuple[int, int]:
        """Sorts in what came before the stream reached `before` [s]; returns how many were too late, and doubles.

        Args:
            oldest: earlier samples [s] are too late.
            before: see above.
            since: what came before the stream had passed this [s] belongs to an earlier stretch, and is not late.
        """
        chunks = self._take(before)
        if not chunks:
            return 0, 0
        reached, t, values = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
        in_time = t >= oldest
        late = int(np.count_nonzero(~in_time & (reached > since)))
        t, values = np.concatenate([self.t, t[in_time]]), np.concatenate([self.values, values[in_time]])
        doubles = 0
        if np.any(t[1:] <= t[:-1]):
            order = np.argsort(t, kind="stable")
            t, values = t[order], values[order]
            keep = np.concatenate([[True], np.diff(t) > 0.0])
            doubles = len(t) - int(np.count_nonzero(keep))
            t, values = t[keep], values[keep]
        self.t, self.values = t, values
        return late, doubles

    def _take(self, before: float) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        out = []
        while self._chunks and self._chunks[0][0][0] < before:
            reached, t, values = self._chunks.popleft()
            count = int(np.searchsorted(reached, before))
            if count < len(t):
                self._chunks.appendleft((reached[count:], t[count:], values[count:]))
            out.append((reached[:count], t[:count], values[:count]))
            self.waiting -= count
            self.taken += count
        return out

    def forget(self, before: float) -> None:
        """Drops sorted samples before a time [s]."""
        first = int(np.searchsorted(self.t, before))
        if first:
            self.t, self.values = self.t[first:], self.values[first:]

    def between(self, name: str, a: float, b: float) -> Channel | None:
        """The samples in [a, b) as a channel; None when there are fewer than two."""
        low, high = int(np.searchsorted(self.t, a)), int(np.searchsorted(self.t, b))
        if high - low < 2:
            return None
        values = self.values[low:high]
        return Channel(name, self.t[low:high], continuous_sign(values) if name == "attitude" else values, name)
