"""Errors of runs from measured states, as a share of what predicting no change would miss by in the same flight.

The error that a prediction is judged by: Euclidean, a tenth to half a second after a measured state.  Its slopes along
residual terms serve whoever makes it small.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from quadid.data.window import Window
from quadid.errors import NotIdentifiableError
from quadid.identification.open_loop import OpenLoop, lengths, mean_of_known
from quadid.identification.term_sensitivity import term_sensitivity
from quadid.model.layout import Layout
from quadid.types import FloatArray, IndexArray, SingleArray
from quadid.vehicle import ResidualTerm, Vehicle

STAGES = ((0.1,), (0.1, 0.2, 0.3), (0.1, 0.2, 0.3, 0.4, 0.5))
"""Times after the start [s] at which errors count, near ones first: there even a poor start is nearly linear."""
_NEAR = 0.05
"""Errors below this share of no change weigh as if they were as large; keeps the weights finite."""
_CALM = 0.1
"""A flight counts as if no change missed by at least this share of what it misses by in all flights."""


class MultistepErrors:
    """Errors at some times after the start, over all flights."""

    def __init__(self, windows: Sequence[Window], vehicle: Vehicle, seconds: Sequence[float], most: int) -> None:
        """Prepares runs.

        Args:
            windows: flights, on one grid.
            vehicle: physics, with residual terms or without.
            seconds: times after the start at which errors count.
            most: runs at most; of longer logs every n-th.

        Raises:
            NotIdentifiableError: no run fits into any window.
        """
        dt = windows[0].dt
        self.at = np.unique(np.maximum(np.round(np.array(seconds) / dt).astype(int), 1))
        longest = int(self.at[-1])
        every = max(-(-sum(len(w) for w in windows) // most), 1)
        self._vehicle, self._theta = vehicle, Layout(vehicle).initial(vehicle)
        self._loops = [loop for w in windows if len((loop := OpenLoop(w, vehicle, longest, every)).rows)]
        if not self._loops:
            raise NotIdentifiableError(
                f"no run of {longest * dt:g} s fits: measured rate, and no gap after it",
                f"stretches longer than {longest * dt:g} s with gyro", "log without gaps",
            )  # fmt: skip
        self._scales = _scales(self._loops, self.at)
        self._counts = np.sum([loop.counted(loop.rows, self.at).sum(axis=0) for loop in self._loops], axis=0)

    @cached_property
    def _misses(self) -> list[FloatArray]:
        """What the runs of each loop miss by, shape (starts, at, 4, 3)."""
        return [loop.misses(self._theta[None], self.at)[0] for loop in self._loops]

    def share(self) -> float:
        """Mean error as a share of no change; infinite where a run went away."""
        shares = [lengths(misses) / scale for misses, scale in zip(self._misses, self._scales, strict=True)]
        return float(np.mean(mean_of_known(np.concatenate(shares))[self._counts > 0]))

    def slopes(self, candidates: tuple[ResidualTerm, ...]) -> tuple[SingleArray, FloatArray]:
        """Slopes (P, M) along candidates in units of their sizes, and errors (M,), weighted so that squares sum errors.

        An error weighs by its own inverse, so that squares stand for lengths (Weiszfeld); runs that went away are left
        out.
        """
        slopes, errors = [], []
        for loop, misses, scale in zip(self._loops, self._misses, self._scales, strict=True):
            slope = term_sensitivity(loop, self._vehicle, candidates, self.at)
            usable = np.asarray(np.isfinite(misses).all(axis=3) & np.isfinite(slope).all(axis=(3, 4)))
            weight = np.where(usable, 1.0 / np.maximum(lengths(misses) / scale, _NEAR), 0.0)
            root = (np.sqrt(weight / np.maximum(self._counts, 1)) / scale)[..., None]
            errors.append((np.where(usable[..., None], misses, 0.0) * root).ravel())
            slope[~usable] = 0.0
            slope *= root[..., None]
            slopes.append(slope.reshape(-1, len(candidates)))
        return np.concatenate(slopes).T, np.concatenate(errors)


def _scales(loops: Sequence[OpenLoop], at: IndexArray) -> list[FloatArray]:
    """What no change misses by in the flight of each loop, shape (at, 4)."""
    flights = [(loop.window.name, loop.window.log_span) for loop in loops]
    still = [loop.no_change(at) for loop in loops]
    everywhere = mean_of_known(np.concatenate(still))
    floor = np.where(everywhere > 0.0, everywhere, 1.0) * _CALM
    means = {
        flight: mean_of_known(np.concatenate([e for e, own in zip(still, flights, strict=True) if own == flight]))
        for flight in set(flights)
    }
    return [np.fmax(means[flight], floor) for flight in flights]
