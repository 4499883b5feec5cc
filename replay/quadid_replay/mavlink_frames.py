"""Frames of a telemetry log: receive time and MAVLink 1 or 2 frame, one after the other, through damage.

A tlog has neither index nor end mark.  After a damaged place the next frame is the next one that looks like one and is
followed by another.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

_EARLIEST_US, _LATEST_US = 946_684_800_000_000, 4_102_444_800_000_000  # years 2000 to 2100
_STAMP = 8
_SIGNED = 1
_SIGNATURE = 13
_MARK = re.compile(rb"\x00[\x03-\x0e].{6}[\xfd\xfe]", re.DOTALL)
"""What a frame begins with: the high bytes of a receive time between the years 2000 and 2100, and its mark."""
_MOST_FAILURES = 1_000_000
"""So many places in a row that look like a frame and are none: this is no telemetry."""


class Frame(NamedTuple):
    """One frame: receive time [s, UNIX], message id, sending system and component, its bytes."""

    received: float
    message: int
    system: int
    component: int
    data: memoryview


@dataclass
class FrameCount:
    """Account of a walk: frames seen, bytes skipped, whether the file ends inside a frame."""

    frames: int = 0
    skipped: int = 0
    cut: bool = False


def iterate_frames(path: Path, count: FrameCount) -> Iterator[Frame]:
    """Yields the frames of a tlog in file order; checksums are the caller's business."""
    with path.open("rb") as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    data = memoryview(mapped)
    offset, size, in_step, failures = 0, len(data), True, 0
    while offset + _STAMP < size:
        length = frame_length(data, offset)
        if length is not None and offset + length > size:
            if in_step:
                count.cut = True
                return
            length = None
        if length is None or not (in_step or _follows(data, offset + length)):
            in_step = False
            failures += 1
            following = _next_candidate(mapped, offset + 1) if failures < _MOST_FAILURES else size
            count.skipped += following - offset
            offset = following
            continue
        in_step, failures = True, 0
        count.frames += 1
        yield _frame(data, offset, length)
        offset += length
    count.cut |= in_step and offset < size


def frame_length(data: memoryview, offset: int) -> int | None:
    """Returns the length of receive time and frame at `offset`, or None when there is no such thing."""
    if offset + _STAMP + 3 > len(data) or data[offset + _STAMP] not in (0xFE, 0xFD):
        return None
    if not _EARLIEST_US < int.from_bytes(data[offset : offset + _STAMP], "big") < _LATEST_US:
        return None
    payload = data[offset + _STAMP + 1]
    if data[offset + _STAMP] == 0xFE:
        return _STAMP + 8 + payload
    return _STAMP + 12 + payload + (_SIGNATURE if data[offset + _STAMP + 2] & _SIGNED else 0)


def _follows(data: memoryview, offset: int) -> bool:
    return offset >= len(data) or frame_length(data, offset) is not None


def _next_candidate(mapped: mmap.mmap, offset: int) -> int:
    """Returns the next offset where receive time and mark of a frame may stand, or the end of the file."""
    found = _MARK.search(mapped, offset)
    return found.start() if found else len(mapped)


def _frame(data: memoryview, offset: int, length: int) -> Frame:
    received = int.from_bytes(data[offset : offset + _STAMP], "big") * 1e-6
    frame = data[offset + _STAMP : offset + length]
    if frame[0] == 0xFE:
        return Frame(received, frame[5], frame[3], frame[4], frame)
    return Frame(received, frame[7] | frame[8] << 8 | frame[9] << 16, frame[5], frame[6], frame)
