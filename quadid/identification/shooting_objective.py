"""The identification as a plain problem in a box, for general optimisers.

Coordinates are logarithms of the free parameters.  The residual is that of short segments with their initial states
projected out at the start (variable projection), as the swarm sees it; half its sum of squares is the cost.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadid.data.window import Window
from quadid.errors import NotIdentifiableError
from quadid.identification.fit import SWARM_SECONDS
from quadid.identification.global_search import Projected
from quadid.identification.shooting import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

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
        self._theta, self._free = shooting.layout.initial(vehicle), shooting.free(NOMINAL_NAMES)
        self._projected = Projected(shooting, self._theta, self._free, SEGMENTS)
        self.lower, self.upper = np.log(vehicle.bounds).T
        self.start = np.clip(self._free.scaled(vehicle.initial), self.lower, self.upper)

    def theta(self, point: FloatArray) -> FloatArray:
        """Full parameter vector of a point, shape (size,)."""
        return self._free.placed(self._theta, point)

    def residual(self, points: FloatArray) -> FloatArray:
        """Residuals in standard deviations, shapes (k, 6) -> (k, samples)."""
        return self._projected.residuals(np.array([self.theta(p) for p in points]))

    def cost(self, points: FloatArray) -> FloatArray:
        """Half the sum of squared residuals, shapes (k, 6) -> (k,)."""
        return 0.5 * self._projected.costs(np.array([self.theta(p) for p in points]))
