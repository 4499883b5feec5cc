"""Gain of the findings on data that neither the fit nor the selection saw: each of them, and all together.

A cause is worth what is lost without it, all others refitted, in the segments that decided.  With validation logs the
parameters stay as fitted there, and values that belong to a flight (`per_log`) are carried over; without such logs
tenths of the training log are left out in turn.  Causes no larger than on any vehicle come last.

What all of them gain is stated as an identification of the same flights states errors, and the verdict goes by that:
runs of one second, in the noise that the identification estimated, from the parameters that the identification found
(`quadid.identification.result`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import NamedTuple

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.hypotheses import (
    Candidate,
    Model,
    block_labels,
    free_names,
    paired_gain,
    steps_without,
    sum_by_block,
)
from quadid.effects import EFFECTS
from quadid.identification.fit import Fit
from quadid.identification.gauss_newton import polish
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Shooting, default_prior, posterior_covariance
from quadid.identification.result import Tally, mse_score, scored_problem, settle_states, tallied
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

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
