"""What is known of the free parameters beforehand, in scaled parameters, and what the data add to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.identification.parameterization import Free
from quadid.identification.segment_cost import Linearised
from quadid.identification.shooting import Shooting
from quadid.types import FloatArray

PRIOR_SIGMA_LINEAR = 10.0
"""Weak prior of an effect parameter: this many typical sizes."""


@dataclass(frozen=True)
class Prior:
    """Gaussian prior on the scaled parameters: ``mean`` of the parameter, ``sigma`` in scaled units, shapes (P,)."""

    mean: FloatArray
    sigma: FloatArray

    @property
    def precision(self) -> FloatArray:
        """Of each scaled parameter, shape (P,)."""
        return np.asarray(1.0 / self.sigma**2)


def default_prior(shooting: Shooting, free: Free) -> Prior:
    """Prior of each free parameter: thrust stand, else the file's (`ParameterPrior.log_sigma`); weak on effects."""
    mean, sigma = [], []
    stand = shooting.vehicle.stand_thrust
    for e in free.entries:
        known = shooting.vehicle.parameters.get(e.name)
        if e.name == "b" and stand is not None:
            mean.append(stand[0])
            sigma.append(stand[1])
        elif known is not None:
            mean.append(known.initial)
            sigma.append(known.log_sigma)
        else:
            mean.append(e.neutral)
            sigma.append(PRIOR_SIGMA_LINEAR)
    return Prior(np.array(mean), np.array(sigma))


def prior_terms(free: Free, prior: Prior, theta: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Precision (P,), gradient (P,) and cost of the prior at `theta`, in scaled parameters."""
    z = free.difference(theta[free.index], prior.mean)
    return prior.precision, prior.precision * z, float(np.sum(prior.precision * z * z))


def normal_equations(lin: Linearised, free: Free, prior: Prior, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of data and prior at `theta`: h (P, P) and g (P,) of the cost ``2 g z + z h z`` of a scaled step z."""
    precision, pull, _ = prior_terms(free, prior, theta)
    return lin.information + np.diag(precision), lin.gradient + pull


def posterior_covariance(information: FloatArray, prior: Prior) -> FloatArray:
    """Covariance (P, P) of the scaled parameters, given their information from data, (P, P), and the prior."""
    return np.asarray(np.linalg.inv(information + np.diag(prior.precision)))
