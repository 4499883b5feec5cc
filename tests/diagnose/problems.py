"""Fitted problems that several tests of the diagnosis share: flown and fitted once a process."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.hypotheses import Candidate, Model, candidates, fit_model
from quadid.flight import draw_truth, fly
from quadid.identification.fit import SWARM_SECONDS, flexible_fit, reweighted_fit
from quadid.identification.gauss_newton import polish
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from tests.identify.flights import PELICAN, guessed

SECONDS = 60.0
SEED = 5


@dataclass(frozen=True)
class Problem:
    """One flight, and the nominal model fitted to it on 1 s segments with the noise of the flight."""

    window: Window
    shooting: Shooting
    nominal: Model

    @property
    def listed(self) -> list[Candidate]:
        """The catalogue."""
        return candidates(self.shooting.layout, self.shooting.has_velocity, self.shooting.channels >= 15)


def window_with(effects: dict[str, dict[str, float]] | None = None, **planted: FloatArray) -> Window:
    """A 60 s flight with hidden effects, and what is added to its channels (gyro, accel; shape (n, 3))."""
    truth = draw_truth(PELICAN, SEED)
    window = fly(PELICAN, truth, SECONDS, SEED, effects=effects or {}).window
    changed: dict[str, Any] = {k: np.asarray(getattr(window, k)) + v for k, v in planted.items()}
    return replace(window, **changed)


def fitted(window: Window, noise: NoiseModel | None = None) -> Problem:
    """Fits the nominal model; the noise is that of a flexible fit to the window where none is given."""
    vehicle = guessed(draw_truth(PELICAN, SEED), SEED)
    short = Shooting.cut([window], vehicle, SWARM_SECONDS, noise)
    free = short.free(NOMINAL_NAMES)
    start = short.layout.initial(vehicle)
    if noise is None:
        short, first = reweighted_fit(short, start, free, iterations=8)
        short = short.with_noise(flexible_fit([window], short, [first.theta], free).noise)
    else:
        first = polish(short, start, free, iterations=8)
    decisive = Shooting.cut([window], vehicle, 1.0, short.noise, short.layout)
    return Problem(window, decisive, fit_model(decisive, first.theta, (), iterations=10, tolerance=0.01))


@lru_cache(maxsize=1)
def clean() -> Problem:
    """A flight without effects."""
    return fitted(window_with())


def cause(problem: Problem, label: str) -> Candidate:
    """One candidate by its label."""
    (found,) = [c for c in problem.listed if c.label == label]
    return found
