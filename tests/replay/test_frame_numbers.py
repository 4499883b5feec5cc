"""One rule for logs and live links: whether frame numbers of one id are those of one sender."""

import numpy as np
import pytest
from quadid_replay.mavlink_messages import two_rows

from quadid.types import IntArray
from tests.faults.evidence import Happened

FRAMES = 160


def windows(number: IntArray) -> list[bool]:
    """Findings in each stretch of as many frames as a live link looks at."""
    return [two_rows(number[k : k + FRAMES]) for k in range(0, len(number) - FRAMES, FRAMES)]


@pytest.mark.parametrize("lost", [0.0, 0.3, 0.7, 0.9, 0.98])
def test_one_sender_is_one_however_many_frames_are_lost(lost: float) -> None:
    """Of 95 % and more the mean step, by which a live link judged, is that of two senders."""
    rng = np.random.default_rng(1)
    number = np.flatnonzero(rng.random(400_000) >= lost) % 256
    assert not any(windows(number))
    assert not two_rows(number)


@pytest.mark.parametrize(("often", "lost"), [(1, 0.0), (1, 0.8), (4, 0.5), (10, 0.5), (20, 0.0)])
def test_two_senders_are_two_though_one_speaks_seldom(often: int, lost: float, happened: Happened) -> None:
    """A second one that sends a frame to twenty of the first was seen in one stretch of four."""
    rng = np.random.default_rng(1)
    second = rng.random(100_000) < 1.0 / (1 + often)
    number = np.where(second, 57 + np.cumsum(second), np.cumsum(~second))
    number = number[rng.random(len(number)) >= lost] % 256
    seen = windows(number)
    assert np.mean(seen) > 0.85
    found = f"seen in {np.mean(seen):.0%} of the stretches of {FRAMES} frames"
    happened(27, f"two senders merged into one stream, {often} to 1, {lost:.0%} of the frames lost: {found}")


def test_two_numbers_or_none_are_no_rows() -> None:
    assert not two_rows(np.empty(0, dtype=np.int64))
    assert not two_rows(np.array([3, 200]))
