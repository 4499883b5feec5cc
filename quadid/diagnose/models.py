"""A fitted model during a diagnosis, and how it is extended by a candidate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.blocks import block_labels, held_out_deviance
from quadid.diagnose.candidates import Candidate
from quadid.identify.polish import Polished, default_prior, polish
from quadid.identify.shooting import Free, Linearised, Shooting
from quadid.parameters import NOMINAL_NAMES

FloatArray = NDArray[np.float64]
States = dict[int, list[FloatArray]]


@dataclass(frozen=True)
class Model:
    """A model fitted to the training data.

    Attributes:
        causes: candidates it contains.
        free: its free parameters.
        theta: full vector at the optimum.
        lin: linearisation there.
        cost: deviance with prior.
        states: initial states that belong to it.
        held_out: deviance of each block under parameters fitted to the others.
    """

    causes: tuple[Candidate, ...]
    free: Free
    theta: FloatArray
    lin: Linearised
    cost: float
    states: States
    held_out: FloatArray

    @property
    def deviance(self) -> float:
        """Marginal deviance on the fitted data, prior included."""
        return self.cost + float(self.lin.occam.sum())

    @property
    def effects(self) -> set[str]:
        """Names of the effects it contains."""
        return {c.effect for c in self.causes}


def free_names(causes: tuple[Candidate, ...]) -> list[str]:
    """The six nominal parameters and those of `causes`."""
    return list(dict.fromkeys([*NOMINAL_NAMES, *(n for c in causes for n in c.names)]))


def fit_model(
    shooting: Shooting, theta: FloatArray, causes: tuple[Candidate, ...], states: States | None = None,
    iterations: int = 6, robust: bool = False,
) -> Model:  # fmt: skip
    """Fits the model with `causes` from `theta` and `states`."""
    if states is not None:
        shooting.restore(states)
    free = shooting.free(free_names(causes))
    result = polish(shooting, theta, free, iterations=iterations, robust=robust, tolerance=0.05)
    return as_model(shooting, result, free, causes)


def as_model(shooting: Shooting, result: Polished, free: Free, causes: tuple[Candidate, ...]) -> Model:
    """Wraps a polish result with its held-out deviance."""
    precision = 1.0 / default_prior(shooting, free).sigma ** 2
    held_out = held_out_deviance(result.lin, precision, block_labels(result.lin))
    return Model(causes, free, result.theta, result.lin, result.cost, shooting.snapshot(), held_out)


def extend(shooting: Shooting, model: Model, candidate: Candidate, iterations: int = 6) -> Model:
    """Refits `model` with `candidate` added, from each of its starts; returns the best."""
    causes = (*model.causes, candidate)
    best: Model | None = None
    for start in candidate.starts or ((),):
        theta = model.theta.copy()
        if start:
            theta[shooting.free(list(candidate.names)).index] = start
        trial = fit_model(shooting, theta, causes, model.states, iterations)
        if best is None or trial.deviance < best.deviance:
            best = trial
    assert best is not None
    return best
