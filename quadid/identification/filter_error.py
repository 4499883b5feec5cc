"""The fit beside random forces and moments, for vehicles that something turns which their model lacks.

Where turbulence, the wake of rotors or a missing cause rules the motion, simulated runs take what the controller does
against it for inertia (an error of closed loop: U. Forssell and L. Ljung, Automatica 35 (1999) 1215).  Innovations of a
Kalman filter with random forces do not.  What acts on every vehicle beside the six is fitted along, so that intervals
hold it: what makes rotors or gyro late passes for inertia, drag and damping for drag torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quadid.data.window import Window
from quadid.estimate.fit import estimate
from quadid.estimate.problem import LATE, Problem
from quadid.estimate.track import from_window
from quadid.identification.gauss_newton import Polished
from quadid.identification.noise import LEAST_WHITE, RATES, likeliest
from quadid.identification.problem import Free, Shooting
from quadid.identification.uncertainty import SPREAD_LIMIT, Uncertainty
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

WHITE_SHARE = 0.5
"""Random moments rule where less than this share of what short segments leave of roll or pitch rate is white noise."""
ALONG = (
    "rotor_drag.k_x", "rotor_drag.k_y", "rate_damping.l_p", "rate_damping.m_q", "rate_damping.n_r", "cg_offset.x",
    "cg_offset.y", *LATE,
)  # fmt: skip
"""Fitted along, unless the model has numbers of that effect."""
MOST_SECONDS = 600.0
"""Of longer flights the liveliest so many seconds are fitted: then a minute's interval is a third."""


class Filtered(NamedTuple):
    """Full parameter vector, nothing of what was fitted along in it, and covariance of what is free.

    `late`: parameters that are otherwise where nothing is late.
    """

    theta: FloatArray
    uncertainty: Uncertainty
    late: tuple[str, ...]


def has_unmodelled_moments(short: Shooting, plain: Polished) -> bool:
    """Checks whether moments that the model lacks rule the rates: as random ones they explain most of what it leaves.

    Args:
        short: short segments, with the noise that the model leaves there.
        plain: the model fitted to them.
    """
    for c in RATES[:2]:
        complete = np.all(plain.lin.weights[:, :, c] > 0.0, axis=1)
        if complete.any() and np.isfinite(plain.cost):
            white, _ = likeliest(plain.lin.residuals[complete, :, c], short.dt)
            if max(white, LEAST_WHITE) ** 2 < WHITE_SHARE * short.noise.variance[c]:
                return True
    return False


def filtered(windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, free: Free) -> Filtered | None:
    """Fits `free` parameters by the likelihood of innovations, random forces and all noise with them.

    Args:
        windows: data on one grid.
        vehicle: geometry, mass, priors and bounds.
        theta: where to start, full vector; holds the numbers of what is not free.
        free: the parameters.

    Returns:
        None where the filter has no finite answer.
    """
    layout = Layout(vehicle)
    known = {e.name.split(".")[0] for e in layout.entries.values() if theta[e.index] != e.neutral}
    along = [n for n in ALONG if n.split(".")[0] not in known and n not in free.names]
    nominal = [n for n in free.names if n in NOMINAL_NAMES]
    beside = [n for n in free.names if n not in NOMINAL_NAMES]
    tracks = [from_window(w, vehicle, air=True) for w in windows]
    problem = Problem.of(tracks, vehicle, (*beside, *along), windows, theta, nominal).liveliest(MOST_SECONDS)
    try:
        found = estimate(problem, problem.at(theta))
    except np.linalg.LinAlgError:  # the filter ran away
        return None
    names = [name for name, *_ in problem.entries]
    places = [names.index(n) for n in free.names]
    values = np.array([found.value(n, 0)[0] for n in free.names])
    if not (np.isfinite(found.objective) and np.isfinite(values).all() and np.isfinite(found.covariance).all()):
        return None
    out = theta.copy()
    out[free.index] = values
    # Both scale the six by logarithms, but effects by sizes of their own.
    unit = np.where(free.is_log, 1.0, problem.size[places] / free.scale)
    covariance = found.covariance[np.ix_(places, places)] * np.outer(unit, unit)
    own = Uncertainty(covariance, np.ones(len(unit)), unit * problem.prior[1][places])
    # What is late may be the rotors or a filter of the gyro, of which a J each follows: where nothing is late, a third.
    late = [names.index(n) for n in along if n in LATE]
    prompt = np.zeros(len(places))
    if late:
        prompt = -unit * (
            found.covariance[np.ix_(places, late)]
            @ np.linalg.solve(found.covariance[np.ix_(late, late)], found.z[late])
        )
    moved = tuple(n for n, step in zip(free.names, prompt, strict=True) if abs(step) > SPREAD_LIMIT)
    return Filtered(out, own.differing([prompt]), moved)
