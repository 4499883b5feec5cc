"""When a sensor is at the end of its range: the one rule for inspection, online windows and diagnosis.

A saturated axis piles up at exactly its largest or smallest value, far more often than at the value beside it, and
comes back to it again and again.  Coarse steps of a converter pile up nowhere in particular, and a motor at rest stays
at its lowest command without coming back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadid.types import FloatArray

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
