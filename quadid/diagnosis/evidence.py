"""Evidence: what a move of the search promises, which model is better, which numbers are possible, gain elsewhere."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import NamedTuple, TypeVar

import numpy as np

from quadid.chi_square import Z95, exceeded, survival
from quadid.data.window import Window
from quadid.diagnosis import random_forces
from quadid.diagnosis.hypotheses import (
    RELEVANT,
    Candidate,
    Model,
    Named,
    block_labels,
    calibration,
    free_names,
    paired_gain,
    steps_without,
    sum_by_block,
    taken_out_causes,
    unset_times,
)
from quadid.effects import EFFECTS
from quadid.identification.elimination import eliminated, freed
from quadid.identification.fit import Fit
from quadid.identification.gauss_newton import polish
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Linearised, Shooting, default_prior, posterior_covariance, prior_terms
from quadid.identification.result import Tally, mse_score, scored_problem, settle_states, tallied
from quadid.parameters import NOMINAL_NAMES, Parameter, Status, at_bound
from quadid.types import FloatArray, IndexArray
from quadid.vehicle import Vehicle

# --- Gain of the findings on data that neither the fit nor the selection saw: each of them, and all together
#
# A cause is worth what is lost without it, all others refitted, in the segments that decided.  With validation logs the
# parameters stay as fitted there, and values that belong to a flight (`per_log`) are carried over; without such logs
# tenths of the training log are left out in turn.  Causes no larger than on any vehicle come last.
#
# What all of them gain is stated as an identification of the same flights states errors, and the verdict goes by that:
# runs of one second, in the noise that the identification estimated, from the parameters that the identification found
# (`quadid.identification.result`).


WORSE = 1.1
"""Error of unseen data with the findings over that without, beyond which they are contradicted."""
UNTIDY = 0.2
"""Distance from neutral, in typical sizes, of an effect's numbers on any vehicle."""


@dataclass(frozen=True)
class Benefit:
    """Mean squared error (noise floor 1) on unseen data before and after, and the 95 % interval of the difference.

    `seconds` is the length of the simulated runs; the longer, the larger the error of a model that lacks something.
    """

    mse_before: float
    mse_after: float
    ci95: tuple[float, float]
    seconds: float


@dataclass(frozen=True)
class Worth:
    """Benefit of one cause given all others, and the deviance it takes away; `ordinary`: as on any vehicle."""

    cause: Candidate
    benefit: Benefit
    deviance: float
    ordinary: bool = False


@dataclass(frozen=True)
class Validation:
    """Error on unseen data: flights given for validation, else blocks left out; noise floor 1.

    Attributes:
        nominal, extended: mean squared error without and with the findings, as an identification states it.
        on: ``validation logs`` or ``held-out blocks``.
        deciding: the same two of the segments that decided the diagnosis.
        refitted: extended, with per-log values refitted on the first half of each log and scored on the second; only
            where there are such.
        contradicted: the findings make the stated error of unseen data worse by more than a tenth, refitted as above.
    """

    nominal: float
    extended: float
    on: str
    deciding: tuple[float, float]
    refitted: float | None = None
    contradicted: bool = False


def untidy_sized(model: Model, cause: Candidate) -> bool:
    """Checks whether no number of `cause` is further from neutral in `model` than it may be on any vehicle."""
    return bool(np.all(np.abs(model.numbers(cause).from_neutral(model.theta)) <= UNTIDY))


def ordinary(model: Model, cause: Candidate) -> bool:
    """True if any vehicle may have `cause` as large as it is in `model`; no event, wind or ground is ordinary."""
    apart = cause.timed is not None or cause.refines or bool(EFFECTS[cause.effect].needs)
    return not apart and untidy_sized(model, cause)


_NONE, _ALL = "no cause", "all causes"


