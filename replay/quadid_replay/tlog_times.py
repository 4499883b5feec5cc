"""Times of all messages of one vehicle on its boot clock: what `BootClock` says one by one, told of all at once.

Where stamps never fall back by more than `boot_clock.FARTHEST`, the newest stamp before a message is the largest, and
nothing has to be played.  What that supposes is checked afterwards, message by message; where it is wrong (a reboot, a
stamp of zero after it), they are played one by one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadid.types import BoolArray, FloatArray, IntArray
from quadid_replay.boot_clock import FARTHEST, MOMENT, MOST_WAITING, BootClock, Placed
from quadid_replay.tlog_messages import SERVO_TURN, ZERO_IS_BOOT, boot_stamp


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
    found = at_once(stamps)
    return one_by_one(stamps) if found is None else found


def one_by_one(stamps: Stamps) -> Placing:
    """Plays the messages through a `BootClock`."""
    clock: BootClock[int] = BootClock()
    boot = np.full(len(stamps.boot), np.nan)
    placed: list[Placed[int]] = []
    for k, (received, raw, other, servo) in enumerate(zip(*(column.tolist() for column in stamps), strict=True)):
        own = boot_stamp(raw, servo, clock.newest)
        boot[k] = np.nan if own is None else own
        time = own if np.isnan(other) else other
        placed += clock.unstamped(k, received) if time is None else clock.stamped(k, time, received)
    late = clock.finish()
    order = np.array([k for k, _ in placed + late], dtype=np.int64)
    time = np.array([np.nan if t is None else t for _, t in placed + late], dtype=np.float64)
    return Placing(order, time, len(late), boot)


def at_once(stamps: Stamps) -> Placing | None:
    """The same without playing them; None where stamps are not such that this is sure."""
    count = len(stamps.boot)
    boot = stamps.boot.copy()
    unknown = boot == 0.0
    unknown &= _newest_before(np.where(stamps.servo | unknown, np.nan, boot)) > ZERO_IS_BOOT
    boot[unknown] = np.nan
    turning = stamps.servo & ~np.isnan(boot)
    steady = _newest_before(np.where(stamps.servo, np.nan, _first_known(stamps.other, boot)))
    boot[turning] += _turns(boot[turning], steady[turning]) * SERVO_TURN
    time = _first_known(stamps.other, boot)
    newest = _newest_before(time)
    stamped = ~np.isnan(time)
    raw = stamps.boot
    told = np.where(stamps.servo, raw + _turns(raw, newest) * SERVO_TURN, raw)
    sure = (
        np.array_equal(unknown, (raw == 0.0) & (np.abs(told - newest) > ZERO_IS_BOOT))
        and np.array_equal(boot[turning], told[turning])
        and not np.any(time[stamped] < newest[stamped] - FARTHEST)
    )
    news = np.flatnonzero(stamped & ~(time <= newest))
    before = np.searchsorted(news, np.arange(count), side="right") - 1
    waiting = np.flatnonzero(~stamped)
    if not sure or (len(waiting) and np.bincount(before[waiting] + 1).max() > MOST_WAITING):
        return None
    last, following = np.append(news, -1)[before[waiting]], np.append(news, count)[before[waiting] + 1]
    heard = np.flatnonzero(stamped & ~(time < newest - MOMENT))
    heard = np.append(heard, -1)[np.searchsorted(heard, waiting) - 1]
    later = np.maximum(0.0, stamps.received[waiting] - stamps.received[heard])
    guess = np.where(last < 0, np.nan, time[last] + later)
    ended = following == count
    limit = np.where(ended, np.inf, np.append(time, np.inf)[following])
    time[waiting] = np.where(ended & (later > FARTHEST), np.nan, np.minimum(guess, limit))
    rank = 2 * np.arange(count) + 1
    rank[waiting] = 2 * following
    order = np.argsort(rank, kind="stable")
    return Placing(order, time[order], int(np.count_nonzero(ended)), boot)


def _first_known(one: FloatArray, other: FloatArray) -> FloatArray:
    return np.where(np.isnan(one), other, one)


def _newest_before(time: FloatArray) -> FloatArray:
    """The largest of the times before each, NaN where there is none."""
    newest = np.fmax.accumulate(np.concatenate([[np.nan], time]))
    return newest[:-1]


def _turns(raw: FloatArray, reference: FloatArray) -> FloatArray:
    """Whole turns of the counter that bring it closest to the reference, as `WrapCounter.unwrap_near`."""
    turns = np.rint((reference - raw) / SERVO_TURN)
    return np.where(np.isnan(turns), 0.0, turns)
