"""Hypotheses of a diagnosis: causes that may be named, models with them, deviance on blocks of data not fitted."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from quadid.effects import EFFECTS, NEVER, Effect
from quadid.identification.elimination import InitialStates
from quadid.identification.gauss_newton import Polished, bounded_step, polish
from quadid.identification.problem import (
    Free,
    Linearised,
    Prior,
    Shooting,
    default_prior,
    normal_equations,
    posterior_covariance,
    prior_terms,
)
from quadid.identification.result import INFINITE
from quadid.identification.uncertainty import Uncertainty, uncertainty, variance_ratio
from quadid.model.layout import Layout, places
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray, IndexArray

# --- The causes a diagnosis may name: which entries of the parameter vector each frees, and how its search starts


@dataclass(frozen=True)
class Candidate:
    """One cause that may be added to the model.

    Attributes:
        effect: name of the effect.
        names: entries it frees.
        start: non-neutral starting values of those entries, for causes that cannot be linearised at neutral.
        requires: effect, or label of a cause, that must be in the model first.
        timed: index of its time entry, when it begins at an unknown moment.
        label: distinguishes candidates of one effect.
        refines: it frees optional numbers of an effect that is in the model, and shares its finding.
        split: what it stands for once accepted, where that shows only together.
    """

    effect: str
    names: tuple[str, ...]
    start: tuple[float, ...] = ()
    requires: str | None = None
    timed: int | None = None
    label: str = field(default="")
    refines: bool = False
    split: tuple[Candidate, ...] = ()

    @property
    def family(self) -> str:
        """Look-alikes; when one of a family is short-listed all of it is refitted."""
        return EFFECTS[self.effect].family

    def carries(self, other: Candidate) -> bool:
        """Checks whether `other` can only be in a model that has this one; a refinement carries nothing."""
        return not self.refines and other.requires in (self.effect, self.label)

    def __post_init__(self) -> None:
        """Labels the candidate by its effect, and by its rotor for `weak_rotor`."""
        if not self.label:
            object.__setattr__(self, "label", self.effect)


def candidates(
    layout: Layout, has_velocity: bool, has_position: bool, rotors: Collection[str] = ("commands",)
) -> list[Candidate]:
    """All causes that these data could show.

    Args:
        layout: parameter vector of the vehicle.
        has_velocity: velocity is measured.
        has_position: position is measured.
        rotors: what their columns are, commands or readings, and battery where the supply voltage is known.
    """
    out = []
    known = {*rotors, *(["velocity"] if has_velocity else []), *(["position"] if has_position else [])}
    for spec in EFFECTS.values():
        effect = spec.name
        if not known.issuperset(spec.needs):
            continue
        if effect == "weak_rotor":
            for i in range(layout.rotors):
                label = f"{effect} {i + 1}"
                out.append(Candidate(effect, (f"{effect}.loss_{i + 1}",), label=label))
                torque = f"{label} drag torque"
                out.append(Candidate(effect, (f"{effect}.extra_{i + 1}",), requires=label, label=torque, refines=True))
            continue
        timed = layout.entry(f"{effect}.time").index if spec.timed else None
        cause, optional = Candidate(effect, spec.entries, spec.start, spec.requires, timed), _refinements(spec)
        out += [cause, *optional]
        for at_cg in (c for c in optional if c.names == (f"{effect}.central",)):
            # Air that acts at the CG turns nothing; at the hubs, where it does, it may explain nothing.
            names, start, both = (*cause.names, *at_cg.names), (*spec.start, 1.0), (cause, at_cg)
            out.append(Candidate(effect, names, start, label=f"{effect} at the CG", split=both))
    if has_velocity:
        # Drag in air that moves faster than the vehicle explains nothing alone.
        drag, wind = (next(c for c in out if c.label == wanted) for wanted in ("rotor_drag", "wind"))
        names, start, both = (*drag.names, *wind.names), (*drag.start, 0.0, 0.0), (drag, wind)
        out.append(Candidate(drag.effect, names, start, label="rotor_drag in wind", split=both))
    return out


def _refinements(spec: Effect) -> list[Candidate]:
    """Optional numbers of an effect, once it is in the model: those of a payload together, others each alone."""
    together = [spec.refinements] if spec.timed else [(name,) for name in spec.refinements]
    return [
        Candidate(spec.name, names, requires=spec.name, label=f"{spec.name} {names[0].split('.')[1]}", refines=True)
        for names in together
        if names
    ]


def unset_times(theta: FloatArray, active: set[str]) -> FloatArray:
    """Vector whose unused change times lie before the log, so that the derivative to a fraction covers all of it."""
    out = theta.copy()
    for spec in EFFECTS.values():
        if spec.timed and spec.name not in active:
            out[list(places(f"{spec.name}.time"))] = -NEVER
    return out


# --- Comparison of models on blocks of data that the fit did not see
#
# Segments are grouped into ten blocks of time.  For each block the parameters are those fitted to all other blocks
# (one Gauss-Newton step from the common optimum, exact for the linearised problem), so a model is charged for every
# parameter that only fits noise; the paired differences between two models, one a block, carry their own standard
# error whatever the correlation inside a block.
#
# A block that moves the vehicle as no other does is an extrapolation of parameters that the others hardly determine.
# Its error is no evidence on the model, so each block is scored by its predictive density, in which that uncertainty
# has its share (Geisser and Eddy, J. Am. Stat. Assoc. 74 (1979) 153).


BLOCKS = 10
"""With so many the error of a gain is known to a quarter, and each is many times the memory of the noise."""


@dataclass(frozen=True)
class Quadratic:
    """-2 ln of the likelihood near a point, ``cost + 2 grad z + z gram z`` of a scaled step z, by stretches of time.

    Attributes:
        gram: shape (stretches, P, P).
        grad: shape (stretches, P).
        cost: shape (stretches,).
        rows: scalar measurements of each stretch.
        window: index of the flight of each stretch.
        time: when it begins [s].
    """

    gram: FloatArray
    grad: FloatArray
    cost: FloatArray
    rows: FloatArray
    window: IndexArray
    time: FloatArray

    @property
    def occam(self) -> float:
        """No initial states are found: what a comparison by blocks adds to the cost."""
        return 0.0

    @cached_property
    def information(self) -> FloatArray:
        """Of all stretches on the scaled parameters, shape (P, P)."""
        return np.asarray(self.gram.sum(axis=0))

    @cached_property
    def gradient(self) -> FloatArray:
        """Half the slope of all stretches, shape (P,)."""
        return np.asarray(self.grad.sum(axis=0))

    @cached_property
    def total_rows(self) -> float:
        """Scalar measurements of all stretches."""
        return float(self.rows.sum())

    @property
    def by_flight(self) -> Quadratic:
        """The same by whole flights."""
        gram, grad, cost, rows = (
            sum_by_block(part, self.window) for part in (self.gram, self.grad, self.cost, self.rows)
        )
        first = np.unique(self.window, return_index=True)[1]
        return Quadratic(gram, grad, cost, rows, self.window[first], self.time[first])

    def spread(self, free: Sequence[int], step: FloatArray, inverse: FloatArray) -> FloatArray:
        """True variance of each of the entries `free` over that in `inverse`, as if the point were a `step` away."""
        scores = (self.grad + self.gram @ step)[:, free]
        return variance_ratio(inverse, scores, self.window, self.time, self.spacing)[0]

    @property
    def spacing(self) -> float:
        """Time from one stretch to the next [s]; 1 s where there is one only."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 1.0


