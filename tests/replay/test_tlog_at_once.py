"""A telemetry log is read all at once: to the bit what walking, placing and turning message by message give."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from random import Random

import numpy as np
import pytest
from quadid_replay import tlog as mavlink_frames
from quadid_replay.frames import from_euler
from quadid_replay.tlog import _rounds, read_frames

from tests.replay.test_tlog import Tlog, attitude, heartbeat, raw_imu, servo

YEARS = 946_684_800_000_000, 4_102_444_800_000_000


def frame_length(data: bytes, at: int) -> int | None:
    """Length of receive time and frame at this offset, or None where there is none."""
    if at + 11 > len(data) or data[at + 8] not in (0xFE, 0xFD):
        return None
    if not YEARS[0] < int.from_bytes(data[at : at + 8], "big") < YEARS[1]:
        return None
    return data[at + 9] + (16 if data[at + 8] == 0xFE else 20 + 13 * (data[at + 10] & 1))


def looks_like_a_mark(data: bytes, at: int) -> bool:
    return data[at] == 0 and 3 <= data[at + 1] <= 14 and data[at + 8] in (0xFD, 0xFE)


def walked(data: bytes, most: int) -> tuple[list[tuple[int, int]], int, bool]:
    """Frames (offset, length), bytes skipped and whether the end is cut, one frame after the other."""
    found: list[tuple[int, int]] = []
    at, skipped, failures, in_step = 0, 0, 0, True
    while at + 8 < len(data):
        length = frame_length(data, at)
        if length is not None and at + length > len(data):
            if in_step:
                return found, skipped, True
            length = None
        if length is not None and not in_step and at + length < len(data):
            length = None if frame_length(data, at + length) is None else length
        if length is None:
            in_step, failures = False, failures + 1
            later = (k for k in range(at + 1, len(data) - 8) if looks_like_a_mark(data, k))
            following = next(later, len(data)) if failures < most else len(data)
            skipped, at = skipped + following - at, following
        else:
            found.append((at, length))
            in_step, failures, at = True, 0, at + length
    return found, skipped, in_step and at < len(data)


def log() -> bytes:
    out = Tlog()
    for k in range(40):
        t = 5.0 + 0.02 * k
        for message in (heartbeat(), raw_imu(t), attitude(t), servo(t)):
            out.add(t, message, force_v1=k % 3 == 0)
    return bytes(out.data)


def damaged() -> Iterator[bytes]:
    rng, whole = Random(4), log()
    yield whole
    yield whole[:5]
    for _ in range(300):
        data = bytearray(whole[rng.randrange(40) : rng.randrange(60, len(whole))])
        for _ in range(rng.choice((1, 3, 30))):
            at = rng.randrange(len(data))
            kind = rng.randrange(4)
            if kind == 0:
                data[at] ^= 1 << rng.randrange(8)
            elif kind == 1 and len(data) > 200:
                del data[at : at + rng.randrange(100)]
            elif kind == 2:
                data[at:at] = rng.randbytes(rng.randrange(40))
            else:
                other = rng.randrange(len(data))
                data[at:at] = data[other : other + rng.randrange(300)]
        yield bytes(data)


@pytest.mark.parametrize("most", [1_000_000, 3])
def test_the_same_frames_are_found_through_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    monkeypatch.setattr(mavlink_frames, "_MOST_FAILURES", most)
    monkeypatch.setattr(mavlink_frames, "_BLOCK", 100)
    for data in damaged():
        (tmp_path / "log").write_bytes(data)
        found, skipped, cut = walked(data, most)
        frames = read_frames(tmp_path / "log")
        assert (frames.skipped, frames.cut) == (skipped, cut)
        assert [frames.frame(k) for k in range(len(frames.start))] == [data[a + 8 : a + n] for a, n in found]
        times = [int.from_bytes(data[a : a + 8], "big") * 1e-6 for a, _ in found]
        assert frames.received.tolist() == times


def test_attitudes_turned_together_are_those_turned_alone() -> None:
    angles = np.random.default_rng(6).uniform(-4.0, 4.0, (1001, 3))
    angles[17], angles[500, 1] = np.nan, 1e6
    np.testing.assert_array_equal(from_euler(angles), np.concatenate([from_euler(one[None]) for one in angles]))


def test_messages_of_a_round_make_a_row() -> None:
    t = np.arange(7.0)
    places = np.array([0, 4, 0, 12, 4, 2, 10])
    values = np.arange(28.0).reshape(7, 4)
    times, rows = _rounds(t, places, values, 12)
    np.testing.assert_array_equal(times, [0.0, 2.0, 5.0])
    nan = [np.nan] * 4
    np.testing.assert_array_equal(rows[0], [0, 1, 2, 3, 4, 5, 6, 7, *nan])
    np.testing.assert_array_equal(rows[1], [8, 9, 10, 11, 16, 17, 18, 19, *nan])
    np.testing.assert_array_equal(rows[2], [np.nan, np.nan, 20, 21, 22, 23, *nan, 24, 25])
