"""Frames of a telemetry log: receive times and MAVLink 1 or 2 frames, found all at once, through damage.

A tlog has neither index nor end mark.  After a damaged place the next frame is the next one that looks like one and is
followed by another.  Messages, fields and checksums are pymavlink's; its reader takes ten times as long.
"""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from quadid.types import FloatArray, IntArray

Bytes: TypeAlias = NDArray[np.uint8]

_EARLIEST_US, _LATEST_US = 946_684_800_000_000, 4_102_444_800_000_000  # years 2000 to 2100
_STAMP = 8
_SIGNED = 1
_SIGNATURE = 13
_HEAD = _STAMP + 3
"""Bytes that tell a frame's length: receive time, mark, payload length, flags."""
_BLOCK = 1 << 18
_MOST_FAILURES = 1_000_000
"""So many places in a row that look like a frame and are none: this is no telemetry."""


class Frames(NamedTuple):
    """The frames of a tlog in file order; checksums are the caller's business.

    Attributes:
        data: the file.
        start: offset of each frame's mark, shape (n,).
        end: offset behind its payload, where its checksum stands.
        head: bytes from the mark to the payload: 6 or 10.
        stop: offset behind the whole frame.
        received: receive times [s, UNIX].
        number: of each frame, counted by its sender from 0 to 255 again and again.
        message, system, component: message id and who sent it.
        skipped: bytes that belong to no frame.
        cut: whether the file ends inside a frame.
    """

    data: Bytes
    start: IntArray
    end: IntArray
    head: IntArray
    stop: IntArray
    received: FloatArray
    number: IntArray
    message: IntArray
    system: Bytes
    component: Bytes
    skipped: int
    cut: bool

    def frame(self, k: int) -> bytes:
        """Frame `k` as it was on the link."""
        return self.data[self.start[k] : self.stop[k]].tobytes()


def read_frames(path: Path) -> Frames:
    """Finds the frames of a tlog."""
    with path.open("rb") as file:
        data = np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), dtype=np.uint8)
    marks = _marks(data)
    received = _receive_times(data, marks)
    possible = (received > _EARLIEST_US) & (received < _LATEST_US) & (marks + _HEAD <= len(data))
    places, received = marks[possible], received[possible]
    version_1 = data[places + _STAMP] == 0xFE
    head = np.where(version_1, 6, 10)
    end = places + _STAMP + head + data[places + _STAMP + 1]
    signed = ~version_1 & (data[places + _STAMP + 2] & _SIGNED != 0)
    stop = end + 2 + _SIGNATURE * signed
    kept, skipped, cut = _walk(places, stop, marks, len(data))
    start, head, end = places[kept] + _STAMP, head[kept], end[kept]
    short = np.where(head == 6, 0, 2)  # MAVLink 2 has two flags more before these
    kind = start + 5 + short
    message = data[kind].astype(np.int64)
    long = head == 10
    message[long] |= data[kind[long] + 1].astype(np.int64) << 8 | data[kind[long] + 2].astype(np.int64) << 16
    return Frames(
        data, start, end, head, stop[kept], received[kept].astype(np.float64) * 1e-6,
        data[start + 2 + short].astype(np.int64), message, data[start + 3 + short], data[start + 4 + short],
        skipped, cut,
    )  # fmt: skip


def _marks(data: Bytes) -> IntArray:
    """Where the high bytes of a receive time between the years 2000 and 2100 stand, and a mark behind it."""
    found = [np.empty(0, dtype=np.int64)]
    for begin in range(0, len(data) - _STAMP, _BLOCK):
        end = min(begin + _BLOCK, len(data) - _STAMP)
        mark, high = data[begin + _STAMP : end + _STAMP], data[begin + 1 : end + 1]
        looks = (mark >= 0xFD) & (mark != 0xFF) & (data[begin:end] == 0) & (high >= 0x03) & (high <= 0x0E)
        found.append(np.flatnonzero(looks) + begin)
    return np.concatenate(found)


def _receive_times(data: Bytes, places: IntArray) -> IntArray:
    """Receive times [us, UNIX] at these places."""
    time = np.zeros(len(places), dtype=np.int64)
    for k in range(1, _STAMP):
        time = time << 8 | data[places + k]
    return time


def _walk(places: IntArray, stops: IntArray, marks: IntArray, size: int) -> tuple[IntArray, int, bool]:
    """Follows the frames from one to the next.

    Args:
        places: offsets where a frame may begin, rising; stops: where each ends.
        marks: the same and places that only look like it at first sight.
        size: of the file.

    Returns:
        Which of the places are frames, the bytes skipped, and whether the file ends inside a frame.
    """
    count = len(places)
    following = np.searchsorted(places, stops)
    linked = np.append(places, -1)[following] == stops
    certain = np.flatnonzero((stops <= size) & (linked | (stops >= size)))
    """Frames that another follows: what is looked for after damage."""
    certain_places = places[certain]
    turns = np.flatnonzero(~linked | (following != np.arange(1, count + 1)))
    run_ends = turns[np.searchsorted(turns, np.arange(count))]
    """The last place of a run that simply goes from each to the next."""
    runs: list[tuple[int, int]] = []
    skipped, offset, at = 0, 0, 0 if count and places[0] == 0 else -1
    while True:
        while at >= 0:
            last = int(run_ends[at])
            runs.append((at, last))
            offset, at = int(stops[last]), int(following[last]) if linked[last] else -1
        if offset > size:
            return _members(runs, count)[:-1], skipped, True
        if offset + _STAMP >= size:
            return _members(runs, count), skipped, offset < size
        found = int(np.searchsorted(certain_places, offset, side="right"))
        at = int(certain[found]) if found < len(certain) else -1
        resumed = int(places[at]) if at >= 0 else size
        if 1 + np.searchsorted(marks, resumed) - np.searchsorted(marks, offset, side="right") >= _MOST_FAILURES:
            at, resumed = -1, size
        skipped, offset = skipped + resumed - offset, resumed


def _members(runs: list[tuple[int, int]], count: int) -> IntArray:
    """Indices in all of these runs, first and last included, of `count` places."""
    steps = np.zeros(count + 1, dtype=np.int64)
    bounds = np.array(runs, dtype=np.int64).reshape(-1, 2)
    steps[bounds[:, 0]] += 1
    steps[bounds[:, 1] + 1] -= 1
    return np.flatnonzero(np.cumsum(steps[:-1]))
