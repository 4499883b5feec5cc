"""Faults of the data themselves, seen without any model: sensors at the end of their range, rows that are copies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quadid.data.resample import copied
from quadid.data.window import Window
from quadid.types import FloatArray

# --- When a sensor is at the end of its range: the one rule for inspection, online windows and diagnosis
#
# A saturated axis piles up at exactly its largest or smallest value, far more often than at the value beside it, and
# comes back to it again and again.  Coarse steps of a converter pile up nowhere in particular, and a motor at rest
# stays at its lowest command without coming back.


LEAST_SHARE = 0.005
"""Share of samples at exactly the largest or smallest value that makes a saturated sensor …"""
LEAST_COUNT = 6
"""… if they are so many …"""
PILE = 4.0
"""… this many times as many as lie on the next value …"""
LEAST_ARRIVALS = 3
"""… and come there from other values this often."""


class AtLimit(NamedTuple):
    """One end of one axis at its limit.

    Attributes:
        axis: column.
        level: the value that is not left, in the unit of the values.
        samples: how many are there.
        share: of the column's finite samples.
    """

    axis: int
    level: float
    samples: int
    share: float


def at_limit(values: FloatArray) -> list[AtLimit]:
    """Returns the ends of axes that are saturated.

    Args:
        values: shape (n, axes), any unit; rows that are not finite do not count.
    """
    found = []
    for axis, column in enumerate(values.T):
        finite = column[np.isfinite(column)]
        levels, counts = np.unique(finite, return_counts=True)
        if len(levels) < 3:
            continue
        for end, beside in ((0, 1), (-1, -2)):
            count, share = int(counts[end]), float(counts[end] / len(finite))
            there = finite == levels[end]
            arrivals = np.count_nonzero(there[1:] & ~there[:-1])
            if (
                share > LEAST_SHARE
                and count >= LEAST_COUNT
                and count > PILE * counts[beside]
                and arrivals >= LEAST_ARRIVALS
            ):
                found.append(AtLimit(axis, float(levels[end]), count, share))
    return found


# --- Faults of the data themselves, seen without any model: a sensor at the end of its range, rows that are copies
#
# Both bend every estimate, and a cause named from them would be a stand-in.  Copies are no measurements and are left
# out; what a saturated sensor would have shown is not known, so nothing found beside it is called confident.


LEAST_COPIES = 0.03
"""Share of inertial rows that equal the row before exactly."""
_AXES = "xyz"


@dataclass(frozen=True)
class DataFault:
    """One fault of the data.

    Attributes:
        kind: ``saturated`` or ``repeated``.
        channel: name of the channel, with its axis where there is one.
        share: of the samples.
        text: one sentence with what to do.
    """

    kind: str
    channel: str
    share: float
    text: str


def data_faults(windows: Sequence[Window]) -> tuple[DataFault, ...]:
    """Looks for saturated and repeated inertial samples in `windows`; a flight without such faults gives none."""
    out: list[DataFault] = []
    for name, unit in (("gyro", "rad/s"), ("accel", "m/s²")):
        parts = [values for w in windows if (values := getattr(w, name)) is not None]
        if parts:
            out += _saturated(name, unit, np.concatenate(parts))
            out += _repeated(name, parts)
    return tuple(out)


def without_copies(windows: Sequence[Window]) -> list[Window]:
    """Windows in which inertial rows that equal the row before exactly count as not measured."""
    out = []
    for window in windows:
        changed = {}
        for name in ("gyro", "accel"):
            values = getattr(window, name)
            if values is None:
                continue
            copies = np.flatnonzero(copied(values)) + 1
            if len(copies) >= LEAST_COPIES * len(values):
                kept = values.copy()
                kept[copies] = np.nan
                changed[name] = kept
        out.append(replace(window, **changed) if changed else window)
    return out


def _saturated(name: str, unit: str, values: FloatArray) -> list[DataFault]:
    found = []
    for axis, level, _, share in at_limit(values):
        text = (
            f"{name} {_AXES[axis]} stays at exactly {level:.4g} {unit} in {share:.1%} of the samples: the sensor "
            "saturates; log it with a wider range, or fly more gently"
        )
        found.append(DataFault("saturated", f"{name} {_AXES[axis]}", share, text))
    return found


def _repeated(name: str, parts: Sequence[FloatArray]) -> list[DataFault]:
    same = sum(int(np.count_nonzero(copied(p))) for p in parts)
    rows = sum(max(len(p) - 1, 0) for p in parts)
    share = same / max(rows, 1)
    if share < LEAST_COPIES:
        return []
    text = (
        f"{share:.0%} of the {name} rows are exact copies of the row before and were left out: the sensor is slower "
        "than the log, or the link repeats what it has; log the sensor's own samples with their own times"
    )
    return [DataFault("repeated", name, share, text)]