def cause_gains(
    decisive: Shooting, nominal: Model, model: Model, without: Mapping[str, Model], logs: Sequence[Window]
) -> tuple[tuple[float, float], tuple[Worth, ...]]:
    """Errors on unseen data in the segments that decided, and what each cause takes off them.

    Args:
        decisive: the problem that decided.
        nominal: without causes.
        model: the selected one.
        without: the same without each of its causes, by label.
        logs: validation flights; none: blocks of the training data are left out.

    Returns:
        The errors without and with all causes, and the worth of each: what is larger than on any vehicle first, then by
        gain.
    """
    models = {_NONE: nominal, _ALL: model, **without}
    left_out = {key: (m.held_out, m.rows) for key, m in models.items()}
    unseen = left_out
    if logs:
        scorer = decisive.on(logs)
        unseen = {key: block_deviance(scorer, m) for key, m in models.items()}
    out = []
    for cause in model.causes:
        # A value that belongs to the training flight is measured there, on blocks left out.
        errors = left_out if EFFECTS[cause.effect].per_log else unseen
        found, rows = errors[_ALL]
        gain, mse = paired_gain(errors[cause.label][0], found), float(found.sum()) / rows
        low, high = gain.interval
        benefit = Benefit(mse + gain.total / rows, mse, (low / rows, high / rows), decisive.seconds)
        out.append(Worth(cause, benefit, gain.total, ordinary(model, cause)))
    out.sort(key=lambda w: (w.ordinary, -w.deviance))
    before, after = (float(total.sum()) / rows for total, rows in (unseen[_NONE], unseen[_ALL]))
    return (before, after), tuple(out)


def block_deviance(scorer: Shooting, model: Model) -> tuple[FloatArray, float]:
    """Deviance of each block of unseen data with parameters as fitted, and the independent rows."""
    lin = settle_states(scorer, model.theta, [n for c in model.causes for n in c.names])
    return sum_by_block(lin.cost + lin.occam, block_labels(lin)), lin.total_rows


class NominalFit(NamedTuple):
    """The nominal model and the noise that errors are stated with: vehicle, full vector, noise."""

    vehicle: Vehicle
    theta: FloatArray
    noise: NoiseModel


def stated_errors(
    nominal: NominalFit | Fit,
    model: Model,
    windows: Sequence[Window],
    validation: Sequence[Window],
    deciding: tuple[float, float],
) -> Validation:
    """Errors without and with the findings, as `mse_score` has them; without validation logs, of blocks left out.

    Args:
        nominal: identification of `windows`.
        model: the extended one.
        windows: what was diagnosed.
        validation: flights that were not.
        deciding: errors without and with the findings in the segments that decided.
    """
    both, halves = (nominal.theta, model.theta), None
    if validation:
        on = "validation logs"
        before, after = (mse_score(validation, nominal.vehicle, theta, nominal.noise).mse for theta in both)
        halves = _second_halves(nominal, model, validation)
    else:
        on, scorer = "held-out blocks", scored_problem(windows, nominal.vehicle, nominal.noise)
        names = list(NOMINAL_NAMES), free_names(model.causes)
        before, after = (left_out_error(scorer, theta, free) for theta, free in zip(both, names, strict=True))
    # What happens at a moment of one flight happens at none of another.
    comparable = bool(model.causes) and not (validation and any(c.timed is not None for c in model.causes))
    without, refitted = halves or (before, after)
    contradicted = comparable and refitted > WORSE * without
    return Validation(before, after, on, deciding, refitted if halves else None, contradicted)


