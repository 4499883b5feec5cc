"""Errors of a diagnosis as an identification of the same flights states them.

What decides a diagnosis is the deviance of the longest segments that the model follows, around noise that is estimated
anew as causes become known.  What it states is the measure of `quadid.identify.score`: runs of one second, in the noise
that the identification estimated, from the parameters that the identification found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quadid.diagnose.attribution import Validation, second_halves
from quadid.diagnose.cross_validation import block_labels, steps_without, sum_by_block
from quadid.diagnose.model import Model, free_names
from quadid.identify.fit import Fit
from quadid.identify.priors import default_prior, posterior_covariance
from quadid.identify.score import SCORE_SECONDS, Tally, covering, mse_score, settle_states, tallied
from quadid.identify.shooting import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.window import Window


def stated_errors(
    fit: Fit, model: Model, windows: Sequence[Window], validation: Sequence[Window], decided: Validation
) -> Validation:
    """Errors without and with the findings, as `mse_score` has them; without validation logs, of blocks left out.

    Args:
        fit: identification of `windows`: the nominal model, and the noise.
        model: the extended one.
        windows: what was diagnosed.
        validation: flights that were not.
        decided: the figures that decided.
    """
    if validation:
        before, after = (mse_score(validation, fit.vehicle, theta, fit.noise).mse for theta in (fit.theta, model.theta))
        return replace(decided, nominal=before, extended=after, refitted=_refitted(fit, model, validation))
    names = list(NOMINAL_NAMES), free_names(model.causes)
    before, after = (
        left_out_error(_scorer(fit, windows), theta, free)
        for theta, free in zip((fit.theta, model.theta), names, strict=True)
    )
    return replace(decided, nominal=before, extended=after)


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
    total: Tally | None = None
    for block, moved in enumerate(step):
        kept = [np.flatnonzero(labels[lin.window == i] == block) for i in range(len(scorer.rollouts))]
        if any(len(k) for k in kept):
            part = tallied(scorer.taking(kept), free.move(theta, moved))
            total = part if total is None else total + part
    return float("inf") if total is None else total.mse


def _scorer(fit: Fit, windows: Sequence[Window]) -> Shooting:
    shooting = Shooting.cut(windows, fit.vehicle, SCORE_SECONDS)
    return shooting.with_noise(covering(fit.noise, shooting.channels, fit.vehicle))


def _refitted(fit: Fit, model: Model, logs: Sequence[Window]) -> float | None:
    """Error of the second half of each log, what belongs to a flight refitted on its first; None without such."""
    total: Tally | None = None
    for second, theta in second_halves(_scorer(fit, logs), model, logs):
        part = tallied(second, theta)
        total = part if total is None else total + part
    return None if total is None else total.mse
