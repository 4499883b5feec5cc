"""A log as the stream that it once was: samples in time order, with the stamps a live service would have seen."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from quadid.window import Recording, Sample
from quadid_node.messages import Clock

_BASE = re.compile(r"times count from UNIX time (\d+) s")


def base_seconds(recording: Recording) -> int:
    """UNIX time that the recording's times count from [s]; 0 when they are no UNIX times."""
    for note in recording.warnings:
        found = _BASE.search(note)
        if found is not None:
            return int(found[1])
    return 0


def stream(recording: Recording, clock: Clock) -> Iterator[Sample]:
    """Yields all samples in time order, in the seconds of `clock`; at equal times in the order of the channels.

    Times are brought back to whole nanoseconds, as they came in headers, so that a replayed log gives the numbers of
    the live run bit for bit.
    """
    base = base_seconds(recording) * 10**9
    names = list(recording.channels)
    if not names:
        return
    times = [recording.channels[n].t for n in names]
    which = np.concatenate([np.full(len(t), i) for i, t in enumerate(times)])
    rows = np.concatenate([np.arange(len(t)) for t in times])
    order = np.argsort(np.concatenate(times), kind="stable")
    for i, row in zip(which[order].tolist(), rows[order].tolist(), strict=True):
        channel = recording.channels[names[i]]
        ns = round(float(channel.t[row]) * 1e9) + base
        yield Sample(clock.seconds(ns), names[i], tuple(channel.values[row].tolist()))
