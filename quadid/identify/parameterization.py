"""The free parameters of a problem and their scales."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from quadid.model.layout import Entry
from quadid.parameters import NOMINAL_NAMES

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Free:
    """The free parameters of a problem and how they are scaled.

    Nominal parameters are searched on the log scale, effects in units of their typical size.

    Attributes:
        entries: in vector order.
    """

    entries: tuple[Entry, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Dotted names."""
        return tuple(e.name for e in self.entries)

    @cached_property
    def index(self) -> NDArray[np.intp]:
        """Places in the full vector."""
        return np.array([e.index for e in self.entries], dtype=np.intp)

    @cached_property
    def is_log(self) -> NDArray[np.bool_]:
        """True for parameters on the log scale."""
        return np.array([e.name in NOMINAL_NAMES for e in self.entries], dtype=bool)

    @cached_property
    def scale(self) -> FloatArray:
        """Size of one unit of a linear parameter."""
        return np.array([e.typical for e in self.entries])

    def from_neutral(self, theta: FloatArray) -> FloatArray:
        """How far effects are from neutral at `theta`, in typical sizes, shape (parameters,)."""
        return np.asarray((theta[self.index] - np.array([e.neutral for e in self.entries])) / self.scale)

    def move(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Returns `theta` moved by the scaled step `z`, clamped to the bounds."""
        out = theta.copy()
        for e, step in zip(self.entries, z, strict=True):
            value = out[e.index] * np.exp(step) if e.name in NOMINAL_NAMES else out[e.index] + step * e.typical
            out[e.index] = min(max(value, e.lower), e.upper)
        return out

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Derivative of the parameters to z at `theta`, shape (parameters,)."""
        return np.where(self.is_log, theta[self.index], self.scale)