def left_out_error(scorer: Shooting, theta: FloatArray, names: Sequence[str]) -> float:
    """Error of each block with what the block itself did to the parameters undone, to first order.

    Args:
        scorer: the data in segments that decide (`pipeline.DECIDE_SECONDS`), with the noise that counts.
        theta: fitted to these data, full vector.
        names: what was fitted.
    """
    free = scorer.free(names)
    lin = scorer.linearise(theta, free, settle_states(scorer, theta).states)
    if not np.isfinite(lin.cost).all():
        return float("inf")
    labels = block_labels(lin)
    gram, grad = (sum_by_block(a, labels) for a in (lin.gram, lin.grad))
    prior = default_prior(scorer, free)
    step = posterior_covariance(lin.information, prior) @ lin.gradient + steps_without(gram, grad, prior.precision)
    parts = []
    for block, moved in enumerate(step):
        kept = [np.flatnonzero(labels[lin.window == i] == block) for i in range(len(scorer.rollouts))]
        parts.append(tallied(scorer.taking(kept), free.move(theta, moved)))
    return reduce(add, parts).mse


def _second_halves(nominal: NominalFit | Fit, model: Model, logs: Sequence[Window]) -> tuple[float, float] | None:
    """Errors of second halves of logs without and with the findings, what belongs to a flight refitted on the first.

    None where nothing belongs to a flight, or no log is long enough.
    """
    scorer = scored_problem(logs, nominal.vehicle, nominal.noise)
    per_log = [n for c in model.causes if EFFECTS[c.effect].per_log and c.timed is None for n in c.names]
    totals: list[tuple[Tally, Tally]] = []
    for window in logs:
        middle = len(window) // 2
        if per_log and middle >= 4 * scorer.length:
            first, second = (scorer.on([w]) for w in (window.slice(0, middle), window.slice(middle, len(window))))
            refitted = polish(first, model.theta, first.free(per_log), iterations=6).theta
            totals.append((tallied(second, nominal.theta), tallied(second, refitted)))
    if not totals:
        return None
    without, found = (reduce(add, parts).mse for parts in zip(*totals, strict=True))
    return without, found


# --- The one score: is model B better than model A?
#
# Twice the logarithm of the marginal likelihood by Laplace's approximation, with the priors that exist: on parameters
# those of the fit, on models that a cause is absent until proven (`FALSE_ALARM` shared by all that were tried).  Where
# the model leaves more than noise, or noise with a memory, squared errors are worth less than their size: deviances
# are divided by the ratio of the scores' true variance to that which the model counts on (Godambe, Ann. Math. Stat. 31
# (1960) 1208; as magnitude adjustment of a composite likelihood in Ribatet, Cooley and Davison, Statistica Sinica 22
# (2012) 813).  A cause must besides be of use: on blocks of data that its fit did not see it has to gain a share of
# the noise.


FALSE_ALARM = 1e-3
"""Prior probability that a flight has any cause to be named, shared by all that are tried: that of a false alarm."""


M = TypeVar("M", Model, random_forces.Model)
"""A model fitted by either likelihood."""


def better(b: M, a: M) -> bool:
    """Checks whether `b` is better than `a`: more likely, and of models of which one contains the other also of use."""
    if b.labels < a.labels:
        return not better(a, b)
    if a.labels < b.labels and not b.gains_beside(a):
        return False
    return advantage(b, a) > 0.0


def advantage(b: M, a: M) -> float:
    """Twice the log evidence of `b` less that of `a`, times the calibration, between models of the same data and noise.

    Each model pays for what only it has by the calibration of its own scores: where a parameter's scores vary much more
    than the deviance counts on, that is no reason to count less what the other model explains.
    """
    return a.deviance - b.deviance + _cost(a, b) - _cost(b, a)


def _cost(model: M, other: M) -> float:
    """Deviance that the causes and parameters which only `model` has must take away for it to be as likely."""
    own = np.array([key not in other.keys for key in model.keys])
    prior = float(sum(2.0 * np.log(model.tried[label] / FALSE_ALARM) for label in model.labels - other.labels))
    if not own.any():
        return prior
    ratio = calibration(model.inflation[own])
    gram = model.information / np.sqrt(np.outer(model.precision, model.precision))
    wide = np.eye(len(gram)) + gram / ratio
    occam = np.linalg.slogdet(wide)[1] - np.linalg.slogdet(wide[np.ix_(~own, ~own)])[1]
    return ratio * (float(occam) + prior)


