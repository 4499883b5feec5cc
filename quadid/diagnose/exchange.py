"""One cause for another: causes taken out, look-alikes tried in their place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.blocks import Gain, paired_gain
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.models import Model, extend, fit_model, sketch
from quadid.diagnose.screen import Score
from quadid.effects import NEVER
from quadid.identify.shooting import Shooting

FloatArray = NDArray[np.float64]

NEAR = 0.4
"""Candidates that should gain this share of what the best one should are refitted beside it."""
LEAST_GAIN = 15.0
"""Deviance that a gain on unseen blocks must exceed."""

FAR_AHEAD = 5.0
"""Standard errors by which one look-alike leads another that need not be compared again on longer segments."""


@dataclass(frozen=True)
class Trial:
    """One candidate refitted: the extended model, what it gains on blocks not fitted and on fitted data, tests made."""

    candidate: Candidate
    model: Model
    gain: Gain
    drop: float
    tests: int

    @property
    def evidence(self) -> float:
        """Chi-square of the new parameters: the smaller of the fall in deviance and the robust Wald statistic."""
        return min(self.drop, self.model.wald(self.candidate))


@dataclass(frozen=True)
class Round:
    """One step of the selection: all candidates refitted, and the one accepted (or None)."""

    trials: tuple[Trial, ...]
    accepted: Trial | None
    screened: tuple[Score, ...]


def swap_look_alikes(
    shooting: Shooting, model: Model, listed: Sequence[Candidate], earlier: Sequence[Round] = ()
) -> tuple[Model, list[Round]]:
    """Puts a look-alike in the place of a cause where that fits unseen blocks better, or as well with fewer numbers.

    Which of two look-alikes was taken first may have been decided on segments too short to tell them apart, or before
    another cause was known.

    Args:
        shooting: the problem.
        model: the selected model.
        listed: the catalogue.
        earlier: comparisons made before; a cause far ahead of its rivals then is not set beside them again, unless one
            of its family has come into the model since.

    Returns:
        The better model, and for each cause what its rivals did in its place.
    """
    rounds = []
    ahead = {r.accepted.candidate.label for r in earlier if r.accepted is not None and _far_ahead(r)}
    for cause in model.causes:
        rivals = _rivals(model, cause, listed)
        alone = not any(c.family == cause.family and c.label != cause.label for c in model.causes)
        if not rivals or (cause.label in ahead and alone) or any(c.requires == cause.effect for c in model.causes):
            continue
        rest = without(shooting, model, cause)
        sketches = sorted(((sketch(shooting, rest, r), r) for r in rivals), key=lambda pair: -pair[0].drop)
        worth = rest.deviance - model.deviance
        drawn = [(s, r) for s, r in sketches if s.drop > NEAR * worth][:2]
        trials = [_stand_in(rest, extend(shooting, rest, r, s), r) for s, r in drawn]
        if not trials:
            continue
        holder = _stand_in(rest, model, cause)
        best = max(trials, key=lambda t: t.gain.total)
        gain = paired_gain(model.held_out, best.model.held_out)
        simpler = len(best.candidate.names) < len(cause.names) and gain.total > 0.0
        swapped = simpler or (gain.total > LEAST_GAIN and gain.total > gain.error)
        rounds.append(Round((holder, *trials), best if swapped else holder, ()))
        model = best.model if swapped else model
    return model, rounds


def _far_ahead(comparison: Round) -> bool:
    """Whether the accepted cause did better than every rival by far more than chance."""
    assert comparison.accepted is not None
    best = comparison.accepted
    leads = [paired_gain(t.model.held_out, best.model.held_out) for t in comparison.trials if t is not best]
    return all(lead.total > max(FAR_AHEAD * lead.error, LEAST_GAIN) for lead in leads)


def _stand_in(rest: Model, model: Model, candidate: Candidate) -> Trial:
    """What a candidate does for `rest`, the model without it."""
    return Trial(candidate, model, paired_gain(rest.held_out, model.held_out), rest.deviance - model.deviance, 1)


def _rivals(model: Model, cause: Candidate, listed: Sequence[Candidate]) -> list[Candidate]:
    present = {c.label for c in model.causes}
    return [
        c for c in listed
        if c.family == cause.family and c.label not in present and not c.split and c.timed is None
        and c.effect != cause.effect
    ]  # fmt: skip


def split_causes(model: Model) -> Model:
    """Replaces a joint cause by the causes it stands for; the parameters are the same."""
    causes: list[Candidate] = []
    for c in model.causes:
        causes += [part for part in (c.split or (c,)) if part.label not in {x.label for x in causes}]
    return replace(model, causes=tuple(causes))


def without(shooting: Shooting, model: Model, cause: Candidate) -> Model:
    """Refits `model` without `cause` and what requires it."""
    left, theta = left_over(shooting, model, cause)
    return replace(fit_model(shooting, theta, left, model.states, tolerance=0.2), worth=model.worth)


def left_over(shooting: Shooting, model: Model, cause: Candidate) -> tuple[tuple[Candidate, ...], FloatArray]:
    """Causes of `model` but `cause` and what requires it, and the parameter vector with those at neutral."""
    left = tuple(c for c in model.causes if c.label != cause.label and c.requires != cause.effect)
    gone = [c for c in model.causes if c not in left]
    theta = model.theta.copy()
    for c in gone:
        theta[shooting.free(list(c.names)).index] = 0.0
        if c.timed is not None:
            theta[c.timed] = NEVER
    return left, theta
