"""What frame numbers tell of who sent them: one sender counts from 0 to 255 over and over, two do so each by itself."""

from __future__ import annotations

import numpy as np

from quadid.types import IntArray

FAR = 8
"""Frame numbers that jump by no more come from frames that are lost, late or there twice."""
FEWEST, SHARE = 6, 3
"""Two rows are seen by more returns than so many, and than one in so many jumps: of one sender whose frames are lost it
is one in thirty, and of two every second one, or each where the second one counts its frames."""


def two_rows(number: IntArray) -> bool:
    """Whether frame numbers of one id jump to and fro between two rows: jumps land where an earlier one had left off.

    Numbers of one sender jump over what was lost, and seldom return to where they were before.

    Args:
        number: frame numbers, 0 to 255, in the order in which the frames came, shape (n,).
    """
    step = np.diff(number) % 256
    jumps = np.flatnonzero((step > FAR) & (step < 256 - FAR))
    onward = (number[jumps[1:] + 1] - number[jumps[:-1]]) % 256
    returns = int(np.count_nonzero((onward >= 1) & (onward <= FAR)))
    return returns > max(FEWEST, len(jumps) // SHARE)