def worth_a_refit(tests: int, rows: float) -> float:
    """Predicted fall of the deviance below which a cause cannot win: half of what it must gain."""
    return 0.5 * max(exceeded(FALSE_ALARM / tests, 1), RELEVANT * rows)


# --- Score tests: what each move of the selection should bring, from one linearisation of everything
#
# One Jacobian of the whole catalogue, with initial states eliminated segment by segment, gives the predicted deviance
# of every model that adds a cause, drops one or puts one in another's place, by linear algebra (Rao, Proc. Camb. Phil.
# Soc. 44 (1948) 50).  Causes that begin at an unknown time are scanned over all segment boundaries by sums from the
# end.


@dataclass(frozen=True)
class Score:
    """Linear prediction for one move.

    Attributes:
        candidate: the cause that comes in.
        drop: predicted fall of the deviance on the fitted data, negative for a rise.
        time: best moment of onset [s] for timed causes.
        trials: how many alternatives were looked at: causes, and onsets of them.
        gone: the cause that leaves; None: none does.
    """

    candidate: Candidate
    drop: float
    time: float | None = None
    trials: int = 1
    gone: Candidate | None = None


class _Own(NamedTuple):
    """The model's own parameters: their information and gradient, prior included, (o, o) and (o,), and columns.

    The gradient counts although it is small at an optimum: only with it is the quadratic a sum of squares, which no
    step can bring below zero, and a fit that stopped short of its optimum promises no more than there is to gain.
    """

    h: FloatArray
    g: FloatArray
    place: IndexArray

    @property
    def fall(self) -> float:
        """Fall of the deviance when they alone follow."""
        return float(self.g @ np.linalg.solve(self.h, self.g))


@dataclass(frozen=True)
class Everything:
    """The current model linearised with every candidate's entries free.

    Attributes:
        model: the current model; listed: the candidates; lin: the linearisation; place: column of each entry.
    """

    model: Model
    listed: Sequence[Candidate]
    lin: Linearised
    place: dict[str, int]

    @classmethod
    def of(cls, shooting: Shooting, model: Model, listed: Sequence[Candidate]) -> "Everything":
        """Linearises `model` with all of `listed` free, but for refinements of what it has not."""
        there = {c.label for c in model.causes}
        some = [c for c in listed if not c.refines or c.requires in there]
        names = list(dict.fromkeys([*model.free.names, *(n for c in some for n in c.names)]))
        theta = unset_times(model.theta, model.effects)
        lin = shooting.linearise(theta, shooting.free(names), model.states)
        return cls(model, listed, lin, {n: i for i, n in enumerate(names)})

    def loss(self, gone: Candidate) -> float:
        """Predicted rise of the deviance when `gone`, and what requires it, is dropped."""
        _, own, risen = self._left(gone)
        return risen - own.fall + self._unspent()

    def scores(self, gone: Candidate | None = None) -> list[Score]:
        """Effect of each candidate that is not in the model, in the place of `gone` if given; best first."""
        lin, own, risen = self._left(gone)
        risen += self._unspent()
        present = set(self.model.free.names)
        there = {name for c in self.model.causes if c is not gone for name in (c.effect, c.label)}
        out = []
        for candidate in self.listed:
            if present.intersection(candidate.names) or (candidate.requires and candidate.requires not in there):
                continue
            mine = np.array([self.place[n] for n in candidate.names])
            found = (_score if candidate.timed is None else _scan)(candidate, lin, own, mine)
            out.append(replace(found, drop=found.drop - risen, trials=found.trials * len(self.listed), gone=gone))
        return sorted(out, key=lambda s: -s.drop)

    def _unspent(self) -> float:
        """Fall of the deviance that the fit of the model itself left undone."""
        return self._left(None)[1].fall

    def _left(self, gone: Candidate | None) -> tuple[Linearised, _Own, float]:
        """The quadratic, the model's parameters and the rise of the deviance where `gone` is neutral."""
        model = self.model
        stays = np.isin(model.free.names, free_names(taken_out_causes(model.causes, gone)))
        place = np.array([self.place[n] for n in model.free.names])
        z = np.zeros(len(self.place))
        z[place[~stays]] = -model.free.from_neutral(model.theta)[~stays]
        moved = self.lin.gram @ z
        lin = replace(self.lin, grad=self.lin.grad + moved)
        precision, pull, _ = prior_terms(model.free, model.prior, model.theta)
        place = place[stays]
        h = lin.information[np.ix_(place, place)] + np.diag(precision[stays])
        own = _Own(h, lin.gradient[place] + pull[stays], place)
        return lin, own, float(np.sum(2.0 * self.lin.grad @ z + moved @ z))


