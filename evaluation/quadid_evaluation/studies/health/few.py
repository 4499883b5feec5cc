"""Few baseline flights: what each verdict is worth when one, two or more healthy flights are the yardstick."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from quadid.condition import assess
from quadid_evaluation.studies.health.recorded import CRAZYFLIE, Flown, Judged, is_large

COUNTS = (1, 2, 3)
MOST = 10
"""Choices of baseline flights of an airframe, drawn where there are more."""
SEED = 5
_ANSWERS = ("changed", "unknown", "unchanged")


def chosen(healthy: Sequence[Flown], count: int) -> list[tuple[Flown, ...]]:
    """Sets of so many healthy flights, all or `MOST` of them."""
    every = list(combinations(healthy, count))
    kept = np.random.default_rng(SEED).permutation(len(every))[:MOST]
    return [every[i] for i in sorted(kept)]


def judged(flights: Sequence[Flown], airframe: str, count: int) -> Iterator[Judged]:
    """Every healthy flight and large damage against every choice of so many other healthy flights."""
    mine = [f for f in flights if f.airframe == airframe]
    for baseline in chosen([f for f in mine if f.condition == "healthy"], count):
        files = {f.file for f in baseline}
        for one in mine:
            if one.file not in files and (one.condition == "healthy" or is_large(one)):
                yield Judged(one, assess([one.trim], [f.trim for f in baseline], CRAZYFLIE))


def answer(one: Judged) -> str:
    """Changed (also where nothing explains it), unknown for want of baseline flights, or unchanged."""
    return "changed" if one.changed else "unknown" if one.health.lacking else "unchanged"


def text(flights: Sequence[Flown]) -> str:
    """Shares of each answer by number of baseline flights, as Markdown."""
    lines = []
    for airframe in sorted({f.airframe for f in flights}):
        for count in COUNTS:
            counts = Counter(
                (one.flown.condition == "healthy", answer(one)) for one in judged(flights, airframe, count)
            )
            each = ([counts[healthy, name] for name in _ANSWERS] for healthy in (True, False))
            lines.append(f"* {airframe}, {count}: {'; '.join(map(_shares, each))}")
    return "\n".join(lines)


def _shares(counts: Sequence[int]) -> str:
    total = sum(counts)
    return f"{', '.join(f'{100 * n / total:.0f}' for n in counts)} % of {total}"
