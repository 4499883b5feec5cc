"""Messages without a stamp: between the stamped ones around them, whatever the receiver's clock does."""

from collections.abc import Callable

import numpy as np
import pytest
from quadid_replay.mavlink_messages import FARTHEST, BootClock, Placed


def play(speed: Callable[[float], float], stamped: float = 0.02, phase: float = 0.0) -> tuple[list[float], list[float]]:
    """Plays 240 s of stamped messages, each followed `phase` s later by one without; returns true and found times."""
    clock: BootClock[float] = BootClock()
    out: list[Placed[float]] = []
    for k in range(int(240.0 / stamped)):
        t = stamped * k
        out += clock.stamped(-1.0, t, speed(t))
        out += clock.unstamped(t + phase, speed(t + phase))
    out += clock.finish()
    kept = [(item, time) for item, time in out if item >= 0.0 and time is not None]
    return [a for a, _ in kept], [b for _, b in kept]


@pytest.mark.parametrize("rate", [1.0, 1.0 + 2e-4, 0.4, 3.0], ids=["steady", "drift", "slow", "fast"])
def test_a_drifting_receiver_never_moves_a_message_out_of_its_place(rate: float) -> None:
    true, found = play(lambda t: 5e5 + rate * t)
    np.testing.assert_allclose(found, true, atol=1e-6)


def test_a_stepping_receiver_clock_does_no_harm() -> None:
    true, found = play(lambda t: t + (3600.0 if t > 100.0 else 0.0) - (7200.0 if t > 150.0 else 0.0), phase=0.008)
    assert len(found) == len(true) == 12000
    assert np.max(np.abs(np.subtract(found, true))) < 0.0201
    assert np.median(np.abs(np.subtract(found, true))) < 1e-6


def test_arrival_tells_the_phase_between_rare_stamps_but_never_leaves_them() -> None:
    true, found = play(lambda t: t, stamped=0.5, phase=0.3)
    np.testing.assert_allclose(found, true, atol=1e-9)
    rng = np.random.default_rng(1)
    true, found = play(lambda t: t + rng.exponential(0.2), stamped=0.1, phase=0.03)
    errors = np.subtract(found, true)
    assert errors.min() >= -0.0301
    assert errors[:-1].max() <= 0.0701


def test_without_a_stamp_near_there_is_no_time() -> None:
    clock: BootClock[str] = BootClock()
    assert clock.unstamped("before any", 0.0) == []
    assert clock.stamped("first", 5.0, 1.0) == [("before any", None), ("first", 5.0)]
    clock.unstamped("near", 1.5)
    clock.unstamped("far", 1.0 + FARTHEST + 0.1)
    assert clock.finish() == [("near", 5.5), ("far", None)]


def test_a_reboot_starts_anew_once_two_stamps_agree() -> None:
    clock: BootClock[str] = BootClock()
    clock.stamped("old", 100.0, 0.0)
    clock.unstamped("last", 0.01)
    assert clock.stamped("new", 2.0, 20.0) == [("new", 2.0)]
    clock.unstamped("between", 20.01)
    assert clock.stamped("newer", 2.02, 20.02) == [("last", 100.01), ("between", None), ("newer", 2.02)]
    clock.unstamped("next", 20.03)
    item, time = clock.stamped("after", 2.04, 20.04)[0]
    assert item == "next"
    assert time == pytest.approx(2.03)


def test_a_pause_is_believed_at_once_and_one_stamp_of_another_clock_never() -> None:
    clock: BootClock[str] = BootClock()
    clock.stamped("before", 100.0, 0.0)
    clock.stamped("behind a pause", 107.0, 7.1)
    for k in range(5):
        clock.stamped("of another clock", 127.0 + 0.1 * k, 7.2 + 0.1 * k)
        clock.unstamped("esc", 7.21 + 0.1 * k)
        item, time = clock.stamped("of the clock", 107.15 + 0.1 * k, 7.25 + 0.1 * k)[0]
        assert item == "esc"
        assert time == pytest.approx(107.11 + 0.1 * k, abs=0.041)


def test_an_older_stamp_between_is_disorder() -> None:
    clock: BootClock[str] = BootClock()
    clock.stamped("target", 1.006, 0.0)
    clock.unstamped("esc", 0.0)
    assert clock.stamped("servo", 1.0, 0.001) == [("servo", 1.0)]
    assert clock.stamped("attitude", 1.02, 0.002)[0] == ("esc", 1.006)


@pytest.mark.parametrize(
    ("stamps", "came", "placed"),
    [
        # A link that draws out the messages of one moment does not delay the last of them.
        (((1.0002, 5.0), (1.0, 5.010)), 5.0101, 1.0003),
        # A stamp of an earlier moment tells nothing of the link.
        (((1.0, 5.0), (0.9, 5.008)), 5.009, 1.009),
    ],
)
def test_older_stamps_beside_do_not_move_a_message(
    stamps: tuple[tuple[float, float], ...], came: float, placed: float
) -> None:
    clock: BootClock[str] = BootClock()
    for stamp, received in stamps:
        clock.stamped("other", stamp, received)
    clock.unstamped("esc", came)
    item, time = clock.stamped("next", 1.02, 5.02)[0]
    assert item == "esc"
    assert time == pytest.approx(placed)