def missed(model: Model, least: float) -> tuple[Candidate, ...]:
    """Causes of `model` whose loss, one after the other, the rest could not make up for: at least `least` of deviance.

    Half of them at most are let go: the linear picture does not hold for all at once.
    """
    h = model.lin.information + np.diag(model.prior.precision)
    z, place = model.free.from_neutral(model.theta), {n: i for i, n in enumerate(model.free.names)}
    kept, alive = list(model.causes), np.ones(len(place), dtype=bool)
    for _ in range(max(len(kept) // 2, 1)):
        losses = []
        for cause in kept:
            if any(cause.carries(c) for c in kept):
                continue
            mine = np.array([place[n] for n in cause.names])
            rest = np.flatnonzero(alive & ~np.isin(np.arange(len(z)), mine))
            left = eliminated(h[np.ix_(mine, mine)], h[np.ix_(mine, rest)], h[np.ix_(rest, rest)])
            losses.append((float(z[mine] @ left.h @ z[mine]), cause, mine))
        if not losses:
            break
        loss, cause, mine = min(losses, key=lambda item: item[0])
        if loss > least:
            break
        kept.remove(cause)
        alive[mine] = False
    return tuple(kept)


def _fall(h_mm: FloatArray, h_mo: FloatArray, g_m: FloatArray, own: _Own) -> FloatArray:
    """Predicted fall of the deviance with candidates' parameters free, the model's own refitted, shape (n,).

    Args:
        h_mm: products of the parameters with themselves, (n, m, m).
        h_mo: and with those of the model, (n, m, o).
        g_m: gradient of the parameters (n, m).
        own: the model's parameters.
    """
    # Directions the model's own parameters already explain carry no information; keep them finite.
    kept = np.eye(h_mm.shape[-1]) * (1e-9 * h_mm + 1e-2)
    return own.fall + freed(h_mm + kept, h_mo, own.h, g_m, own.g)


def _score(candidate: Candidate, lin: Linearised, own: _Own, mine: IndexArray) -> Score:
    h, g = lin.information, lin.gradient
    drop = _fall(h[np.ix_(mine, mine)][None], h[np.ix_(mine, own.place)][None], g[mine][None], own)
    return Score(candidate, float(drop[0]))


def _scan(candidate: Candidate, lin: Linearised, own: _Own, mine: IndexArray) -> Score:
    """Scans the onset over segment boundaries: sums from the end turn the whole-log column into masked ones."""
    order = np.argsort(lin.time, kind="stable")
    from_end = slice(None, None, -1)
    h_mm = np.cumsum(lin.gram[order[:, None, None], mine[:, None], mine][from_end], axis=0)[from_end]
    h_mo = np.cumsum(lin.gram[order[:, None, None], mine[:, None], own.place][from_end], axis=0)[from_end]
    g_m = np.cumsum(lin.grad[order][:, mine][from_end], axis=0)[from_end]
    margin = max(len(order) // 40, 3)
    tried = slice(margin, len(order) - margin)
    drop = _fall(h_mm[tried], h_mo[tried], g_m[tried], own)
    if not len(drop):
        return Score(candidate, -np.inf)
    best = int(np.argmax(drop))
    return Score(candidate, float(drop[best]), float(lin.time[order[margin + best]]), len(order))


# --- Numbers that no vehicle has: what carries them fits, but stands for something else
#
# A fit takes whatever lowers its cost.  Air that pushes, drag that acts a foot above the vehicle, an accelerometer off
# by half of gravity may all be near enough to something that the catalogue lacks; their names are then wrong.  The
# selection prefers causes whose numbers are possible; where none is, the finding is listed without confidence.


LIKELY_SENSOR = 10.0
"""Typical sizes beyond which an error of a sensor is not believed."""
WRONG_SIGN = 0.1
"""Share of its typical size by which a number that cannot be negative may be, for what a fit lays beside the truth."""


def impossible_causes(model: Named) -> dict[str, str]:
    """Causes of `model` with a number that no vehicle has, and which, by label."""
    reasons = {c.label: impossible(model, c) for c in model.causes}
    return {label: reason for label, reason in reasons.items() if reason}


def late_unknown(model: Model, parameters: Sequence[Parameter]) -> dict[str, str]:
    """Lags and delays of `model` that rotation shows beside moments of inertia which are not to be used, by label.

    What is late in rotation is weaker too: a lag beside one inertia is a delay beside another.
    """
    turning = [p for p in parameters if p.name in ("J_xx", "J_yy")]
    if not all(p.status is Status.UNRELIABLE for p in turning):
        return {}
    names = " and ".join(p.name for p in turning)
    reason = f"rotation shows it only together with {names}, which are not to be used"
    return {c.label: reason for c in model.causes if c.family == "late" and EFFECTS[c.effect].turns}


def slight_causes(model: Model) -> dict[str, str]:
    """Causes of `model` that something on any vehicle passes for while they are small, by label, and what.

    Air gets thinner in a climb, rotors carry otherwise in it, and motors warm up: from one part of a flight to the next
    thrust differs, and a step at the border takes that up.  A tilted vertical of the attitude pushes as a wind does.
    """
    step = f"on any vehicle, parts of a flight differ by as much, {UNTIDY:g} of its typical size"
    push = "in still air, an attitude tilted by a degree looks the same"
    small = [c for c in model.causes if untidy_sized(model, c)]
    return {c.label: push if c.timed is None else step for c in small if c.timed is not None or c.effect == "wind"}


def unproven_causes(model: Model, tests: int) -> dict[str, str]:
    """Causes of `model` whose numbers may as well be none, of as many `tests`, by label, and why."""
    reason = "it may be zero: random forces explain as much"
    chance = {c.label: survival(model.wald(c), len(c.names)) * tests for c in model.causes if not c.refines}
    return {label: reason for label, p in chance.items() if p > FALSE_ALARM}


def impossible(model: Named, cause: Candidate) -> str:
    """Number of `cause` that no vehicle has; empty when all are possible."""
    sigma = dict(zip(model.free.names, model.uncertainty.sigma, strict=True))
    for e in model.numbers(cause).entries:
        value = float(model.theta[e.index])
        size, shown = (value - e.neutral) / e.typical, f"{e.name} = {value:.3g} {e.unit}".rstrip()
        if EFFECTS[cause.effect].sized and abs(size) > LIKELY_SENSOR:
            return f"{shown} is more than a sensor that works can have ({LIKELY_SENSOR * e.typical:.3g} {e.unit})"
        if e.sign > 0 and size + Z95 * sigma[e.name] < -WRONG_SIGN:
            return f"{shown} cannot be negative"
        bound = e.lower if value - e.lower <= e.upper - value else e.upper
        if at_bound(value, e.lower, e.upper) and bound != e.neutral:
            return f"{shown} rests on its bound ({bound:.3g} {e.unit})"
    return ""
