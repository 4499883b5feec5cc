"""The free parameters of a problem and their scales."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quadid.model.layout import Entry
from quadid.parameters import NOMINAL_NAMES
from quadid.types import BoolArray, FloatArray, IndexArray


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
    def index(self) -> IndexArray:
        """Places in the full vector."""
        return np.array([e.index for e in self.entries], dtype=np.intp)

    @cached_property
    def is_log(self) -> BoolArray:
        """True for parameters on the log scale."""
        return np.array([e.name in NOMINAL_NAMES for e in self.entries], dtype=bool)

    @cached_property
    def scale(self) -> FloatArray:
        """Size of one unit of a linear parameter."""
        return np.array([e.typical for e in self.entries])

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the values, shapes (parameters,)."""
        return np.array([e.lower for e in self.entries]), np.array([e.upper for e in self.entries])

    @cached_property
    def _origin(self) -> FloatArray:
        return np.where(self.is_log, 1.0, 0.0)

    def scaled(self, values: FloatArray) -> FloatArray:
        """Scaled parameters of values, last axis of both (parameters,)."""
        return self.difference(values, self._origin)

    def unscaled(self, z: FloatArray) -> FloatArray:
        """Values of scaled parameters, last axis of both (parameters,)."""
        return self.shifted(self._origin, z)

    def shifted(self, values: FloatArray, z: FloatArray) -> FloatArray:
        """Values moved by the scaled step `z`, bounds or not, last axis of all (parameters,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.where(self.is_log, values * np.exp(z), values + z * self.scale)

    def placed(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Full vector `theta` with the free entries replaced by scaled parameters `z`."""
        out = theta.copy()
        out[self.index] = self.unscaled(z)
        return out

    def step(self, theta: FloatArray, moved: FloatArray) -> FloatArray:
        """The scaled step that leads from full vector `theta` to `moved`, shape (parameters,)."""
        return self.difference(moved[self.index], theta[self.index])

    def difference(self, values: FloatArray, start: FloatArray) -> FloatArray:
        """The scaled step that leads from values `start` to `values`, shape (parameters,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.is_log, np.log(values / start), (values - start) / self.scale)

    def from_neutral(self, theta: FloatArray) -> FloatArray:
        """How far effects are from neutral at `theta`, in typical sizes, shape (parameters,)."""
        return np.asarray((theta[self.index] - np.array([e.neutral for e in self.entries])) / self.scale)

    def move(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Returns `theta` moved by the scaled step `z`, clamped to the bounds."""
        out = theta.copy()
        out[self.index] = np.minimum(np.maximum(self.shifted(out[self.index], z), self.bounds[0]), self.bounds[1])
        return out

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Derivative of the parameters to z at `theta`, shape (parameters,)."""
        return np.where(self.is_log, theta[self.index], self.scale)
