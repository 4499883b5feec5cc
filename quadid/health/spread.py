"""How far healthy flights of one vehicle differ: the yardstick of every change.

Each trim's variance between healthy flights has an inverse-gamma posterior: what the baseline flights show, and, where
they are few, what their own parts show (battery, landing and taking off again), counted as `PRIOR_FLIGHTS` flights.
Roll and pitch share one variance, for propellers differ from each other whichever corner they sit on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quadid.health.trim_estimation import AXES, FlightTrim
from quadid.types import FloatArray

PRIOR_FLIGHTS = 4.0
"""Weight of the prior spread, in degrees of freedom."""
BETWEEN = 2.0
"""Flights differ this many times more than parts of one flight."""
LEAST = np.array([0.005, 0.005, 0.005, 0.01])
"""Smallest prior spread of `AXES`: rotors of healthy vehicles share the load to 1 % each and better never."""
_GROUPS = ((0, 1), (2,), (3,))
"""Trims that share a variance."""


class Healthy(NamedTuple):
    """Healthy trim and its spread.

    Attributes:
        mean: shape (4,), see `trims.AXES`.
        deviation: standard deviation between healthy flights, shape (4,).
        freedom: degrees of freedom of each, shape (4,).
        flights: number of baseline flights.
        shares: each rotor's share of the load, shape (rotors,).
    """

    mean: FloatArray
    deviation: FloatArray
    freedom: FloatArray
    flights: int
    shares: FloatArray

    def predictive(self, flights: int) -> FloatArray:
        """Standard deviation of the mean of `flights` new healthy flights from `mean`, shape (4,)."""
        return np.asarray(self.deviation * np.sqrt(1.0 / flights + 1.0 / self.flights))

    def known_from(self, flights: int) -> Healthy:
        """The same trim and spread as so many baseline flights would show them."""
        return self._replace(flights=flights, freedom=_freedom(flights))


def healthy_spread(baseline: Sequence[FlightTrim]) -> Healthy:
    """Mean and spread of healthy flights.

    Args:
        baseline: one flight or more.
    """
    means = np.array([flight.mean for flight in baseline])
    centre = means.mean(axis=0)
    inner = [flight.parts - flight.parts.mean(axis=0) for flight in baseline]
    parts = sum(float(len(rows) - 1) for rows in inner)
    within = np.sqrt(sum((rows**2).sum(axis=0) for rows in inner) / max(parts, 1.0))
    prior = np.maximum(BETWEEN * within, LEAST)
    squares = ((means - centre) ** 2).sum(axis=0)
    freedom = _freedom(len(means))
    variance = np.zeros(len(AXES))
    for group in map(list, _GROUPS):
        variance[group] = (PRIOR_FLIGHTS * np.mean(prior[group] ** 2) + squares[group].sum()) / freedom[group]
    shares = np.mean([flight.shares for flight in baseline], axis=0)
    return Healthy(centre, np.sqrt(variance), freedom, len(means), shares)


def _freedom(flights: int) -> FloatArray:
    """Degrees of freedom of each trim's variance, shape (4,)."""
    out = np.zeros(len(AXES))
    for group in map(list, _GROUPS):
        out[group] = PRIOR_FLIGHTS + len(group) * (flights - 1)
    return out
