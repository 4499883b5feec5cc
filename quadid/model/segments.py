"""How a window is cut into segments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.errors import WindowError
from quadid.types import IndexArray, IntArray


@dataclass(frozen=True)
class Segments:
    """How a window is cut for multiple shooting.

    Attributes:
        length: scored rows a segment.
        lead: rows before the first scored one, available to roll in filters and delays.
        starts: first scored row of each segment.
    """

    length: int
    lead: int
    starts: IntArray

    @classmethod
    def cut(cls, rows: int, length: int, lead: int = 1) -> Segments:
        """Cuts `rows` rows into back-to-back segments of `length`, leaving `lead` rows before the first.

        Raises:
            WindowError: when not one segment fits.
        """
        starts = np.arange(lead, rows - length, length, dtype=np.int64)
        if len(starts) == 0:
            raise WindowError(f"window of {rows} rows", f"at least {length + lead + 1} rows", "use a longer stretch")
        return cls(length, lead, starts)

    @property
    def rows(self) -> IntArray:
        """Scored rows of each segment, shape (segments, length)."""
        return self.starts[:, None] + np.arange(self.length)

    def at(self, places: IndexArray) -> Segments:
        """Returns the segments at `places`."""
        return Segments(self.length, self.lead, self.starts[places])

    def later(self, shift: int, rows: int) -> Segments:
        """Returns the segments moved `shift` rows, without those that no longer fit into a window of `rows` rows."""
        starts = self.starts + shift
        return Segments(self.length, self.lead, starts[starts < rows - self.length])
