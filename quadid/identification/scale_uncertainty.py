"""What an uncertain mass or arm does to the result.

Motion shows ratios only.  Scaling mass, b, d, all inertias and J_r by one factor leaves every motion as it is; so does
scaling the arm, d, all inertias and J_r.  The logarithms of both factors are nuisance parameters with a known spread;
they are marginalised from the Gaussian posterior, so that what is known of one inertia from elsewhere (CAD, a swing
test) tightens the others and b as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quadid.identification.covariance import Uncertainty
from quadid.identification.parameterization import Free
from quadid.identification.priors import Prior
from quadid.identification.schur_complement import eliminated
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle


def with_scale_uncertainty(
    vehicle: Vehicle, free: Free, prior: Prior, theta: FloatArray, unc: Uncertainty
) -> tuple[FloatArray, Uncertainty]:
    """Posterior of the parameters when mass and arm are known to `Vehicle.mass_sigma` and `Vehicle.arm_sigma` only.

    Args:
        vehicle: the vehicle file.
        free: free parameters.
        prior: their prior.
        theta: full vector at the posterior's mode for exact mass and arm.
        unc: its covariance (P, P), scaled parameters.

    Returns:
        Full vector and covariance; as given where mass and arm are taken for exact.
    """
    spread = np.array([vehicle.mass_sigma / vehicle.mass, vehicle.arm_sigma / vehicle.arm])
    some = spread > 0.0
    if not some.any():
        return theta, unc
    directions = _directions(free, theta)[:, some]
    p = np.diag(prior.precision)
    values, vectors = np.linalg.eigh(np.linalg.inv(unc.covariance) - p)
    h = (vectors * np.maximum(values, 0.0)) @ vectors.T
    reach = h @ directions
    left = eliminated(h, reach, directions.T @ reach + np.diag(spread[some] ** -2.0))
    covariance = np.asarray(np.linalg.inv(left.h + p))
    start = theta.copy()
    start[free.index] = prior.mean
    pull = p @ free.step(theta, start)
    # At the mode the data pull exactly against the prior; the part of that pull along the scales is worth less now.
    step = covariance @ (left.gain @ (directions.T @ pull))
    return free.move(theta, step), replace(unc, covariance=covariance)


def _directions(free: Free, theta: FloatArray) -> FloatArray:
    """How each scaled parameter goes with the logarithm of mass and of arm, shape (P, 2)."""
    out = np.zeros((len(free.entries), 2))
    for j, e in enumerate(free.entries):
        if e.name in NOMINAL_NAMES:
            out[j] = (1.0, 0.0 if e.name == "b" else 1.0)
        elif e.unit == "kg m^2":
            out[j] = theta[e.index] / e.typical
    return out
