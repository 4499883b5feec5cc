"""The identification as a plain problem in a box, for optimisers that know nothing of vehicles.

Coordinates are logarithms of the free parameters.  The residual is that of short segments with their initial states
projected out at the start (variable projection), as the swarm sees it; half its sum of squares is the cost.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadid.errors import NotIdentifiableError
from quadid.identify.fit import SWARM_SECONDS
from quadid.identify.shooting import Shooting
from quadid.model.kernel import LANES
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Window

SEGMENTS = 400
"""Most segments, spread evenly."""


class BoxProblem:
    """Residual and cost of the paper's six parameters on flight data.

    Attributes:
        lower: bounds of the logarithms, shape (6,).
        upper: likewise.
        start: the vehicle file's guess, shape (6,).
    """

    def __init__(self, windows: Sequence[Window], vehicle: Vehicle) -> None:
        """Cuts `windows` into short segments, at most about `SEGMENTS` of them.

        Raises:
            NotIdentifiableError: no stretch is long enough.
        """
        shooting = Shooting.cut(windows, vehicle, SWARM_SECONDS)
        if not shooting.rollouts:
            raise NotIdentifiableError("no stretch is long enough to be fitted", "1 s without gaps")
        self._shooting = shooting = shooting.at_most(SEGMENTS)
        self._theta = shooting.layout.initial(vehicle)
        self._free, none = shooting.free(NOMINAL_NAMES), shooting.free([])
        self._bases = [np.ascontiguousarray(c.basis) for c in shooting.columns(self._theta, none)]
        self._n_pre = shooting.start_of(self._theta, none)[0]
        self._x0 = [x.copy() for x in shooting.starts(self._n_pre).x0]
        self.lower, self.upper = np.log(vehicle.bounds).T
        self.start = np.clip(self._free.scaled(vehicle.initial), self.lower, self.upper)

    def theta(self, point: FloatArray) -> FloatArray:
        """Full parameter vector of a point, shape (size,)."""
        return self._free.placed(self._theta, point)

    def residual(self, points: FloatArray) -> FloatArray:
        """Residuals in standard deviations, shapes (k, 6) -> (k, samples)."""
        thetas = np.array([self.theta(p) for p in points])
        s = self._shooting
        sigma = np.sqrt(s.noise.variance)
        parts = []
        for rollout, segments, x0, basis in zip(s.rollouts, s.segments, self._x0, self._bases, strict=True):
            weights = rollout.valid[segments.rows][..., : s.channels] / sigma
            out, _ = rollout.roll(segments, thetas, x0, None, self._n_pre)
            flat = (out[..., : s.channels, :] * weights[..., None]).reshape(*out.shape[:2], -1, LANES)
            flat = flat - np.matmul(basis, np.matmul(basis.transpose(0, 2, 1), flat))
            parts.append(flat.transpose(0, 3, 1, 2).reshape(-1, flat.shape[1] * flat.shape[2])[: len(points)])
        return np.concatenate(parts, axis=1)

    def cost(self, points: FloatArray) -> FloatArray:
        """Half the sum of squared residuals, shapes (k, 6) -> (k,)."""
        return np.asarray(0.5 * np.sum(self.residual(points) ** 2, axis=1))