def block_labels(lin: Linearised | Quadratic) -> IndexArray:
    """Block number of each segment, shape (segments,): stretches of a tenth of all data, none over two flights."""
    length = max(lin.spacing * len(lin.time) / BLOCKS, 2.0 * lin.spacing)
    _, first, window = np.unique(lin.window, return_index=True, return_inverse=True)
    number = np.floor((lin.time - lin.time[first][window] + 1e-9) / length)
    return np.unique(np.stack([window, number]), axis=1, return_inverse=True)[1].reshape(-1)


class HeldOut(NamedTuple):
    """Deviances with the parameters of all blocks but one, for each in turn, shapes (blocks,).

    Attributes:
        block: of the block itself, in the density that the other blocks predict.
        rest: of the other blocks, at their own optimum.
    """

    block: FloatArray
    rest: FloatArray


@INFINITE
def held_out(lin: Linearised | Quadratic, prior_precision: FloatArray) -> HeldOut:
    """Deviance of each block in the density that the other blocks predict, and of those.

    Twice the negative logarithm of N(r; r(z), I + B V B'), with z and V mean and covariance of the parameters from the
    other blocks and B the derivative of the block's residuals r; less that of the noise alone, N(0; 0, I).
    """
    # z: optimum of the other blocks, from their normal equations; slope: half that of the block's deviance there.
    labels = block_labels(lin)
    gram, grad, cost = (sum_by_block(a, labels) for a in (lin.gram, lin.grad, lin.cost + lin.occam))
    z = steps_without(gram, grad, prior_precision)
    moved = np.einsum("bpq,bq->bp", gram, z)
    slope, rest = grad + moved, _rest(gram, prior_precision)
    shared = np.einsum("bp,bp->b", slope, np.linalg.solve(rest + gram, slope[..., None])[..., 0])
    spread = np.linalg.slogdet(rest + gram)[1] - np.linalg.slogdet(rest)[1]
    return HeldOut(
        cost + np.sum((grad + slope) * z, axis=1) - shared + spread,
        cost.sum() - cost + np.sum((grad.sum(axis=0) - grad) * z, axis=1),
    )


