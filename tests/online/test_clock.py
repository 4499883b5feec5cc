"""Stamps become one rising session time, whatever they do."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from quadid.online.clock import CONFIRMATIONS, StreamClock


def test_a_single_wild_stamp_moves_nothing() -> None:
    clock = StreamClock()
    assert clock.time(1.7e9, "gyro") == 1.7e9 % 86400
    assert clock.time(9e12, "gyro") is None
    assert clock.time(1.7e9 + 0.01, "gyro") is not None
    assert (clock.wild, clock.steps) == (1, [])


def test_a_reboot_begins_a_new_stretch_after_the_old_one() -> None:
    clock = StreamClock()
    clock.time(500.0, "gyro")
    times = [clock.time(0.1 * k, "gyro") for k in range(10)]
    assert times[:CONFIRMATIONS] == [None] * CONFIRMATIONS
    later = [t for t in times if t is not None]
    assert len(clock.steps) == 1
    assert min(later) > 500.0
    assert all(math.isclose(b - a, 0.1, abs_tol=1e-9) for a, b in zip(later[:-1], later[1:], strict=True))
    last = later[-1]
    assert math.isclose(clock.stamp(last), 0.9, abs_tol=1e-9)


def test_a_channel_that_comes_late_is_late_and_no_reboot() -> None:
    clock = StreamClock()
    for k in range(100):
        assert clock.time(500.0 + 0.1 * k, "gyro") is not None
        t = clock.time(500.0 + 0.1 * (k - 40), "velocity")
        assert t is not None
        assert math.isclose(clock.stamp(t), 500.0 + 0.1 * (k - 40), abs_tol=1e-9)
    assert (clock.steps, clock.wild) == ([], 0)


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=60))
def test_any_stamps_give_finite_times_and_a_newest_that_never_falls(stamps: list[float]) -> None:
    clock, newest = StreamClock(), -math.inf
    for stamp in stamps:
        t = clock.time(stamp, "gyro")
        assert t is None or math.isfinite(t)
        assert clock.newest >= newest
        newest = clock.newest
