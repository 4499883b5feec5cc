"""Rows of the grid, and channels of a live stream read on them, piece by piece."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from quadid.resample import split_stretches
from quadid.resampling_plan import GAP, OPTIONAL, REQUIRED, Plan, Track, on_grid
from quadid.types import FloatArray
from quadid.window import Sampling

LOST = 2.05
"""Lost packets are no gap while samples come within this many grid steps: the low-pass reaches over twice as far."""


@dataclass(frozen=True)
class Rows:
    """Consecutive rows of the grid.

    Attributes:
        t: times [s], shape (n,).
        columns: values by channel, NaN where nothing was measured; only channels that say something.
        sampling: meaning of the rotor rows; source: where the rotor speeds come from.
        fresh: True when the grid was anchored anew before the first row: nothing may be joined across.
        problem: why there are no rotor speeds, or empty.
        spacing: time between two readings of the rotors [rows].
        new_clock: True where it was anchored anew because a new time base began: another run of the vehicle, maybe.
    """

    t: FloatArray
    columns: dict[str, FloatArray]
    sampling: Sampling
    source: str
    fresh: bool = False
    problem: str = ""
    spacing: float = 1.0
    new_clock: bool = False


def columns_on_grid(plan: Plan, at: FloatArray) -> Generator[None, None, dict[str, FloatArray]]:
    """Reads the channels of a plan, one a piece; returns values by channel, NaN where nothing was measured.

    Optional channels that say nothing in these rows are left out.

    Args:
        plan: tracks around the rows.
        at: times of the rows [s], shape (n,).
    """
    columns = {}
    for name in (*REQUIRED, *OPTIONAL):
        if name not in plan.tracks:
            continue
        yield
        values = on_grid(name, _mended(plan.tracks[name], plan.step), at, plan)
        if name in REQUIRED or not np.isnan(values).all():
            columns[name] = values
    return columns


def _mended(track: Track, step: float) -> Track:
    """The track with stretches joined where only a few packets of a fast stream were lost."""
    longest = LOST * step
    if len(track.stretches) < 2 or GAP * track.period >= longest:
        return track
    return replace(track, stretches=tuple(split_stretches(track.t, longest)))