def steps_without(gram: FloatArray, grad: FloatArray, prior_precision: FloatArray) -> FloatArray:
    """Scaled step to the optimum of all blocks but one, for each in turn, shape (blocks, P).

    Args:
        gram: of each block, shape (blocks, P, P).
        grad: half the slope of the deviance of each block, shape (blocks, P).
        prior_precision: of each parameter, shape (P,).
    """
    g_rest = grad.sum(axis=0) - grad
    return np.asarray(-np.linalg.solve(_rest(gram, prior_precision), g_rest[..., None])[..., 0])


def _rest(gram: FloatArray, prior_precision: FloatArray) -> FloatArray:
    """Information of all blocks but one and of the prior, for each in turn, shape (blocks, P, P)."""
    return np.asarray(gram.sum(axis=0) - gram + np.diag(np.maximum(prior_precision, 1e-12)))


def sum_by_block(values: FloatArray, labels: IndexArray) -> FloatArray:
    """Sums of `values` (segments, ...) over the segments of each block, shape (blocks, ...)."""
    order = np.argsort(labels, kind="stable")
    first = np.flatnonzero(np.diff(labels[order], prepend=-1))
    out = np.zeros((int(labels.max()) + 1, *values.shape[1:]))
    out[labels[order][first]] = np.add.reduceat(values[order], first, axis=0)
    return out


@dataclass(frozen=True)
class Gain:
    """Gain of one model over another on data not fitted.

    Attributes:
        total: summed reduction of the deviance; error: its standard error.
        blocks: reduction of each block.
    """

    total: float
    error: float
    blocks: FloatArray

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the total."""
        half = float(stdtrit(max(len(self.blocks) - 1, 1), 0.975)) * self.error
        return self.total - half, self.total + half


@INFINITE
def paired_gain(before: FloatArray, after: FloatArray) -> Gain:
    """Gain of `after` over `before`, both block deviances of the same blocks."""
    difference = before - after
    n = len(difference)
    error = float(np.sqrt(n) * np.std(difference, ddof=1)) if n > 1 else float("inf")
    return Gain(float(difference.sum()), error, difference)


RELEVANT = 0.002
"""Share of the noise that a cause must take away on unseen blocks.  Smaller gains are irrelevant in practice, and what
the time step of a simulation or of an autopilot's own filter can imitate: nulls reach 0.0008."""


def surely_gained(small: HeldOut, large: HeldOut) -> float:
    """Gain on unseen parts of the data, or twice that without the best of them where that is less.

    It is missing in the fit as well: what a single stretch determines, such as a step near the end, gains elsewhere by
    keeping that stretch apart.
    """
    gain = paired_gain(small.block, large.block)
    best = int(np.argmax(gain.blocks))
    return min(gain.total, 2.0 * float(small.rest[best] - large.rest[best]))


def calibration(inflation: FloatArray) -> float:
    """By how much scores of parameters vary more than a deviance counts on, from those of each, or 1."""
    return max(float(np.mean(inflation)), 1.0) if len(inflation) else 1.0


