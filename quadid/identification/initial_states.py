"""Initial states of segments: first guesses from measurements and dead reckoning, and steps along them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadid.data.window import Window
from quadid.model.rollout import Rollout, Segments
from quadid.rotation import rotated
from quadid.types import BoolArray, FloatArray, IndexArray, IntArray
from quadid.vehicle import GRAVITY

LEAK_SECONDS = 8.0
"""Time in which dead-reckoned velocity is forgotten."""
SPIKE = 20.0
"""Usual steps from one sample to the next by which a rate must be off its neighbours to be taken for a spike."""
_BLOCK = 256
_ADJACENT = 1
"""Rows before a segment at which simulation starts when no filter has to settle."""
_VELOCITY = slice(7, 10)


class Starts(NamedTuple):
    """Starts of the simulations of all segments.

    Attributes:
        x0: states, one array (segments, 13) a window.
        reckoned: velocity there as measured or by dead reckoning [m/s], one array (segments, 3) a window.
    """

    x0: tuple[FloatArray, ...]
    reckoned: tuple[FloatArray, ...]


@dataclass(frozen=True)
class InitialStates:
    """Initial states of the segments of a problem, found by a fit; what is missing is taken from measurements.

    Attributes:
        starts: by the rows between the start of the simulation and the segment (filters and delays need some).
    """

    starts: Mapping[int, Starts] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Checks whether any are known."""
        return bool(self.starts)

    def at(self, n_pre: int, rollouts: Sequence[Rollout], segments: Sequence[Segments]) -> Starts:
        """Starts `n_pre` rows before the segments; measured ones, with velocities found so far, if not known."""
        if n_pre in self.starts:
            return self.starts[n_pre]
        measured = [first_states(r, s, n_pre) for r, s in zip(rollouts, segments, strict=True)]
        reckoned = tuple(frozen(x[:, _VELOCITY].copy()) for x in measured)
        if _ADJACENT in self.starts:
            near = self.starts[_ADJACENT]
            for x, found, began in zip(measured, near.x0, near.reckoned, strict=True):
                x[:, _VELOCITY] += found[:, _VELOCITY] - began
        return Starts(tuple(frozen(x) for x in measured), reckoned)

    def replaced(self, n_pre: int, starts: Starts) -> InitialStates:
        """The same with other starts `n_pre` rows before the segments."""
        return InitialStates({**self.starts, n_pre: starts})

    def stepped(self, n_pre: int, da: FloatArray) -> InitialStates:
        """The same after the steps `da` along the tangents, shape (segments of all windows, k)."""
        old = self.starts[n_pre]
        moved = (retract(x, d) for x, d in zip(old.x0, _split(da, old.x0), strict=True))
        return self.replaced(n_pre, old._replace(x0=tuple(frozen(x) for x in moved)))

    def chosen(self, n_pre: int, better: BoolArray, other: InitialStates) -> InitialStates:
        """These states for segments where `better`, those of `other` elsewhere."""
        mine, its = self.starts[n_pre], other.starts[n_pre]
        parts = _split(better, mine.x0)
        x0 = tuple(
            frozen(np.where(take[:, None], new, old)) for take, new, old in zip(parts, mine.x0, its.x0, strict=True)
        )
        return self.replaced(n_pre, mine._replace(x0=x0))

    def taking(self, places: Sequence[IndexArray]) -> InitialStates:
        """States of some segments of each window, as `Shooting.taking`; windows of which none is kept are left out."""

        def some(arrays: tuple[FloatArray, ...]) -> tuple[FloatArray, ...]:
            return tuple(frozen(a[kept]) for a, kept in zip(arrays, places, strict=True) if len(kept))

        return InitialStates({n: Starts(some(s.x0), some(s.reckoned)) for n, s in self.starts.items()})


def frozen(array: FloatArray) -> FloatArray:
    """The same array, read-only from now on."""
    array.setflags(write=False)
    return array


def _split(rows: NDArray[Any], like: Sequence[FloatArray]) -> list[NDArray[Any]]:
    """Rows of all windows, one after the other, as one array a window."""
    return np.split(rows, np.cumsum([len(x) for x in like])[:-1])


def first_states(rollout: Rollout, segments: Segments, n_pre: int) -> FloatArray:
    """Measured initial states, rates without spikes; where velocity is not measured, that of dead reckoning."""
    x0 = rollout.initial_states(segments, n_pre)
    if rollout.window.gyro is not None:
        _without_spikes(x0, rollout.window.gyro, segments.starts - n_pre)
    if rollout.window.velocity is None:
        x0[:, 7:10] = dead_reckoning(rollout.window)[segments.starts - n_pre]
    return x0


def _without_spikes(x0: FloatArray, gyro: FloatArray, rows: IntArray) -> None:
    """Puts the median of five samples in place of an initial rate that is far from it, in place.

    Everything a segment simulates follows from its initial state; one spoilt sample there is worth a second of flight.
    """
    values = gyro[np.clip(rows[:, None] + np.arange(-2, 3), 0, len(gyro) - 1)]
    steps = np.abs(np.diff(gyro, axis=0))
    steps = steps[np.isfinite(steps).all(axis=1)]
    if not len(steps):
        return
    middle = np.median(values, axis=1)  # missing where any of the five is, and then nothing is replaced
    far = np.abs(x0[:, 4:7] - middle) > SPIKE * np.median(steps, axis=0)
    x0[:, 4:7] = np.where(far, middle, x0[:, 4:7])


def dead_reckoning(window: Window) -> FloatArray:
    """Rough velocity (n, 3) [m/s], NED: integrated specific force, leaking to zero; zeros without attitude or accel.

    The leak bounds what accelerometer and tilt errors add up to.  A starting point for fits in which velocity matters.
    """
    n = len(window)
    if window.accel is None or window.attitude is None:
        return np.zeros((n, 3))
    q, f = window.attitude, window.accel
    good = np.isfinite(q).all(axis=1) & np.isfinite(f).all(axis=1)
    acceleration = rotated(q, f) + np.array([0.0, 0.0, GRAVITY])
    acceleration[~good] = 0.0
    keep = float(np.exp(-window.dt / LEAK_SECONDS))
    out = window.dt * acceleration
    # v_k = keep v_k-1 + step_k, a block of rows at a time: there keep^-k is a number of moderate size.
    fading = keep ** np.arange(_BLOCK)[:, None]
    for first in range(0, n, _BLOCK):
        part = out[first : first + _BLOCK]
        if first:
            part[0] += keep * out[first - 1]
        part[:] = np.cumsum(part / fading[: len(part)], axis=0) * fading[: len(part)]
    return np.asarray(out)


def retract(x0: FloatArray, da: FloatArray) -> FloatArray:
    """Steps initial states (segments, 13) along tangents (segments, k): rotation vector, rate, velocity, position."""
    out = x0.copy()
    half = 0.5 * da[:, :3]
    dq = np.column_stack([np.ones(len(half)), half])
    dq /= np.linalg.norm(dq, axis=1, keepdims=True)
    w, v = x0[:, 0], x0[:, 1:4]
    dw, dv = dq[:, 0], dq[:, 1:]
    out[:, 0] = w * dw - np.sum(v * dv, axis=1)
    out[:, 1:4] = w[:, None] * dv + dw[:, None] * v + np.cross(v, dv)
    k = da.shape[1]
    out[:, 4 : 4 + k - 3] += da[:, 3:]
    return out
