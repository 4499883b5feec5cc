"""Numbers of a diagnosis: the selected model by the likelihood of innovations.

The selection follows simulated runs of short segments, each of which finds a state of its own: that takes a second for
twenty models, but leaves much of what a flight shows unused, and moments that no model has, which the controller
answers, pass for inertia there.  The selected model is then fitted as an identification fits
(`quadid.identification.filter_error`), the numbers of its causes with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.hypotheses import Model
from quadid.effects import EFFECTS
from quadid.identification.filter_error import filtered
from quadid.identification.fit import Fit, beside_random_forces
from quadid.identification.problem import Shooting


def fit_numbers(windows: Sequence[Window], short: Shooting, model: Model) -> Fit | None:
    """The fit of `model` by the likelihood of innovations: the six and what belongs to the vehicle of its causes.

    Args:
        windows: the data.
        short: segments of them, for the vehicle and its names.
        model: the selected one.

    Returns:
        None where the filter has no finite answer.
    """
    flight = [n for c in model.causes if EFFECTS[c.effect].per_log for n in c.names]
    free = short.free([n for n in model.free.names if n not in flight])
    found = filtered(windows, short.vehicle, model.theta, free, flight)
    return None if found is None else beside_random_forces(short, found, free)


def with_numbers(model: Model, found: Fit) -> Model:
    """`model` with the numbers of `found` and their covariance in place of its own; its residuals stay."""
    names = found.parameters.names
    places = np.array([model.free.names.index(n) for n in names])
    theta, covariance = model.theta.copy(), model.uncertainty.covariance.copy()
    index = model.free.index[places]
    theta[index] = found.theta[index]
    covariance[places], covariance[:, places] = 0.0, 0.0
    covariance[np.ix_(places, places)] = found.uncertainty.covariance
    return replace(model, theta=theta, known=replace(model.uncertainty, covariance=covariance))
