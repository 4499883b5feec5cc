"""Parameters that predict: least mean error of open-loop runs from measured states.

The most likely parameters of a model that lacks something need not predict well: what is fitted there are seconds whose
initial states are free, and squares, of which the liveliest flight has most.  Here the error that a prediction is
judged by is made as small as it gets: Euclidean, a tenth to half a second after a measured state, as a share of what
predicting no change would miss by in the same flight.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.errors import NotIdentifiableError
from quadid.identify.free import Free
from quadid.identify.open_loop import OpenLoop, mean_of_known
from quadid.identify.polish import bounded_step, scaled_difference
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
_LENGTH_CURVES = 2.0 / 3.0
"""Curvature of a length in space to that of the weighted square that stands for it: along itself it has none."""
_BLOCK_SECONDS = 2.0
"""Runs that start within such a block count as one when deviations are estimated; four times as long as a run."""


@dataclass(frozen=True)
class Ahead:
    """Outcome of a fit.

    Attributes:
        theta: full vector.
        share: mean error as a share of no change.
        sigma: standard deviation of each scaled parameter between flights like these, shape (P,): blocks of runs taken
            as independent, whatever the model lacks included.
    """

    theta: FloatArray
    share: float
    sigma: FloatArray


def fit_ahead(windows: Sequence[Window], vehicle: Vehicle, free: Free, starts: Sequence[FloatArray]) -> Ahead:
    """Fits `free` so that runs from measured states miss by as little as possible.

    Args:
        windows: flights; those of one name belong together.
        vehicle: geometry and mass.
        free: parameters, none of which may change what the gyro reads.
        starts: full vectors to start from, shape (size,) each; the best end wins.

    Raises:
        NotIdentifiableError: no run fits into any window, or every start runs away.
    """
    best: Ahead | None = None
    for theta in starts:
        for seconds in STAGES:
            problem = _Problem(windows, vehicle, free, seconds)
            theta, share = problem.descend(theta)
        if np.isfinite(share) and (best is None or share < best.share):
            best = Ahead(theta, share, problem.sigma(theta))
    if best is None:
        raise NotIdentifiableError(
            "every simulation runs away within half a second", "a flight that the vehicle file can simulate",
            "check mass, rotor positions and the unit of the rotor signal",
        )  # fmt: skip
    return best


class _Problem:
    """Errors at some times after the start, over all flights."""

    def __init__(self, windows: Sequence[Window], vehicle: Vehicle, free: Free, seconds: Sequence[float]) -> None:
        dt = windows[0].dt
        self.free = free
        self.at = np.unique(np.maximum(np.round(np.array(seconds) / dt).astype(int), 1))
        longest = int(self.at[-1])
        every = max(sum(len(w) for w in windows) // MOST_RUNS, 1)
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
        damping, least, most = _DAMPING
        for _ in range(ITERATIONS):
            h, g = (np.sum(part, axis=0) for part in zip(*self.equations(theta), strict=True))
            moved, lower = theta, np.inf
            while damping < most:
                damped = h + damping * np.diag(np.maximum(np.diag(h), np.finfo(float).tiny))
                moved = self.free.move(theta, bounded_step(self.free, theta, damped, g))
                lower = self.share(moved)
                if lower < share:
                    break
                damping = max(10.0 * damping, _DAMPING[0])
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
        shares = [self._shares(loop, loop.misses(theta[None], self.at)[0]) for loop in self.loops]
        return float(np.nanmean(mean_of_known(np.concatenate(shares))))

    def equations(self, theta: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yields curvature (P, P) and half the slope (P,) of the summed errors of each block of runs.

        An error weighs by its own inverse, so that squares stand for lengths (Weiszfeld); runs that went away are left
        out.
        """
        scaled = np.eye(len(self.free.entries)) * _STEP
        ends = np.stack([theta, *(self.free.move(theta, z) for z in (*scaled, *-scaled))])
        p = len(scaled)
        widths = np.array([
            scaled_difference(self.free, ends[1 + p + i], ends[1 + i])[i] for i in range(p)
        ])  # fmt: skip
        for loop in self.loops:
            misses = loop.misses(ends, self.at)
            usable = np.asarray(np.isfinite(misses).all(axis=(0, 4)))
            weight = np.where(usable, 1.0 / np.maximum(self._shares(loop, misses[0]), _NEAR), 0.0)
            root = (np.sqrt(weight / np.maximum(self.counts, 1)) / self.scales[loop.window.name])[..., None]
            residual = np.where(usable[..., None], misses[0], 0.0) * root
            with np.errstate(invalid="ignore"):
                slope = (misses[1 : 1 + p] - misses[1 + p :]) / widths[:, None, None, None, None]
            slope = np.where(usable[..., None], slope, 0.0) * root
            block = (loop.rows * loop.window.dt / _BLOCK_SECONDS).astype(int)
            for b in np.unique(block):
                j, r = slope[:, block == b].reshape(p, -1), residual[block == b].ravel()
                yield j @ j.T, j @ r

    def sigma(self, theta: FloatArray) -> FloatArray:
        """Standard deviation of each scaled parameter: curvature around the products of the blocks' slopes."""
        h, g = (np.stack(part) for part in zip(*self.equations(theta), strict=True))
        inverse = np.linalg.pinv(_LENGTH_CURVES * h.sum(axis=0), hermitian=True)
        return np.asarray(np.sqrt(len(g) / max(len(g) - 1, 1) * np.diag(inverse @ (g.T @ g) @ inverse)))

    def _shares(self, loop: OpenLoop, misses: FloatArray) -> FloatArray:
        """Lengths of misses (starts, at, 4, 3) as shares of no change, shape (starts, at, 4); NaN: not measured."""
        return np.asarray(np.linalg.norm(misses, axis=-1) / self.scales[loop.window.name])


def _scales(loops: Sequence[OpenLoop], at: NDArray[np.intp]) -> dict[str, FloatArray]:
    """What no change misses by in the flights of each name, shape (at, 4)."""
    still: dict[str, list[FloatArray]] = {}
    for loop in loops:
        still.setdefault(loop.window.name, []).append(loop.no_change(at))
    everywhere = mean_of_known(np.concatenate([e for errors in still.values() for e in errors]))
    floor = np.where(everywhere > 0.0, everywhere, 1.0) * _CALM
    return {name: np.fmax(mean_of_known(np.concatenate(errors)), floor) for name, errors in still.items()}
