"""Times of messages without a stamp of their own, from the stamped ones around them.

An autopilot writes its messages in order, so a message without a stamp was written between the stamped ones before and
after it.  The link only shows how long after the earlier one it came; nothing older than that one counts, so neither a
slow drift of the receiver's clock nor a simulation that runs faster than time moves it.  Who reads late knows only
after when a message came, and that counts: no lag of his moves it into the next round.  Messages of one moment come one
after the other, and a slow or shared link draws them out: each of them shows how late the link is by then.
"""

from __future__ import annotations

from typing import Generic, TypeAlias, TypeVar

T = TypeVar("T")

FARTHEST = 1.0
"""A message that comes more than this [s] after the last stamped one has no known time."""
MOMENT = 1e-3
"""Stamps no farther apart than this [s] are of one moment: some messages count milliseconds, others microseconds."""
MOST_WAITING = 4096
"""Messages without a stamp that wait for one; more are given up."""


Placed: TypeAlias = tuple[T, float | None]
"""An item and its time [s] on the boot clock; None where nothing tells it."""


class BootClock(Generic[T]):
    """Gives every message a time; those without a stamp wait for the next stamped one."""

    def __init__(self) -> None:
        self.newest: float | None = None
        """Time of the newest stamped message [s]."""
        self._newest_received = 0.0
        """When the last message of that moment came [s]."""
        self._waiting: list[tuple[T, float]] = []

    def stamped(self, item: T, time: float, received: float) -> list[Placed[T]]:
        """Takes a message with a stamp; returns those that waited for one newer than all before, then itself.

        Args:
            item: the message.
            time: its stamp [s], unwrapped.
            received: when it came at the latest [s], on any clock.
        """
        if self.newest is not None and self.newest - FARTHEST <= time <= self.newest:
            if time >= self.newest - MOMENT:
                self._newest_received = received
            return [(item, time)]
        placed = self._release(time) if self._waiting else []
        self.newest, self._newest_received = time, received
        return [*placed, (item, time)]

    def unstamped(self, item: T, received: float) -> list[Placed[T]]:
        """Takes a message without a stamp, which came after `received` [s]; returns those that waited too long."""
        early = self._release(None) if len(self._waiting) >= MOST_WAITING else []
        self._waiting.append((item, max(0.0, received - self._newest_received)))
        return early

    def finish(self) -> list[Placed[T]]:
        """Returns the messages that still wait, when no other will come."""
        return self._release(None)

    def _release(self, following: float | None) -> list[Placed[T]]:
        placed: list[Placed[T]] = [(item, self._between(later, following)) for item, later in self._waiting]
        self._waiting.clear()
        return placed

    def _between(self, later: float, following: float | None) -> float | None:
        """Time of a message that came `later` than the stamped one before it, before a stamp of `following` [s]."""
        if self.newest is None:
            return None
        if following is not None and following >= self.newest:
            return min(self.newest + later, following)
        return self.newest + later if later <= FARTHEST else None
