"""What the data say about the parameters at a point that some other search found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadid.identify.covariance import parameter_set, uncertainty
from quadid.identify.fit import FIT_SECONDS, Fit
from quadid.identify.gauss_newton import Convergence
from quadid.identify.noise_model import NoiseModel
from quadid.identify.priors import default_prior, posterior_covariance
from quadid.identify.score import settle_states
from quadid.identify.shooting import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Window


def fit_at(
    windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, noise: NoiseModel, evaluations: int, how: str
) -> Fit:
    """Wraps a parameter vector as a fit: intervals and status at `theta`, which need not be an optimum.

    Args:
        windows: training data.
        vehicle: as given.
        theta: full parameter vector, shape (size,).
        noise: sensor noise.
        evaluations: parameter vectors that the search simulated.
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
