"""Errors of predictions on logs, beside those of predicting that nothing changes."""

from collections.abc import Sequence

import numpy as np

from quadid.data.window import Window
from quadid.identification.predict import QUANTITIES, no_change, start_errors
from quadid.vehicle import Vehicle


def shares_of_no_change(windows: Sequence[Window], vehicle: Vehicle, seconds: float) -> dict[str, float]:
    """Mean error so long after every start, by quantity, as a share of that of no change; NaN if not measured."""
    samples = round(seconds / windows[0].dt)
    errors = np.concatenate(start_errors(windows, vehicle, [samples]))[:, 0]
    mean = np.ma.array(errors, mask=np.isnan(errors)).mean(axis=0).filled(np.nan).tolist()
    still = no_change(windows, vehicle, samples)
    return {name: miss / still[name] for name, miss in zip(QUANTITIES, mean, strict=True)}
