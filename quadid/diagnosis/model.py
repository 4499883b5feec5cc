"""A fitted model during a diagnosis, and how it is extended by a candidate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from quadid.diagnosis.candidates import Candidate
from quadid.diagnosis.cross_validation import held_out
from quadid.effects import NEVER
from quadid.identification.covariance import Uncertainty, uncertainty, variance_ratio
from quadid.identification.gauss_newton import Polished, bounded_step, polish
from quadid.identification.initial_states import InitialStates
from quadid.identification.parameterization import Free
from quadid.identification.priors import Prior, default_prior, normal_equations, posterior_covariance, prior_terms
from quadid.identification.shooting import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray


@dataclass(frozen=True)
class Model(Polished):
    """A model fitted to the training data: an optimum, and what is free there.

    Attributes:
        causes: candidates it contains.
        free: its free parameters; prior: weak prior on them.
        held_out: deviance of each block in the density that the others predict.
        rest: deviance of all blocks but one under parameters fitted to them, for each block.
        tried: how many alternatives (causes, and onsets of them) were looked at when each cause was, by label.
    """

    causes: tuple[Candidate, ...]
    free: Free
    prior: Prior
    held_out: FloatArray
    rest: FloatArray
    tried: Mapping[str, float] = field(default_factory=dict)

    @property
    def deviance(self) -> float:
        """Marginal deviance on the fitted data, prior included."""
        return self.cost + float(self.lin.occam.sum())

    @property
    def rows(self) -> float:
        """Independent residuals."""
        return self.lin.total_rows

    @cached_property
    def inflation(self) -> FloatArray:
        """True variance of each parameter over what the model counts on, from the scores of its segments, (P,)."""
        return variance_ratio(self.lin, posterior_covariance(self.lin.information, self.prior))[0]

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Covariance of the scaled parameters, widened where scores of segments are larger or more alike than noise."""
        return uncertainty(self.lin, self.prior)

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviations of the fitted entries in their own units, by name."""
        sigma = self.uncertainty.sigma * self.free.jacobian(self.theta)
        return dict(zip(self.free.names, sigma.tolist(), strict=True))

    def numbers(self, cause: Candidate) -> Free:
        """The free parameters that belong to `cause`."""
        return Free(tuple(e for e in self.free.entries if e.name in cause.names))

    def wald(self, cause: Candidate) -> float:
        """Robust chi-square of the parameters of `cause` against neutral."""
        z = self.free.from_neutral(self.theta)
        place = [self.free.names.index(n) for n in cause.names]
        covariance = self.uncertainty.covariance[np.ix_(place, place)]
        return float(z[place] @ np.linalg.solve(covariance, z[place]))

    @property
    def finds_velocity(self) -> bool:
        """Whether airspeed matters and is not measured, so that the segments' initial velocities are fitted."""
        return bool(np.any(self.lin.occam))

    @property
    def effects(self) -> set[str]:
        """Names of the effects it contains."""
        return {c.effect for c in self.causes}


def free_names(causes: tuple[Candidate, ...]) -> list[str]:
    """The six nominal parameters and those of `causes`."""
    return list(dict.fromkeys([*NOMINAL_NAMES, *(n for c in causes for n in c.names)]))


def fit_model(
    shooting: Shooting, theta: FloatArray, causes: tuple[Candidate, ...], states: InitialStates | None = None,
    iterations: int = 6, tolerance: float = 0.05, tried: Mapping[str, float] | None = None,
) -> Model:  # fmt: skip
    """Fits the model with `causes` from `theta` and `states`; `iterations` and `tolerance` as in `polish`."""
    free = shooting.free(free_names(causes))
    prior = default_prior(shooting, free)
    settled = bool(states)
    found = polish(shooting, theta, free, prior, states, iterations, tolerance=tolerance, settled=settled)
    left_out = held_out(found.lin, prior.precision)
    return Model(
        found.theta, found.lin, found.cost, found.iterations, found.outcome, causes, free, prior, *left_out, tried or {}
    )


def refit(
    shooting: Shooting, model: Model, states: InitialStates | None, iterations: int = 6, tolerance: float = 0.05
) -> Model:
    """Fits what `model` has, from its parameters and `states`; those of other segments are none."""
    return fit_model(shooting, model.theta, model.causes, states, iterations, tolerance, model.tried)


@dataclass(frozen=True)
class Start:
    """Where a refit with another cause begins.

    Attributes:
        theta: full vector.
        states: initial states there.
        drop: predicted fall of the deviance.
    """

    theta: FloatArray
    states: InitialStates
    drop: float = 0.0


def sketch(shooting: Shooting, model: Model, candidate: Candidate) -> Start:
    """Where one Gauss-Newton step from the start of `candidate` leads, and what it would gain."""
    free = shooting.free(free_names((*model.causes, candidate)))
    prior = default_prior(shooting, free)
    theta = model.theta.copy()
    if candidate.start:
        theta[shooting.free(candidate.names).index] = candidate.start
    lin = shooting.linearise(theta, free, model.states)
    h, g = normal_equations(lin, free, prior, theta)
    z = bounded_step(free, theta, h, g)
    here = lin.total_cost + float(lin.occam.sum()) + prior_terms(free, prior, theta)[2]
    deviance = here + float(2.0 * g @ z + z @ h @ z)
    moved = free.move(theta, z)
    return Start(moved, lin.stepped(free.step(theta, moved)), model.deviance - deviance)


def extend(
    shooting: Shooting, model: Model, candidate: Candidate, start: Start | None = None, iterations: int = 6,
    tried: float = 1.0,
) -> Model:  # fmt: skip
    """Refits `model` with `candidate` added.

    Args:
        shooting: the problem.
        model: what to extend.
        candidate: the cause to add.
        start: where to begin; by default where the sketch leads.
        iterations: linearisations to spend.
        tried: how many alternatives were looked at.
    """
    start = start or sketch(shooting, model, candidate)
    new = candidate.split or (candidate,)
    known = {**model.tried, **{c.label: tried for c in new}}
    return fit_model(shooting, start.theta, (*model.causes, *new), start.states, iterations, 0.2, known)


def taken_out_causes(causes: tuple[Candidate, ...], cause: Candidate | None) -> tuple[Candidate, ...]:
    """`causes` without `cause`, if any, and what requires it."""
    return tuple(c for c in causes if cause is None or (c.label != cause.label and not cause.carries(c)))


def without(shooting: Shooting, model: Model, cause: Candidate) -> Model:
    """Refits `model` without `cause` and what requires it."""
    return refit(shooting, taken_out(shooting, model, cause), model.states, tolerance=0.2)


def taken_out(shooting: Shooting, model: Model, cause: Candidate) -> Model:
    """`model` with `cause` and what requires it at neutral, nothing refitted: its deviance stays that of `model`."""
    left = taken_out_causes(model.causes, cause)
    theta = model.theta.copy()
    for c in model.causes:
        if c not in left:
            theta[shooting.free(list(c.names)).index] = 0.0
            if c.timed is not None:
                theta[c.timed] = NEVER
    return replace(model, causes=left, theta=theta)
