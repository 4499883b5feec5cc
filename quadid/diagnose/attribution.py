"""What each finding is worth on data that neither the fit nor the selection saw, and which ones any vehicle has.

Every real vehicle has its centre of gravity half a millimetre off and rotors that differ by half a percent.  Taking one
such cause out of the model and counting what is lost would rank it by what its neighbours were forbidden to take up.
So the model a cause is measured against may use the whole catalogue, within the small sizes that any vehicle has: a
cause is worth what none of these can explain.

With validation logs the parameters stay as fitted; values that belong to a flight (`per_log`) are carried over, and, as
a second figure, refitted on the first half of each validation log and scored on its second half.  Without such logs,
ten-second blocks of the training log are left out in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.diagnose.cross_validation import block_labels, paired_gain
from quadid.diagnose.hypotheses import Candidate, all_names
from quadid.diagnose.model import Model, as_model, free_names, taken_out
from quadid.effects import EFFECTS
from quadid.identify.gauss_newton import polish
from quadid.identify.parameterization import Free
from quadid.identify.score import settle_states
from quadid.identify.shooting import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.window import Window

UNTIDY = 0.2
"""How far, in typical sizes, each effect may be from neutral, or from its found value, on any vehicle."""


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
class Validation:
    """Error on unseen data: flights given for validation, else blocks left out; noise floor 1.

    Attributes:
        nominal, extended: mean squared error without and with the findings, as `stated_errors` has it.
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


def untidy_names(listed: Sequence[Candidate]) -> list[str]:
    """Entries of the catalogue that may be a little off on any vehicle; changes at a moment are events, not clutter."""
    return all_names([c for c in listed if c.timed is None and not c.refines and not EFFECTS[c.effect].needs])


def without_in_clutter(shooting: Shooting, model: Model, cause: Candidate | None, listed: Sequence[Candidate]) -> Model:
    """Refits `model` without `cause` (None: with all its causes) amid clutter.

    Nominal parameters are free, effects that are left move within the sizes of clutter.

    Args:
        shooting: the problem.
        model: the extended model.
        cause: what to take out.
        listed: the catalogue.
    """
    left = taken_out(shooting, model, cause)
    gone = set(free_names(model.causes)) - set(free_names(left.causes))
    free = _boxed(shooting, [n for n in clutter_names(model, listed) if n not in gone], left.theta)
    result = polish(shooting, left.theta, free, states=model.states, iterations=5, tolerance=0.1, settled=True)
    return as_model(shooting, result, free, left.causes)


def ordinary(shooting: Shooting, model: Model, cause: Candidate, listed: Sequence[Candidate]) -> bool:
    """Whether `cause` is no larger in `model` than it may be on any vehicle."""
    return untidy_sized(shooting.free(cause.names), model.theta) and set(cause.names) <= set(untidy_names(listed))


def untidy_sized(effects: Free, theta: FloatArray) -> bool:
    """Whether no number of `effects` is further from neutral at `theta` than it may be on any vehicle."""
    return bool(np.all(np.abs(effects.from_neutral(theta)) <= UNTIDY))


def clutter_names(model: Model, listed: Sequence[Candidate]) -> list[str]:
    """Entries of the model and of the untidy rest."""
    return list(dict.fromkeys([*model.free.names, *untidy_names(listed)]))


def _boxed(shooting: Shooting, names: Sequence[str], theta: FloatArray) -> Free:
    """Free parameters whose effects stay within untidy sizes of where `theta` has them."""
    out = []
    for entry in shooting.free(names).entries:
        if entry.name not in NOMINAL_NAMES:
            room, value = UNTIDY * entry.typical, float(theta[entry.index])
            entry = replace(entry, lower=max(entry.lower, value - room), upper=min(entry.upper, value + room))
        out.append(entry)
    return Free(tuple(out))


_NOMINAL, _FOUND, _AMID = "nominal", "found", "amid clutter"
"""Keys of models beside those from which one cause was taken out: without causes, as found, with all amid clutter."""
Errors = dict[str, tuple[FloatArray, float]]
"""Deviance of each block of unseen data, and independent rows, by key of a model."""


@dataclass(frozen=True)
class Worth:
    """Benefit of one cause given all others; `ordinary` ones are no larger than on any vehicle."""

    cause: Candidate
    benefit: Benefit
    deviance: float
    ordinary: bool = False


def validate(
    decisive: Shooting, nominal: Model, model: Model, logs: Sequence[Window], listed: Sequence[Candidate]
) -> tuple[tuple[float, float], tuple[Worth, ...]]:
    """Scores nominal and extended model on unseen data, and each cause by leaving it out (`without_in_clutter`).

    Args:
        decisive: the problem that decided.
        nominal: without causes.
        model: the selected one.
        logs: validation flights; none: blocks of the training data are left out.
        listed: the catalogue.

    Returns:
        The errors without and with all causes in the segments that decided, and the worth of each cause: what is larger
        than on any vehicle first, then by gain.
    """
    models = {_NOMINAL: nominal, _FOUND: model}
    if model.causes:
        models[_AMID] = without_in_clutter(decisive, model, None, listed)
        models |= {c.label: without_in_clutter(decisive, model, c, listed) for c in model.causes}
    left_out: Errors = {key: (m.held_out, m.rows) for key, m in models.items()}
    unseen = left_out
    if logs:
        scorer = decisive.on(logs)
        unseen = {key: block_deviance(scorer, m) for key, m in models.items()}
    before, after = (float(total.sum()) / rows for total, rows in (unseen[_NOMINAL], unseen[_FOUND]))
    worth = []
    for cause in model.causes:
        # A value that belongs to the training flight is measured there, on blocks left out.
        errors = left_out if EFFECTS[cause.effect].per_log else unseen
        worth.append(_worth(cause, errors, ordinary(decisive, model, cause, listed), decisive.seconds))
    worth.sort(key=lambda w: (w.ordinary, -w.deviance))
    return (before, after), tuple(worth)


def _worth(cause: Candidate, errors: Errors, ordinary: bool, seconds: float) -> Worth:
    """Worth from the deviance of each block without and with the cause, both amid clutter; runs of so many seconds."""
    found, rows = errors[_FOUND]
    gain, mse = paired_gain(errors[cause.label][0], errors[_AMID][0]), float(found.sum()) / rows
    low, high = gain.interval
    benefit = Benefit(mse + gain.total / rows, mse, (low / rows, high / rows), seconds)
    return Worth(cause, benefit, gain.total, ordinary)


def block_deviance(scorer: Shooting, model: Model) -> tuple[FloatArray, float]:
    """Deviance of each block of unseen data with parameters as fitted, and the independent rows."""
    names = [n for c in model.causes for n in c.names]
    lin = settle_states(scorer, model.theta, names)
    labels = block_labels(lin)
    total = np.zeros(int(labels.max()) + 1)
    np.add.at(total, labels, lin.cost + lin.occam)
    return total, lin.total_rows
