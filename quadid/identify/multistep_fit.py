"""Parameters that predict: least mean error of open-loop runs from measured states.

The most likely parameters of a model that lacks something need not predict well: what is fitted there are seconds whose
initial states are free, and squares, of which the liveliest flight has most.  Here the error that a prediction is
judged by is made as small as it gets: Euclidean, a tenth to half a second after a measured state, as a share of what
predicting no change would miss by in the same flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.errors import NotIdentifiableError
from quadid.identify.gauss_newton import bounded_step, scaled_difference
from quadid.identify.open_loop import OpenLoop, lengths, mean_of_known
from quadid.identify.parameterization import Free
from quadid.model import layout as ix
from quadid.parameters import impossible_inertia
from quadid.vehicle import Vehicle
from quadid.window import Window

FloatArray = NDArray[np.float64]

STAGES = ((0.1,), (0.1, 0.2, 0.3), (0.1, 0.2, 0.3, 0.4, 0.5))
"""Times after the start [s] at which errors count, near ones first: there even a poor start is nearly linear."""
MOST_RUNS = 1500
"""Of longer logs every n-th run."""
ITERATIONS = 20
_ENOUGH = 1e-4
"""Relative fall of the error below which a stage ends."""
_NEAR = 0.05
"""Errors below this share of no change weigh as if they were as large; keeps the weights finite."""
_CALM = 0.1
"""A flight counts as if no change missed by at least this share of what it misses by in all flights."""
_STEP = 1e-3
"""Scaled step of the differences."""
_DAMPING = (1e-3, 1e-9, 1e6)
"""First, least and most damping of a step, relative to the curvature."""


@dataclass(frozen=True)
class Ahead:
    """Outcome of a fit: the full vector, and the mean error as a share of no change."""

    theta: FloatArray
    share: float


def fit_ahead(windows: Sequence[Window], vehicle: Vehicle, free: Free, starts: Sequence[FloatArray]) -> Ahead:
    """Fits `free` so that runs from measured states miss by as little as possible.

    Args:
        windows: flights, on one grid.
        vehicle: geometry and mass.
        free: parameters, none of which may change what the gyro reads.  Without a measured velocity only ratios of
            thrust, torque and inertia show.
        starts: full vectors to start from, shape (size,) each; the best end wins.

    Raises:
        NotIdentifiableError: no run fits into any window, or there is no way on from any start.
    """
    problems = [p for p in (_Problem(windows, vehicle, free, seconds) for seconds in STAGES) if p.counts.any()]
    ends = []
    for theta in starts:
        share = np.inf
        for problem in problems:
            theta, share = problem.descend(theta)
        ends.append(Ahead(theta, share))
    best = min(ends, key=lambda end: end.share, default=Ahead(np.empty(0), np.inf))
    if not np.isfinite(best.share):
        raise NotIdentifiableError(
            "every simulation runs away within half a second, or its inertias are of no rigid body",
            "a flight that the vehicle file can simulate",
            "check mass, inertias, rotor positions and the unit of the rotor signal",
        )  # fmt: skip
    return best


class _Problem:
    """Errors at some times after the start, over all flights."""

    def __init__(self, windows: Sequence[Window], vehicle: Vehicle, free: Free, seconds: Sequence[float]) -> None:
        dt = windows[0].dt
        self.free = free
        self.at = np.unique(np.maximum(np.round(np.array(seconds) / dt).astype(int), 1))
        longest = int(self.at[-1])
        every = max(-(-sum(len(w) for w in windows) // MOST_RUNS), 1)
        self.loops = [loop for w in windows if len((loop := OpenLoop(w, vehicle, longest, every)).rows)]
        if not self.loops:
            raise NotIdentifiableError(
                f"no run of {longest * dt:g} s fits: measured rate, and no gap after it",
                f"stretches longer than {longest * dt:g} s with gyro", "log without gaps",
            )  # fmt: skip
        self.scales = _scales(self.loops, self.at)
        self.counts = np.sum([loop.counted(loop.rows, self.at).sum(axis=0) for loop in self.loops], axis=0)

    def descend(self, theta: FloatArray) -> tuple[FloatArray, float]:
        """Gauss-Newton steps on reweighted errors, damped until each lowers their mean; the end, and the mean there."""
        share = self.share(theta)
        first, least, most = _DAMPING
        damping = first
        for _ in range(ITERATIONS):
            h, g = self.equations(theta)
            moved, lower = theta, np.inf
            while damping < most:
                damped = h + damping * np.diag(np.maximum(np.diag(h), np.finfo(float).tiny))
                moved = self.free.move(theta, bounded_step(self.free, theta, damped, g))
                lower = self.share(moved)
                if lower < share:
                    break
                damping = max(10.0 * damping, first)
            if not lower < share:
                break
            done = share - lower < _ENOUGH * share
            theta, share, damping = moved, lower, max(damping / 10.0, least)
            if done:
                break
        return theta, share

    def share(self, theta: FloatArray) -> float:
        """Mean error as a share of no change; infinite where a run went away or no rigid body has such inertias."""
        if impossible_inertia(theta[[ix.JXX, ix.JYY, ix.JZZ]].tolist()):
            return np.inf
        shares = [
            lengths(loop.misses(theta[None], self.at)[0]) / scale
            for loop, scale in zip(self.loops, self.scales, strict=True)
        ]
        return float(np.mean(mean_of_known(np.concatenate(shares))[self.counts > 0]))

    def equations(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Curvature (P, P) and half the slope (P,) of the summed errors.

        An error weighs by its own inverse, so that squares stand for lengths (Weiszfeld); runs that went away are left
        out.
        """
        p = len(self.free.entries)
        scaled = np.eye(p) * _STEP
        ends = np.stack([theta, *(self.free.move(theta, z) for z in (*scaled, *-scaled))])
        widths = np.array([scaled_difference(self.free, ends[1 + p + i], ends[1 + i])[i] for i in range(p)])
        h, g = np.zeros((p, p)), np.zeros(p)
        for loop, scale in zip(self.loops, self.scales, strict=True):
            misses = loop.misses(ends, self.at)
            usable = np.asarray(np.isfinite(misses).all(axis=(0, 4)))
            share = lengths(misses[0]) / scale
            weight = np.where(usable, 1.0 / np.maximum(share, _NEAR), 0.0) / np.maximum(self.counts, 1)
            root = (np.sqrt(weight) / scale)[..., None]
            residual = np.where(usable[..., None], misses[0], 0.0) * root
            with np.errstate(invalid="ignore"):
                slope = (misses[1 : 1 + p] - misses[1 + p :]) / widths[:, None, None, None, None]
            j = (np.where(usable[..., None], slope, 0.0) * root).reshape(p, -1)
            h, g = h + j @ j.T, g + j @ residual.ravel()
        return h, g


def _scales(loops: Sequence[OpenLoop], at: NDArray[np.intp]) -> list[FloatArray]:
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
