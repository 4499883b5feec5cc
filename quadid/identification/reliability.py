"""Consistency of estimates across parts of the data and models.

Blocks of time, every second row, and models with each cause added that the residual asks for, all estimate the same
parameters.  What they differ by beyond chance belongs to the model, not to the noise:
intervals are widened by it, between blocks as random effects (DerSimonian and Laird, Controlled Clinical Trials 7
(1986) 177), and beyond `SPREAD_LIMIT` the number is not to be used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadid.chi_square import exceeded
from quadid.data.window import Window
from quadid.identification.problem import Free
from quadid.identification.uncertainty import SPREAD_LIMIT, Uncertainty
from quadid.rotation import continuous_sign
from quadid.types import FloatArray

# --- The same flight on a grid twice as coarse: how much a parameter depends on what the inputs do within a row
#
# A log holds one value of each input a row; what it does within the row is not known.  What that changes grows with the
# square of the row's length: feedback that runs on within held commands, behind a lag or a delay, looks like another
# inertia by that much.  Every second row of the same data therefore shows three times what the rows at hand may be off
# by (Richardson, Phil. Trans. R. Soc. A 210 (1911) 307).  Of readings, what turns too fast for them is at fault: every
# second row of a low-pass over all channels is without it.


SHARE = 1.0 / 3.0
"""Of the difference between two grids, of which one is twice as coarse, that the finer one is off by."""


SLOW, REACH = 1.0 / 6.0, 9
"""Cutoff of the low-pass before readings are halved, as a share of their rate, and the rows that it reaches."""


def coarse(window: Window) -> Window:
    """Every second row of `window`; forces and held speeds are means over the longer rows, readings low-passed."""
    window = window if window.sampling == "held" else _slow(window)
    n = len(window) // 2 * 2
    even: dict[str, Any] = {name: None if (x := getattr(window, name)) is None else x[:n:2] for name in _REFERENCES}
    even |= {name: None if (x := getattr(window, name)) is None else _every_second(x[:n]) for name in _INSTANTS}
    if window.attitude is not None:
        between = np.isnan(window.attitude[:n:2, 0])
        even["attitude"][between] /= np.linalg.norm(even["attitude"][between], axis=1, keepdims=True)
    accel = None if window.accel is None else _every_second(_smoothed(window.accel)[:n])
    speed, slope = window.rotor_speed[:n:2], None
    if window.sampling == "held":
        first, second = window.rotor_speed[:n:2], window.rotor_speed[1:n:2]
        speed = np.sqrt(0.5 * (first**2 + second**2))  # what thrust and drag torque are means of
        if window.rotor_slope is not None:
            own = window.rotor_slope[:n:2] + window.rotor_slope[1:n:2]
            slope = 0.75 * (second - first) / window.dt + 0.125 * own  # of the straight line with the same moment
    return replace(window, dt=2.0 * window.dt, rotor_speed=speed, rotor_slope=slope, accel=accel, **even)


def _slow(window: Window) -> Window:
    """Readings and all channels that are measured in every row, behind one low-pass without delay."""
    reach = min(REACH, len(window) - 1)
    taps = np.sinc(2.0 * SLOW * np.arange(-reach, reach + 1)) * np.hamming(2 * reach + 1)
    taps /= taps.sum()

    def passed(values: FloatArray) -> FloatArray:
        wide = np.pad(values, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
        return np.column_stack([np.convolve(column, taps, mode="valid") for column in wide.T])

    whole = {name: x for name in _INSTANTS if (x := getattr(window, name)) is not None and np.isfinite(x).all()}
    out: dict[str, Any] = {n: passed(continuous_sign(x) if n == "attitude" else x) for n, x in whole.items()}
    if "attitude" in out:
        out["attitude"] /= np.linalg.norm(out["attitude"], axis=1, keepdims=True)
    if window.accel is not None and np.isfinite(window.accel).all():
        out["accel"] = passed(window.accel)
    return replace(window, rotor_speed=np.sqrt(np.maximum(passed(window.rotor_speed**2), 0.0)), **out)


_INSTANTS = ("gyro", "attitude", "velocity", "position")
_REFERENCES = ("battery", "attitude_reference")


def _every_second(values: FloatArray) -> FloatArray:
    """Every second row; of a channel slower than the rows also what was measured between, on the line through it.

    Otherwise nothing may be left: 25 Hz on rows of 50 Hz can lie in the odd ones alone.
    """
    known = np.asarray(np.isfinite(values).all(axis=1))
    rows, out = np.flatnonzero(known), values[::2].copy()
    if 0 < 2 * len(rows) <= len(known):
        between = np.flatnonzero(~known[::2] & known[1::2])
        between = between[2 * between > rows[0]]
        for c, column in enumerate(values.T):
            out[between, c] = np.interp(2 * between, rows, column[rows])
    return out


def _smoothed(accel: FloatArray) -> FloatArray:
    """Means over two rows around each row, where both neighbours are known."""
    wide = np.pad(accel, ((1, 1), (0, 0)), constant_values=np.nan)
    mean = 0.25 * wide[:-2] + 0.5 * accel + 0.25 * wide[2:]
    return np.asarray(np.where(np.isnan(mean), accel, mean))


# --- Estimates compared


BLOCKS = 6
"""Blocks of time that are compared; enough that their spread is known to a third."""
CHANCE = 0.01
"""Probability with which a difference of right estimates is taken for one of the model."""
NEAR_BEST = 0.15
"""Share of what the best cause promises below which another is no rival to it."""
WIDE = 0.7
"""Standard deviation of a prior (scaled parameters) that leaves the data to themselves."""


@dataclass(frozen=True)
class Reliability:
    """Differences of estimates of the parameters, beyond chance.

    Attributes:
        spread: standard deviation between estimates, scaled parameters, shape (P,).
        widening: of the estimate itself, shape (P,): of many blocks their mean is known better than each.
        steps: from the fit to other estimates, shape (estimates, P); names: what was different.
        missed: it misses the flight by so much that no number is to be used.
    """

    spread: FloatArray
    widening: FloatArray
    steps: FloatArray
    names: tuple[str, ...]
    missed: bool

    def widened(self, unc: Uncertainty) -> Uncertainty:
        """Intervals that hold what the estimates differ by."""
        return unc.widened(self.widening, np.full(len(self.spread), np.inf) if self.missed else self.spread)

    def reasons(self, free: Free) -> tuple[str, ...]:
        """Sentences on the nominal parameters whose estimates differ too much."""
        if self.missed:
            return ("the model is so far from this flight that its numbers are not to be used",)
        why: dict[str, list[str]] = {}
        for j in np.flatnonzero((self.spread > SPREAD_LIMIT) & free.is_log):
            k = int(np.argmax(np.abs(self.steps[:, j]))) if len(self.steps) else -1
            close = k < 0 or abs(self.steps[k, j]) < self.spread[j]
            how = f"more than {SPREAD_LIMIT:.0%} different {'between parts of the flight' if close else self.names[k]}"
            why.setdefault(how, []).append(free.names[j])
        return tuple(f"{', '.join(n)}: {how}" for how, n in why.items())


def random_effects(steps: FloatArray, variances: FloatArray) -> FloatArray:
    """Standard deviation that differences between blocks, beyond chance, add to that of the estimate, shape (P,).

    An estimate of all blocks lies amid theirs, unless they differ in another parameter: then that one is a compromise,
    and what moves with it agrees between blocks on another value.  Where that lies beyond `SPREAD_LIMIT`, how far it
    lies off counts as well.

    Args:
        steps: from the estimate to that of each block, shape (blocks, P).
        variances: of these, shape (blocks, P).
    """
    # Variance between blocks from the excess of Q over its degrees of freedom.
    count, weight = len(steps), 1.0 / variances
    total = weight.sum(axis=0)
    q = np.sum(weight * (steps - np.sum(weight * steps, axis=0) / total) ** 2, axis=0)
    excess = np.maximum(q - (count - 1), 0.0) / (total - np.sum(weight**2, axis=0) / total)
    tau = np.where(q > exceeded(CHANCE, count - 1), np.sqrt(excess), 0.0)
    # Their mean with it, and where it lies off by more than chance and too far.
    weight = 1.0 / (variances + tau**2)
    mean, variance = np.sum(weight * steps, axis=0) / weight.sum(axis=0), 1.0 / weight.sum(axis=0)
    off = np.where(mean**2 > np.maximum(exceeded(CHANCE, 1) * variance, SPREAD_LIMIT**2), np.abs(mean), 0.0)
    return np.asarray(np.sqrt(np.maximum(variance - 1.0 / total, 0.0) + off**2))


def promised(
    best: Callable[[list[int]], tuple[FloatArray, float]], own: list[int], causes: Mapping[str, list[int]]
) -> list[tuple[str, float, FloatArray]]:
    """Each cause, how much of the cost it takes away, and the step of the parameters beside it.

    Args:
        best: step of the entries at these places, and how much of the cost it takes away.
        own: places of what is free already, shape (P,); both are beyond what these take away alone.
        causes: places of the entries of each.
    """
    none, start = best(own)
    out = []
    for name, entries in causes.items():
        step, gain = best([*own, *entries])
        out.append((name, gain - start, step[: len(own)] - none))
    return out
