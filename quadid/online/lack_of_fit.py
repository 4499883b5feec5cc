"""Whether a window asks for effects beyond the nominal model: a score test of all of them at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from quadid.effects import EFFECTS
from quadid.identification.gauss_newton import Polished
from quadid.identification.problem import Shooting
from quadid.online.flexible_fit import EFFECT_WIDTH, moving_names

TRIFLE = 0.01
"""Share of the residuals that effects of the catalogue may explain without being looked for,"""
LACKING = 6.0
"""... and the standard deviations by which it must exceed what noise gives."""
FEWEST_SEGMENTS = 5
"""Fewer segments do not give the noise well enough to say what is more than noise."""


@dataclass(frozen=True)
class LackOfFit:
    """What the effects of the catalogue would take from the residuals, all freed at once.

    Attributes:
        drop: of the deviance, in units of the residuals' own level.
        freedom: numbers freed: what noise alone would give.
        rows: independent residuals.
    """

    drop: float = 0.0
    freedom: int = 0
    rows: float = 0.0

    @property
    def share(self) -> float:
        """Share of the residuals, beyond what noise gives."""
        return (self.drop - self.freedom) / max(self.rows, 1.0)

    @property
    def significant(self) -> bool:
        """Whether it is more than a trifle, and more than noise gives."""
        errors = (self.drop - self.freedom) / math.sqrt(2.0 * max(self.freedom, 1))
        return self.share > TRIFLE and errors > LACKING


def lack_of_fit(problem: Shooting, result: Polished) -> LackOfFit:
    """Score test of the flexible part of everything that moves the vehicle, and of the IMU filter, freed at once.

    Errors of sensors are left out: with them a slow error of the AHRS would look like a lack.
    """
    if problem.count < FEWEST_SEGMENTS:
        return LackOfFit()
    rigid = {n for e in EFFECTS.values() for n in (*e.entries, *e.refinements) if n not in e.flexible_entries}
    rigid |= {n for e in EFFECTS.values() if e.flexible == "never" for n in e.entries}
    free = problem.free([n for n in moving_names(problem) if n not in rigid])
    lin = problem.linearise(result.theta, free)
    weight = np.where(free.is_log, 0.0, 1.0 / EFFECT_WIDTH**2) + 1e-9
    drop = float(lin.gradient @ np.linalg.solve(lin.information + np.diag(weight), lin.gradient))
    return LackOfFit(drop * lin.total_rows / max(lin.total_cost, 1.0), len(weight), lin.total_rows)
