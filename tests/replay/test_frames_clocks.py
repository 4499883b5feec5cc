"""Frames against textbook cases, clocks against wraps, reboots and wild stamps, columns against what cannot be used."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from quadid_replay.columns import (
    LogClock,
    RawChannel,
    clean_channel,
    fastest_first,
    flip_attitude,
    flip_body,
    flip_world,
    from_euler,
    to_euler,
    unit_quaternions,
)
from quadid_replay.mavlink_messages import SERVO_TURN, boot_stamp
from scipy.spatial.transform import Rotation

from quadid.rotation import continuous_sign
from quadid.types import FloatArray

angles = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))


def matrix(q: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_quat(q[0], scalar_first=True).as_matrix())


@given(angles)
def test_euler_angles_are_z_y_x_and_come_back(rpy: tuple[float, float, float]) -> None:
    q = from_euler(np.array([rpy]))
    np.testing.assert_allclose(matrix(q), Rotation.from_euler("ZYX", rpy[::-1]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(to_euler(q)[0], rpy, atol=1e-6)


@given(angles)
def test_attitudes_change_frames_as_matrices_do(rpy: tuple[float, float, float]) -> None:
    """R_ned_frd = T_world R_enu_flu T_body with T_world = [[0 1 0] [1 0 0] [0 0 -1]] and T_body = diag(1 -1 -1)."""
    q = from_euler(np.array([rpy]))
    world, body = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]), np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(matrix(flip_attitude(q)), world @ matrix(q) @ body, atol=1e-12)
    np.testing.assert_allclose(flip_attitude(flip_attitude(q)), q, atol=1e-12)
    vector = np.array([[1.0, 2.0, 3.0]])
    turned = (matrix(q) @ vector[0])[None]
    np.testing.assert_allclose(matrix(flip_attitude(q)) @ flip_body(vector)[0], flip_world(turned)[0], atol=1e-12)


def test_level_and_north_in_both_worlds() -> None:
    facing_east_enu = np.array([[1.0, 0.0, 0.0, 0.0]])  # ROS: yaw 0 faces east
    np.testing.assert_allclose(to_euler(flip_attitude(facing_east_enu))[0], [0.0, 0.0, np.pi / 2], atol=1e-12)
    np.testing.assert_array_equal(flip_world(np.array([[1.0, 2.0, 3.0]])), [[2.0, 1.0, -3.0]])
    np.testing.assert_array_equal(flip_body(np.array([[1.0, 2.0, 3.0]])), [[1.0, -2.0, -3.0]])


def test_signs_become_continuous() -> None:
    q = from_euler(np.column_stack([np.linspace(0, 7, 50), np.zeros(50), np.zeros(50)]))
    flipped = q * np.where(np.random.default_rng(1).random(50) < 0.5, -1.0, 1.0)[:, None]
    out = continuous_sign(flipped)
    assert np.all(np.sum(out[1:] * out[:-1], axis=1) > 0.0)
    np.testing.assert_array_equal(out[0], flipped[0])


def test_quaternions_off_unit_length_are_normalised_and_zeros_refused() -> None:
    q, good = unit_quaternions(np.array([[1.0, 0, 0, 0], [1.1, 0, 0, 0], [0.0, 0, 0, 0]]))
    np.testing.assert_array_equal(q[1], [1.0, 0, 0, 0])
    assert list(good) == [True, True, False]


@given(st.floats(1.0, 1e6), st.floats(-1e3, 1e3))
def test_a_counter_of_32_bits_is_unwrapped_near_the_newest_stamp(true: float, offset: float) -> None:
    assert boot_stamp(true % SERVO_TURN, True, true + offset) == pytest.approx(true, abs=1e-3)


def test_steady_time_passes_untouched() -> None:
    clock = LogClock()
    t = np.arange(0.0, 10.0, 0.01)
    np.testing.assert_array_equal(clock.times(t), t)
    assert clock.breaks == []


def test_reboot_goes_on_after_a_break() -> None:
    clock = LogClock()
    out = clock.times(np.concatenate([np.arange(100.0, 110.0, 0.1), np.arange(2.0, 12.0, 0.1)]))
    assert clock.reboots == 1
    assert len(clock.breaks) == 1
    kept = out[np.isfinite(out)]
    assert np.all(np.diff(kept) > 0.0)
    assert np.count_nonzero(np.isnan(out)) == 3  # the stamps that waited for confirmation
    assert kept[99] < clock.breaks[0] < kept[100]
    np.testing.assert_allclose(np.diff(kept[100:]), 0.1, atol=1e-9)


def test_a_jump_ahead_is_a_break_and_a_single_wild_stamp_is_dropped() -> None:
    clock = LogClock()
    t = np.concatenate([np.arange(0.0, 10.0, 0.1), np.arange(500.0, 510.0, 0.1)])
    out = clock.times(t)
    assert clock.jumps == 1
    assert out[np.isfinite(out)][100] == pytest.approx(500.3)
    clock = LogClock()
    instant = np.concatenate([np.full(5, 14.0), np.arange(0.0, 10.0, 0.1).repeat(5)])
    assert list(np.flatnonzero(np.isnan(clock.times(instant)))) == [0, 1, 2, 3, 4]
    assert (clock.breaks, clock.wild) == ([], 5)
    clock = LogClock()
    wild = np.insert(np.arange(0.0, 10.0, 0.1), [40, 60], [1e9, -1e6])
    assert list(np.flatnonzero(np.isnan(clock.times(wild)))) == [40, 61]
    assert (clock.breaks, clock.wild) == ([], 2)
    assert any("confirm" in w for w in clock.warnings())


@pytest.mark.parametrize(
    ("places", "late"),
    [
        ([500], 20.0),
        ([500], 0.5),
        ([500], -20.0),
        ([0], 20.0),
        ([500, 501, 502], 20.0),
        ([500, 502, 504, 506], 20.0),
        ([*range(50, 2000, 100)], 20.0),
        ([*range(50, 2000, 100)], -29.0),
    ],
)
def test_single_wild_stamps_cost_themselves_and_no_other(places: list[int], late: float) -> None:
    t = 0.02 * np.arange(2000)
    wild: FloatArray = np.array(t, dtype=np.float64)
    wild[places] += late
    clock = LogClock()
    channel = clean_channel(RawChannel("gyro", clock.times(wild), np.zeros((2000, 3)), "x"))
    assert channel is not None
    assert sum(channel.faults.values()) == len(places)
    assert clock.breaks == []
    assert set(channel.t) == set(np.delete(t, places))


@pytest.mark.parametrize("late", [20.0, -20.0, 1e4])
def test_messages_of_one_instant_do_not_confirm_each_other(late: float) -> None:
    t = np.repeat(0.02 * np.arange(500), 9) + np.tile(0.0002 * np.arange(9), 500)
    wild: FloatArray = np.array(t, dtype=np.float64)
    wild[9 * 250 : 9 * 251] += late
    clock = LogClock()
    mapped = clock.times(wild)
    assert (clock.breaks, clock.reboots, clock.jumps) == ([], 0, 0)
    others = np.delete(np.arange(len(t)), slice(9 * 250, 9 * 251))
    np.testing.assert_array_equal(mapped[others], t[others])


@pytest.mark.parametrize("gap", [1.5, 12.0, 29.0])
def test_a_gap_is_no_break_and_costs_nothing(gap: float) -> None:
    t: FloatArray = np.asarray(0.02 * np.arange(2000), dtype=np.float64)
    t[1000:] += gap
    clock = LogClock()
    np.testing.assert_array_equal(clock.times(t), t)
    assert (clock.breaks, clock.wild) == ([], 0)
    slow: FloatArray = np.arange(0.0, 900.0, gap, dtype=np.float64)
    np.testing.assert_array_equal(LogClock().times(slow), slow)


@given(
    st.lists(st.floats(allow_nan=True, allow_infinity=True) | st.floats(0.0, 3.0), max_size=60),
    st.lists(st.integers(0, 60), max_size=5),
)
def test_any_stamps_are_survived_and_grouping_does_not_matter(raw: list[float], cuts: list[int]) -> None:
    whole, split = LogClock(), LogClock()
    first = raw[:6]  # of which the very first stamp is judged by those that come with it
    t = np.concatenate([whole.times(np.array(first)), whole.times(np.array(raw[6:]))])
    parts = np.split(np.array(raw[6:]), sorted({min(cut, len(raw[6:])) for cut in cuts}))
    again = np.concatenate([split.times(np.array(first)), *(split.times(part) for part in parts)])
    np.testing.assert_array_equal(t, again)
    assert not np.isinf(t).any()
    assert (whole.breaks, whole.wild) == (split.breaks, split.wild)


def test_samples_that_cannot_be_used_are_dropped_and_counted() -> None:
    t = np.array([0.0, 0.1, 0.1, 0.05, 0.2, np.nan, 0.3, 0.4])
    values = np.arange(24.0).reshape(8, 3)
    values[6, 1] = np.inf
    channel = clean_channel(RawChannel("gyro", t, values, "x"))
    assert channel is not None
    np.testing.assert_array_equal(channel.t, [0.0, 0.1, 0.2, 0.4])
    assert dict(channel.faults) == {"bad_stamp": 1, "not_finite": 1, "duplicate": 1, "backwards": 1}
    nothing = clean_channel(RawChannel("gyro", t, values * np.nan, "x"))
    assert (len(nothing.t), nothing.faults) == (0, {"bad_stamp": 1, "not_finite": 7})
    absurd = clean_channel(RawChannel("position", np.array([0.0, 1.0]), np.array([[0.0, 1, 2], [1e200, 0, 0]]), "x"))
    assert absurd is not None
    assert (len(absurd.t), dict(absurd.faults)) == (1, {"absurd": 1})


def test_a_source_must_be_clearly_faster_to_be_preferred() -> None:
    def raw(rate: float, name: str) -> RawChannel:
        t = np.arange(0.0, 2.0, 1.0 / rate)
        return RawChannel("gyro", t, np.zeros((len(t), 3)), name)

    assert [e.source for e in fastest_first([raw(100, "a"), raw(110, "b")])] == ["a", "b"]
    assert fastest_first([raw(100, "a"), raw(400, "b")])[0].source == "b"


@pytest.mark.parametrize("rate", [4.0, 50.0, 500.0])
@pytest.mark.parametrize("late", [2.0, 20.0, 29.0])
@pytest.mark.parametrize("count", [1, 3])
def test_few_samples_alone_at_an_end_cost_themselves_and_no_time(rate: float, late: float, count: int) -> None:
    """No stamp after the last denies it, and a log that is sorted by its stamps has every wild one at an end."""
    t = np.arange(0.0, 60.0, 1.0 / rate)
    for wild in (t[-1] + late + t[:count], t[0] - late - t[:count]):
        stamps = np.sort(np.concatenate([t, wild]))
        channel = clean_channel(RawChannel("gyro", stamps, np.zeros((len(stamps), 3)), "x"))
        assert channel is not None
        if late < 50.0 / rate:  # so slow a signal has gaps of this length
            assert len(channel.t) == len(stamps)
        else:
            np.testing.assert_array_equal(channel.t, t)
            assert channel.faults == {"bad_stamp": count}
