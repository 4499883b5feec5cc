"""Times of all messages of one vehicle on its boot clock, as `BootClock` places them one by one."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quadid.types import BoolArray, FloatArray, IntArray
from quadid_replay.boot_clock import BootClock, Placed
from quadid_replay.tlog_messages import boot_stamp


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
