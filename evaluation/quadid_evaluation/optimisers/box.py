"""The identification as a plain problem in a box, for general optimisers.

Coordinates are logarithms of the free parameters.
"""

from collections.abc import Sequence

import numpy as np

from quadid.data.window import Window
from quadid.errors import NotIdentifiableError
from quadid.identification.fit import SWARM_SECONDS, Fit, Projected
from quadid.identification.gauss_newton import Convergence
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Free, Shooting, default_prior, posterior_covariance
from quadid.identification.result import settle_states
from quadid.identification.uncertainty import parameter_set, uncertainty
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

FIT_SECONDS = 1.0
"""Length of the segments on which the answer of a search is judged [s]."""
SEGMENTS = 400
"""Most segments, spread evenly."""


class Box:
    """The paper's six parameters of a vehicle.

    Attributes:
        lower: bounds of the logarithms, shape (6,).
        start: the vehicle file's guess, shape (6,).
    """

    def __init__(self, vehicle: Vehicle) -> None:
        layout = Layout(vehicle)
        self._theta, self._free = layout.initial(vehicle), Free(tuple(layout.entry(n) for n in NOMINAL_NAMES))
        self.lower, self.upper = np.log(vehicle.bounds).T
        self.start = np.clip(self._free.scaled(vehicle.initial), self.lower, self.upper)

    def theta(self, point: FloatArray) -> FloatArray:
        """Full parameter vector of a point, shape (size,)."""
        return self._free.placed(self._theta, point)

    def thetas(self, points: FloatArray) -> FloatArray:
        """Full parameter vectors of points, shapes (k, 6) -> (k, size)."""
        return np.array([self.theta(p) for p in points])


class BoxProblem(Box):
    """Residual and cost on flight data, as the swarm sees them.

    The residual is that of short segments with their initial states projected out at the start (variable projection);
    half its sum of squares is the cost.
    """

    def __init__(self, windows: Sequence[Window], vehicle: Vehicle) -> None:
        """Cuts `windows` into short segments, at most about `SEGMENTS` of them.

        Raises:
            NotIdentifiableError: no stretch is long enough.
        """
        super().__init__(vehicle)
        shooting = Shooting.cut(windows, vehicle, SWARM_SECONDS)
        if not shooting.rollouts:
            raise NotIdentifiableError("no stretch is long enough to be fitted", "1 s without gaps")
        self._projected = Projected(shooting, self._theta, self._free, SEGMENTS)

    def residual(self, points: FloatArray) -> FloatArray:
        """Residuals in standard deviations, shapes (k, 6) -> (k, samples)."""
        return self._projected.residuals(self.thetas(points))

    def cost(self, points: FloatArray) -> FloatArray:
        """Half the sum of squared residuals, shapes (k, 6) -> (k,)."""
        return 0.5 * self._projected.costs(self.thetas(points))


def fit_at(
    windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, noise: NoiseModel, evaluations: int, how: str
) -> Fit:
    """Wraps a parameter vector as a fit: intervals and status at `theta`, which need not be an optimum.

    Args:
        theta: full parameter vector, shape (size,).
        how: sentence on how it ended.
    """
    shooting = Shooting.cut(windows, vehicle, FIT_SECONDS, noise)
    free = shooting.free(NOMINAL_NAMES)
    lin = shooting.linearise(theta, free, settle_states(shooting, theta).states)
    prior = default_prior(shooting, free)
    unc = uncertainty(lin, prior)
    parameters = parameter_set(free, theta, shooting.layout.initial(vehicle), unc)
    step = posterior_covariance(lin.information, prior) @ lin.gradient
    warnings = []
    far = [n for n, z, s in zip(free.names, np.abs(step), unc.sigma, strict=True) if z > s]
    if far:
        warnings.append(
            f"the search ended ({how}), but over whole seconds the data would still move {', '.join(far)}; "
            "optimizer pso_polish goes all the way"
        )
    return Fit(vehicle, theta, parameters, noise, unc, Convergence.BUDGET, evaluations, tuple(warnings))
