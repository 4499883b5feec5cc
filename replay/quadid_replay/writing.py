"""What the writers share: recordings of windows, samples in time order, files that can be written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np

from quadid.errors import LogError
from quadid.types import FloatArray
from quadid.window import CHANNELS, Channel, Recording, Window

Source: TypeAlias = Recording | Window | Sequence[Window]
"""What can be written: a recording, or windows of one log."""


def as_recording(source: Source) -> Recording:
    """Returns a recording of the source; windows are strung together, rows without a measurement left out.

    Raises:
        LogError: no window, or windows that overlap in time.
    """
    if isinstance(source, Recording):
        return source
    windows = [source] if isinstance(source, Window) else list(source)
    if not windows:
        raise LogError("no window to write", "at least one")
    if any(a.t[-1] >= b.t0 for a, b in zip(windows[:-1], windows[1:], strict=True)):
        raise LogError("windows overlap in time", "windows of one log in rising order of time")
    channels = {}
    for name in CHANNELS:
        parts = [(w.t, getattr(w, name)) for w in windows if getattr(w, name, None) is not None]
        if parts:
            t, values = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
            measured = np.isfinite(values).all(axis=1)
            if measured.any():
                channels[name] = Channel(name, t[measured], values[measured], "window")
    return Recording(windows[0].name, "window", channels, grid=windows[0].dt)


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
