"""Errors of a diagnosis as an identification of the same flights states them, by which its verdict is judged.

What decides between causes is the deviance of the longest segments that the model follows, around noise that is
estimated anew as causes become known.  What is stated is the measure of `quadid.identify.score`: runs of one second, in
the noise that the identification estimated, from the parameters that the identification found.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import add
from typing import NamedTuple

import numpy as np

from quadid.diagnose.attribution import Validation
from quadid.diagnose.cross_validation import block_labels, steps_without, sum_by_block
from quadid.diagnose.model import Model, free_names
from quadid.identify.gauss_newton import polish
from quadid.identify.noise_model import NoiseModel
from quadid.identify.priors import default_prior, posterior_covariance
from quadid.identify.reliability import MISFIT
from quadid.identify.score import SCORE_SECONDS, Tally, covering, mse_score, settle_states, tallied
from quadid.identify.shooting import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Window


class Identified(NamedTuple):
    """The nominal model and the noise that errors are stated with: vehicle, full vector, noise."""

    vehicle: Vehicle
    theta: FloatArray
    noise: NoiseModel


def stated_errors(
    nominal: Identified, model: Model, windows: Sequence[Window], validation: Sequence[Window],
    deciding: tuple[float, float],
) -> Validation:  # fmt: skip
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
        on, scorer = "held-out blocks", _scorer(nominal, windows)
        names = list(NOMINAL_NAMES), free_names(model.causes)
        before, after = (left_out_error(scorer, theta, free) for theta, free in zip(both, names, strict=True))
    # What happens at a moment of one flight happens at none of another.
    comparable = bool(model.causes) and not (validation and any(c.timed is not None for c in model.causes))
    without, refitted = halves or (before, after)
    contradicted = comparable and refitted > MISFIT * without
    return Validation(before, after, on, deciding, refitted if halves else None, contradicted)


def left_out_error(scorer: Shooting, theta: FloatArray, names: Sequence[str]) -> float:
    """Error of each block with what the block itself did to the parameters undone, to first order.

    Args:
        scorer: the data in segments of `SCORE_SECONDS`, with the noise that counts.
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
        if any(len(k) for k in kept):
            parts.append(tallied(scorer.taking(kept), free.move(theta, moved)))
    return reduce(add, parts).mse if parts else float("inf")


def _scorer(nominal: Identified, windows: Sequence[Window]) -> Shooting:
    shooting = Shooting.cut(windows, nominal.vehicle, SCORE_SECONDS)
    return shooting.with_noise(covering(nominal.noise, shooting.channels, nominal.vehicle))


def _second_halves(nominal: Identified, model: Model, logs: Sequence[Window]) -> tuple[float, float] | None:
    """Errors of second halves of logs without and with the findings, what belongs to a flight refitted on the first.

    None where nothing belongs to a flight, or no log is long enough.
    """
    scorer, per_log = _scorer(nominal, logs), model.per_log_names
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
