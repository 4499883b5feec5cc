"""A log of many hours: as much of it as the parameters need, so that memory and time do not grow with the log."""

from __future__ import annotations

from collections.abc import Sequence

from quadid.data.window import Window

MOST_SECONDS = 3600.0
"""Longest flight that is fitted whole [s]: an excited hour leaves some tenths of a per cent at worst."""
STRETCH = 60.0
"""Length of the stretches that are taken of a longer one [s]; each loses half a segment at its ends."""


def spread(windows: Sequence[Window]) -> tuple[list[Window], tuple[str, ...]]:
    """Stretches spread evenly over a flight that is longer than needed, and a sentence for people; else all of it."""
    total = sum(len(w) * w.dt for w in windows)
    if total <= MOST_SECONDS:
        return list(windows), ()
    share, due, count = MOST_SECONDS / total, 1.0, 0
    kept = []
    for w in windows:
        pieces = max(round(len(w) * w.dt / STRETCH), 1)
        count += pieces
        for k in range(pieces):
            if due >= 1.0:
                kept.append(w.slice(k * len(w) // pieces, (k + 1) * len(w) // pieces))
                due -= 1.0
            due += share
    return kept, (
        f"{total / 3600.0:.1f} h of flight are more than the parameters need: they come from {len(kept)} of {count} "
        f"stretches of {STRETCH:.3g} s, spread evenly",
    )  # fmt: skip
