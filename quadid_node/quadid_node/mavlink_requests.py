"""Which messages to ask a vehicle for, and which it has refused: these are asked for no more."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

REPEAT = 10.0
"""Messages that do not come as asked are asked for again after this long [s],"""
MOST_TRIES = 4
"""... so many times in all,"""
ANSWER = 1.0
"""... from the second time on one by one, this long [s] apart: an answer does not say which message it is about."""


class Requests:
    """Requests for messages of one vehicle."""

    def __init__(self) -> None:
        self._tries: Counter[str] = Counter()
        self._refused: dict[str, str] = {}
        self._queue: list[str] = []
        self._asked: str | None = None
        self._asked_at = self._round_at = -1e9

    @property
    def denied(self) -> tuple[str, ...]:
        """Messages that the vehicle refuses, each with its answer."""
        return tuple(f"{name} ({answer})" for name, answer in sorted(self._refused.items()))

    def due(self, lacking: Sequence[str], now: float) -> list[str]:
        """The messages to ask for now [s], of those that do not come."""
        first = not self._tries
        if now - self._round_at >= REPEAT:
            self._round_at = now
            self._queue = [n for n in lacking if n not in self._refused and self._tries[n] < MOST_TRIES]
        if not first and (now - self._asked_at < ANSWER or not self._queue):
            return []
        many, self._queue = (self._queue, []) if first else (self._queue[:1], self._queue[1:])
        self._tries.update(many)
        self._asked, self._asked_at = None if first or not many else many[0], now
        return many

    def answered(self, refusal: str) -> None:
        """The vehicle's answer to what was asked last; empty when it accepts."""
        if self._asked is not None and refusal:
            self._refused[self._asked] = refusal
        self._asked = None
