"""Times of messages on a vehicle's boot clock, also of those without a stamp."""

from __future__ import annotations

import math
from typing import Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from quadid.types import BoolArray, FloatArray, IntArray
from quadid_replay.mavlink_messages import boot_stamp

# --- Times of messages without a stamp of their own, from the stamped ones around them
#
# An autopilot writes its messages in order, so a message without a stamp was written between the stamped ones before
# and after it.  The link only shows how long after the earlier one it came; nothing older than that one counts, so
# neither a slow drift of the receiver's clock nor a simulation that runs faster than time moves it.  Who reads late
# knows only after when a message came, and that counts: no lag of his moves it into the next round.  Messages of one
# moment come one after the other, and a slow or shared link draws them out: each of them shows how late the link is by
# then.


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


# --- Times of all messages of one vehicle on its boot clock, as `BootClock` places them one by one


class Stamps(NamedTuple):
    """What n messages of one vehicle tell of their times, in file order; NaN where nothing.

    Attributes:
        received: when they came [s, UNIX], shape (n,).
        boot: their own stamps as `boot_seconds` [s], shape (n,).
        other: stamps of another clock put on the boot clock [s], which go before, shape (n,).
        servo: which are SERVO_OUTPUT_RAW, shape (n,).
    """

    received: FloatArray
    boot: FloatArray
    other: FloatArray
    servo: BoolArray


class Placing(NamedTuple):
    """Messages in the order in which their times are known.

    Attributes:
        order: indices of the messages, shape (n,).
        time: theirs on the boot clock [s], NaN where nothing tells it, in that order.
        waited: how many of the last are known only at the end of the log.
        boot: own stamps without turns of a counter [s], NaN where none, in file order.
    """

    order: IntArray
    time: FloatArray
    waited: int
    boot: FloatArray


def place(stamps: Stamps) -> Placing:
    """Puts the messages on the boot clock."""
    clock: BootClock[int] = BootClock()
    boot: list[float] = []
    placed: list[Placed[int]] = []
    for k, (received, raw, other, servo) in enumerate(zip(*(column.tolist() for column in stamps), strict=True)):
        own = boot_stamp(raw, servo, clock.newest)
        boot.append(math.nan if own is None else own)
        time = own if other != other else other
        placed += clock.unstamped(k, received) if time is None else clock.stamped(k, time, received)
    late = clock.finish()
    order, time = zip(*placed, *late, strict=True) if boot else ((), ())
    return Placing(
        np.array(order, dtype=np.int64), np.array(time, dtype=np.float64), len(late), np.array(boot, dtype=np.float64)
    )  # fmt: skip
