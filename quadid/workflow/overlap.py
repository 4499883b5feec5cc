"""Whether a validation flight was fitted after all: the same log, a copy of it, a part of it, a second recorder."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quadid.errors import LogError
from quadid.workflow.loading import Log, first_imu_time

FloatArray = NDArray[np.float64]

RUN = 8
"""Gyro rows that must agree in a row: 24 numbers with sensor noise do not agree by chance."""
ROUNDED = 4
"""Decimals of the rates [rad/s] that are compared, so that a copy in another format agrees too."""
ALIKE = 0.8
"""Correlation of rates at the same date above which two recorders flew on one vehicle."""
SHORTEST = 2.0
"""Shortest common stretch that is called an overlap [s]."""


def check_unseen(train: Sequence[Log], held: Sequence[Log]) -> None:
    """Raises LogError where a validation log holds flight that is fitted too."""
    for log in held:
        for other in train:
            seconds = max(common_rows(other, log), same_flight(other, log))
            if seconds > 0.0:
                raise LogError(
                    f"{log.name} proves nothing: {seconds:.1f} s of it are in {other.name}, which is fitted",
                    "a flight, or a part of one, that is not fitted",
                    "give another flight to --validate, or parts that do not overlap: LOG@0:60 --validate LOG@60:120",
                )


def common_rows(train: Log, held: Log) -> float:
    """Seconds of `held` whose gyro rows stand in `train` too, number by number."""
    (_, a), (t, b) = gyro(train), gyro(held)
    known = {run for run in _runs(a, 1) if run is not None}
    # Runs of the one begin at every row, so every eighth row of the other is enough.
    shared = [i for i, run in enumerate(_runs(b, RUN)) if run in known]
    return len(shared) * RUN * float(np.median(np.diff(t))) if len(shared) > 1 else 0.0


def same_flight(train: Log, held: Log) -> float:
    """Seconds that both logs have in common by date, where their rates agree; else 0."""
    (s, a), (t, b) = gyro(train), gyro(held)
    begun = train.recording.epoch, held.recording.epoch
    if len(s) < 2 or len(t) < 2 or begun[0] is None or begun[1] is None:
        return 0.0
    t = t + (begun[1] - begun[0])
    inside = (t >= s[0]) & (t <= s[-1])
    common = float(np.ptp(t[inside])) if inside.any() else 0.0
    if common < SHORTEST:
        return 0.0
    again = np.column_stack([np.interp(t[inside], s, a[:, i]) for i in range(3)])
    here = b[inside] - b[inside].mean(axis=0)
    again = again - again.mean(axis=0)
    size = math.sqrt(float(np.sum(here**2)) * float(np.sum(again**2)))
    return common if size > 0.0 and float(np.sum(here * again)) / size > ALIKE else 0.0


def gyro(log: Log) -> tuple[FloatArray, FloatArray]:
    """Times [s] and rates [rad/s] (n, 3) inside the part of a log that is used."""
    channel = log.recording.channels.get("gyro")
    if channel is None:
        return np.zeros(0), np.zeros((0, 3))
    zero = first_imu_time(log.recording)
    low = -math.inf if log.cut.start is None else zero + log.cut.start
    high = math.inf if log.cut.stop is None else zero + log.cut.stop
    used = (channel.t >= low) & (channel.t <= high)
    return channel.t[used], channel.values[used]


def _runs(rates: FloatArray, step: int) -> list[bytes | None]:
    """Content of `RUN` rows from every `step`-th row on; None where the sensor does not move."""
    rounded = np.round(rates, ROUNDED) + 0.0
    starts = range(0, len(rounded) - RUN + 1, step)
    moving = [bool(np.ptp(rounded[i : i + RUN], axis=0).min() > 0.0) for i in starts]
    return [rounded[i : i + RUN].tobytes() if m else None for i, m in zip(starts, moving, strict=True)]
