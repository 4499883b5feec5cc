"""What predicts a flight better than its physics: the same physics with residual terms, in a file of its own.

Where the catalogue leaves structure, a simulation half a second ahead may be worse than none.  Who needs a prediction
all the same gets the forces and moments that are missing as a formula (`quadid.identification.residual_fit`).  They are
no findings, and the physical parameters are not touched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.identification.multistep_errors import STAGES
from quadid.identification.open_loop import mean_errors
from quadid.identification.residual_fit import fit_residual
from quadid.jsonable import jsonable
from quadid.model.layout import Layout
from quadid.vehicle import ResidualTerm, Vehicle

POOR = 1.5
"""Deviance per row of the extended model above which there is something left to learn."""
AHEAD = STAGES[-1][-1]
"""How far ahead [s] predictions are judged."""


@dataclass(frozen=True)
class Prediction:
    """Physics with residual terms.

    Attributes:
        vehicle: the physical vehicle with the terms in it.
        on: ``validation logs`` or ``training logs``, where the errors were taken.
        physical, predicted: mean error after `AHEAD` without and with the terms, by quantity.
    """

    vehicle: Vehicle
    on: str
    physical: dict[str, float]
    predicted: dict[str, float]

    @property
    def terms(self) -> tuple[ResidualTerm, ...]:
        """Forces and moments beyond the catalogue, largest gain first."""
        return self.vehicle.residual

    @property
    def sentence(self) -> str:
        """What a user of the file must heed."""
        return (
            f"the prediction file adds {len(self.terms)} residual terms to unchanged physics (rate error "
            f"{AHEAD:g} s ahead {self.physical['rate']:.3g} -> {self.predicted['rate']:.3g} rad/s on {self.on}); "
            f"first: {self.terms[0].formula}"
        )

    def to_dict(self) -> dict[str, object]:
        """Plain data for JSON; errors that the logs lack are None."""
        return {
            "seconds_ahead": AHEAD, "on": self.on, "physical": jsonable(self.physical),
            "predicted": jsonable(self.predicted), "terms": [t.formula for t in self.terms],
        }  # fmt: skip


def learn_prediction(
    windows: Sequence[Window], physical: Vehicle, validation: Sequence[Window] = ()
) -> Prediction | None:
    """Learns residual terms; None where they predict data that were not fitted no better than the physics.

    Args:
        windows: training flights, on one grid.
        physical: fitted vehicle with its findings.
        validation: unseen flights, which decide where runs fit into them; without them parts of `windows` do.

    Raises:
        NotIdentifiableError: no run of that length fits into any training flight.
    """
    terms = fit_residual(windows, physical).terms
    if not terms:
        return None
    vehicle = physical.model_copy(update={"residual": terms})
    before, after = (_errors(validation, v) for v in (physical, vehicle))
    on = "validation logs"
    if not any(np.isfinite(e) for e in after.values()):
        before, after, on = _errors(windows, physical), _errors(windows, vehicle), "training logs"
    return Prediction(vehicle, on, before, after) if _relative(after, before) < 0.0 else None


def _errors(windows: Sequence[Window], vehicle: Vehicle) -> dict[str, float]:
    """Mean error over all starts after `AHEAD`, by quantity; NaN for what the flights lack."""
    steps = max(round(AHEAD / windows[0].dt), 1) if windows else 1
    return mean_errors(windows, vehicle, Layout(vehicle).initial(vehicle), steps)


def _relative(errors: dict[str, float], before: dict[str, float]) -> float:
    """Mean logarithm of the ratio; infinite when a prediction ran away, minus infinite when only the one before did."""
    known = [(errors[q], e) for q, e in before.items() if not np.isnan(e)]
    if not all(np.isfinite(e) for e, _ in known):
        return np.inf
    return float(np.mean([np.log(e / b) if np.isfinite(b) else -np.inf for e, b in known]))
