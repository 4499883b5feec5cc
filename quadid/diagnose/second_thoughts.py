"""A cause beside those it was once preferred to, now that the others are known.

Two effects at once may look most like a third: a change of mass beside a fading battery like inflow.  Look-alikes of
its own family each cause meets in `quadid.diagnose.exchange`; here it meets the others that came close.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.acceptance import CLOSE, context_of, significant
from quadid.diagnose.blocks import paired_gain
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.climb import Climb
from quadid.diagnose.exchange import LEAST_GAIN, Round, Trial, split_causes, without
from quadid.diagnose.models import Model
from quadid.diagnose.screen import screen
from quadid.diagnose.trials import drafts_of, tried

FloatArray = NDArray[np.float64]


def second_thought(climb: Climb, rounds: Sequence[Round], tests: int, elsewhere: Sequence[FloatArray]) -> Round | None:
    """Sets each cause that won a round beside those that came close in it.

    Args:
        climb: the problem that decides and the selected model.
        rounds: what was tried so far.
        tests: number of alternatives looked at, for the correction.
        elsewhere: nominal parameters, shape (6,), to start from too while the misfit is large.

    Returns:
        The first comparison that another cause wins; None where all stay.
    """
    model = climb.model
    present = {c.label for c in model.causes}
    for cause in model.causes:
        rivals = [r for r in _close_seconds(rounds, cause) if r.label not in present]
        if not rivals or any(c.requires == cause.effect for c in model.causes):
            continue
        trials = _in_its_place(climb, cause, rivals, tests, elsewhere)
        if not trials:
            continue
        best = max(trials, key=lambda t: t.gain.total)
        lead = paired_gain(model.held_out, best.model.held_out)
        if lead.total > max(LEAST_GAIN, lead.error):
            return Round(tuple(trials), best, ())
    return None


def _in_its_place(
    climb: Climb, cause: Candidate, rivals: Sequence[Candidate], tests: int, elsewhere: Sequence[FloatArray]
) -> list[Trial]:
    """The rivals that would be accepted if `cause` were not in the model."""
    rest = without(climb.shooting, climb.model, cause)
    possible = [r for r in rivals if r.requires is None or r.requires in rest.effects]
    drafts = drafts_of(climb.shooting, rest, screen(climb.shooting, rest, possible), tests, elsewhere)
    trials = [tried(climb.shooting, rest, d, tests) for d in drafts]
    context = context_of(rest, climb.base)
    good = [t for t in trials if significant(t.gain, t.evidence, t.candidate, t.tests, context)]
    return [replace(t, model=_named(t)) for t in good]


def _named(trial: Trial) -> Model:
    worth = {**trial.model.worth, trial.candidate.label: trial.gain.total}
    return split_causes(replace(trial.model, worth=worth))


def _close_seconds(rounds: Sequence[Round], cause: Candidate) -> list[Candidate]:
    """Causes of other families that gained nearly as much when `cause` was accepted."""
    out = []
    for step in rounds:
        if step.accepted is not None and step.accepted.candidate.label == cause.label:
            near = [t for t in step.trials if t.gain.total > CLOSE * step.accepted.gain.total]
            out += [t.candidate for t in near if t.candidate.family != cause.family]
    return list(dict.fromkeys(out))
