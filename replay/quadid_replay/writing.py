"""What the writers share: recordings of windows, samples in time order, files that can be written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np

from quadid.errors import LogError
from quadid.types import FloatArray
from quadid.window import Channel, Recording, Window, as_recording

Source: TypeAlias = Recording | Window | Sequence[Window]
"""What can be written: a recording, or windows of one log."""


def recording_of(source: Source) -> Recording:
    """The recording that a source is, or that its windows make; raises LogError as `as_recording`."""
    if isinstance(source, Recording):
        return source
    return as_recording([source] if isinstance(source, Window) else source)


def in_time_order(times: Sequence[FloatArray]) -> Iterator[tuple[int, int]]:
    """Yields (series, row) over several rising series of times, in time order; at equal times earlier series first."""
    if not times:
        return
    series = np.concatenate([np.full(len(t), i) for i, t in enumerate(times)])
    rows = np.concatenate([np.arange(len(t)) for t in times])
    order = np.argsort(np.concatenate(times), kind="stable")
    yield from zip(series[order].tolist(), rows[order].tolist(), strict=True)


def union_rows(channels: Sequence[Channel | None]) -> tuple[FloatArray, list[FloatArray | None]]:
    """Puts channels on the union of their times, shape (n,); rows without a sample are NaN, absent channels None."""
    present = [c.t for c in channels if c is not None]
    if not present:
        return np.empty(0), [None for _ in channels]
    t = present[0]
    if any(len(other) != len(t) or np.any(other != t) for other in present[1:]):
        t = np.unique(np.concatenate(present))
    out: list[FloatArray | None] = []
    for channel in channels:
        if channel is None:
            out.append(None)
            continue
        rows = np.full((len(t), channel.values.shape[1]), np.nan)
        rows[np.searchsorted(t, channel.t)] = channel.values
        out.append(rows)
    return t, out


def open_for_writing(path: str | Path) -> BinaryIO:
    """Opens a file for writing; raises LogError with the reason when it cannot be."""
    try:
        return Path(path).open("wb")
    except OSError as error:
        raise LogError(
            f"cannot write {path} ({error.strerror})", "a file in a folder that exists", "create the folder first"
        ) from error
