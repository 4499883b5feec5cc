"""Stamps become one rising session time, whatever they do; only the gyro's move it, and only several that agree."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadid.online.stream import AHEAD, CONFIRMATIONS, PAUSE_AHEAD, STEP_AHEAD, StreamClock

STAMPS = st.lists(
    st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(0.0, 100.0), st.sampled_from([1e9, 1e9 + 0.2])),
    max_size=60,
)


def lead(clock: StreamClock, *stamps: float) -> list[float]:
    return [float(t) for t in clock.lead(np.array(stamps))]


@pytest.mark.parametrize("wild", [9e12, 1.7e9 + 1.0, 1.7e9 + 29.0, 1.7e9 - 5.0, math.nan, -math.inf])
def test_a_single_wild_stamp_moves_nothing(wild: float) -> None:
    clock = StreamClock()
    assert lead(clock, 1.7e9) == [1.7e9 % 86400]
    assert math.isnan(lead(clock, wild)[0])
    assert lead(clock, 1.7e9 + 0.01) == pytest.approx([1.7e9 % 86400 + 0.01])
    assert (clock.wild, clock.steps) == (1, 0)


def test_a_reboot_begins_a_new_time_base_after_the_old_one() -> None:
    clock = StreamClock()
    lead(clock, 500.0)
    times = lead(clock, *(0.1 * k for k in range(10)))
    assert np.isnan(times[:CONFIRMATIONS]).all()
    later = np.array(times[CONFIRMATIONS:])
    assert clock.steps == 1
    assert later.min() > 500.0
    assert np.allclose(np.diff(later), 0.1)
    assert clock.stamp(float(later[-1])) == pytest.approx(0.9)
    assert clock.stamp(500.0) == pytest.approx(500.0), "in the time base that held then"


@pytest.mark.parametrize("pause", [0.3, 1.0, 5.0, 29.0, 31.0, 5000.0])
def test_a_pause_is_no_reboot_unless_it_is_long(pause: float) -> None:
    clock = StreamClock()
    lead(clock, *(0.02 * k for k in range(100)))
    times = lead(clock, *(1.98 + pause + 0.02 * k for k in range(10)))
    assert np.isnan(times).sum() == (CONFIRMATIONS if pause >= STEP_AHEAD else 0)
    assert clock.steps == (pause > PAUSE_AHEAD)
    assert clock.stamp(times[-1]) == pytest.approx(1.98 + pause + 0.18)


@given(STAMPS)
def test_followers_move_nothing_and_are_never_far_ahead(stamps: list[float]) -> None:
    clock = StreamClock()
    lead(clock, 50.0)
    t = clock.follow(np.array(stamps))
    assert clock.newest == 50.0
    assert not (t > 50.0 + AHEAD).any()
    assert [math.isnan(x) for x in t.tolist()] == [not s <= 50.0 + AHEAD for s in stamps]


@given(STAMPS, st.lists(st.integers(0, 60), max_size=5))
def test_any_stamps_in_any_portions_give_the_same_times_which_never_fall(stamps: list[float], cuts: list[int]) -> None:
    whole, parts = StreamClock(), StreamClock()
    t = lead(whole, *stamps)
    newest, out = -math.inf, list[float]()
    edges = [0, *sorted(min(c, len(stamps)) for c in cuts), len(stamps)]
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        out += lead(parts, *stamps[a:b])
        assert parts.newest >= newest
        newest = parts.newest
    assert np.array_equal(t, out, equal_nan=True)
    assert (whole.steps, whole.wild, whole.newest) == (parts.steps, parts.wild, parts.newest)
    assert not np.isinf(t).any()