# --- A fitted model during a diagnosis, and how it is extended by a candidate


class Named:
    """Causes of a fitted model, and their numbers."""

    causes: tuple[Candidate, ...]
    free: Free
    theta: FloatArray

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Covariance of the scaled parameters in `free`."""
        raise NotImplementedError

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
    def effects(self) -> set[str]:
        """Names of the effects it contains."""
        return {c.effect for c in self.causes}

    @property
    def labels(self) -> frozenset[str]:
        """Labels of its causes."""
        return frozenset(c.label for c in self.causes)


@dataclass(frozen=True)
class Model(Polished, Named):
    """A model fitted to the training data: an optimum, and what is free there.

    Attributes:
        causes: candidates it contains.
        free: its free parameters; prior: weak prior on them.
        held_out: deviance of each block in the density that the others predict.
        rest: deviance of all blocks but one under parameters fitted to them, for each block.
        tried: how many alternatives (causes, and onsets of them) were looked at when each cause was, by label.
        known: uncertainty of the parameters by the likelihood of innovations, once they are fitted so.
    """

    causes: tuple[Candidate, ...]
    free: Free
    prior: Prior
    held_out: FloatArray
    rest: FloatArray
    tried: Mapping[str, float] = field(default_factory=dict)
    known: Uncertainty | None = None

    @property
    def deviance(self) -> float:
        """Marginal deviance on the fitted data, prior included."""
        return self.cost + float(self.lin.occam.sum())

    @property
    def rows(self) -> float:
        """Independent residuals."""
        return self.lin.total_rows

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the scaled parameters."""
        return self.free.names

    @property
    def information(self) -> FloatArray:
        """Information of the data on the scaled parameters, shape (P, P)."""
        return self.lin.information

    @property
    def precision(self) -> FloatArray:
        """Precision of their prior, shape (P,)."""
        return self.prior.precision

    def gains_beside(self, small: Model) -> bool:
        """Checks whether what it has more than a `small` model gains enough on unseen blocks."""
        parts = HeldOut(small.held_out, small.rest), HeldOut(self.held_out, self.rest)
        return surely_gained(*parts) > RELEVANT * small.rows

    @cached_property
    def inflation(self) -> FloatArray:
        """True variance of each parameter over what the model counts on, from the scores of its segments, (P,)."""
        covariance, lin = posterior_covariance(self.lin.information, self.prior), self.lin
        return variance_ratio(covariance, lin.grad, lin.window, lin.time, lin.spacing)[0]

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Covariance of the scaled parameters; that of segments is widened where their scores are more than noise."""
        return self.known or uncertainty(self.lin, self.prior)

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviations of the fitted entries in their own units, by name."""
        sigma = self.uncertainty.sigma * self.free.jacobian(self.theta)
        return dict(zip(self.free.names, sigma.tolist(), strict=True))

    @property
    def finds_velocity(self) -> bool:
        """Checks whether airspeed matters and is not measured, so that the segments' initial velocities are fitted."""
        return bool(np.any(self.lin.occam))


def free_names(causes: tuple[Candidate, ...]) -> list[str]:
    """The six nominal parameters and those of `causes`."""
    return list(dict.fromkeys([*NOMINAL_NAMES, *(n for c in causes for n in c.names)]))


def fit_model(
    shooting: Shooting,
    theta: FloatArray,
    causes: tuple[Candidate, ...],
    states: InitialStates | None = None,
    iterations: int = 6,
    tolerance: float = 0.05,
    tried: Mapping[str, float] | None = None,
) -> Model:
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
    """Start of a refit with another cause.

    Attributes:
        theta: full vector.
        states: initial states there.
        drop: predicted fall of the deviance.
    """

    theta: FloatArray
    states: InitialStates
    drop: float = 0.0


def sketch(shooting: Shooting, model: Model, candidate: Candidate) -> Start:
    """End of one Gauss-Newton step from the start of `candidate`, and its gain."""
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
    shooting: Shooting,
    model: Model,
    candidate: Candidate,
    start: Start | None = None,
    iterations: int = 6,
    tried: float = 1.0,
) -> Model:
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
