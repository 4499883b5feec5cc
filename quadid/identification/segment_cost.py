"""The quadratic model of every segment's cost, initial states eliminated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quadid.identification.initial_states import InitialStates, frozen
from quadid.types import FloatArray, IndexArray

_LONGEST_STEP = np.array([0.5] * 3 + [10.0] * 3 + [15.0] * 3 + [50.0] * 3)
"""Longest step of an initial state: rad, rad/s, m/s, m."""


@dataclass(frozen=True)
class Linearised:
    """Per-segment quadratic model of the cost in the free parameters, initial states eliminated.

    Attributes:
        gram: shape (segments, P, P); grad: (segments, P); cost: (segments,), all for scaled parameters z:
            ``cost(z) = cost + 2 grad z + z gram z``.
        occam: what freeing unmeasured initial velocities costs, shape (segments,): the log-determinant that turns the
            profile deviance into the marginal one; added when models are compared, zero where velocity matters not.
        rows: independent residuals of each segment, measured samples less fitted initial-state directions.
        residuals: predicted - measured at the linearisation point, channel units, (segments, length, channels).
        weights: 1 where measured (times robust weight), 0 elsewhere, same shape.
        back: what gives the initial-state steps back: (offset (segments, k), slope (segments, k, P)).
        window: index of the window of each segment; time: its first scored time [s].
        states: initial states it was linearised at.
        n_pre: rows between the start of the simulation and the segment.
    """

    gram: FloatArray
    grad: FloatArray
    cost: FloatArray
    occam: FloatArray
    rows: FloatArray
    residuals: FloatArray
    weights: FloatArray
    back: tuple[FloatArray, FloatArray]
    window: IndexArray
    time: FloatArray
    states: InitialStates
    n_pre: int

    @cached_property
    def information(self) -> FloatArray:
        """Of all segments on the scaled parameters, shape (P, P), read-only."""
        return frozen(self.gram.sum(axis=0))

    @cached_property
    def gradient(self) -> FloatArray:
        """Half the slope of the cost of all segments, shape (P,), read-only."""
        return frozen(self.grad.sum(axis=0))

    @cached_property
    def total_cost(self) -> float:
        """Cost of all segments."""
        return float(self.cost.sum())

    @cached_property
    def total_rows(self) -> float:
        """Independent residuals of all segments."""
        return float(self.rows.sum())

    @property
    def spacing(self) -> float:
        """Time from one segment to the next [s]; 1 s where there is one only."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 1.0

    @property
    def reduced_chi_square(self) -> float:
        """Cost per independent residual; 1 at the noise floor."""
        return self.total_cost / max(self.total_rows, 1.0)

    def stepped(self, z: FloatArray | None = None) -> InitialStates:
        """Initial states after the scaled parameter step `z`, or with parameters held."""
        offset, slope = self.back
        da = -(offset if z is None else offset + slope @ z)
        limit = _LONGEST_STEP[: da.shape[1]]
        return self.states.stepped(self.n_pre, np.clip(da, -limit, limit))
