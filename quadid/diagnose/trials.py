"""Which causes are worth a refit, and what the refit brings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadid.chi_square import exceeded
from quadid.diagnose.acceptance import FALSE_ALARM, LEAST_SHARE
from quadid.diagnose.blocks import paired_gain
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.climb import LINEAR_MISFIT
from quadid.diagnose.exchange import LEAST_GAIN, NEAR, Trial
from quadid.diagnose.models import Model, Sketch, extend, fit_model, sketch, thinned
from quadid.diagnose.screen import Score
from quadid.identify.shooting import MEASURED, Shooting

FloatArray = NDArray[np.float64]

MOST_SKETCHES = 10
"""Most linear candidates whose gain is predicted while the misfit is large."""
FAR_SEGMENTS = 60
"""Segments on which candidates are compared while the misfit is large, and so any difference shows on a few."""
FEWEST_REFITS, MOST_REFITS = 3, 7
"""Fewest and most candidates refitted in one round."""


@dataclass(frozen=True)
class Draft:
    """A candidate worth refitting: what it should gain, and where to start."""

    score: Score
    drop: float
    start: FloatArray | Sketch | None


def drafts_of(
    shooting: Shooting, model: Model, scores: list[Score], tests: int, elsewhere: Sequence[FloatArray]
) -> list[Draft]:
    """Candidates to refit: the best by prediction, and look-alikes that come near them."""
    far = model.reduced_chi_square > LINEAR_MISFIT
    least = 0.5 * max(exceeded(FALSE_ALARM / tests, 1), LEAST_GAIN, LEAST_SHARE * model.rows)
    linear = [s for s in scores if not s.candidate.starts and s.drop > least][:MOST_SKETCHES]
    thin, base, every = thinned(shooting, model, FAR_SEGMENTS) if far else (shooting, model, 1)
    drafts = []
    for score in _one_corner([s for s in scores if s.candidate.starts or s in linear]):
        if score.candidate.timed is not None:
            drafts.append(Draft(score, score.drop, None))
        elif score.candidate.starts or far:
            drawn = sketch(thin, base, score.candidate, elsewhere if far else ())
            drop = max(every * drawn.drop, score.drop) if far else drawn.drop
            # Far from the optimum the model's initial states are as wrong as its parameters: begin at measured ones.
            drafts.append(Draft(score, drop, replace(drawn, states=MEASURED) if far else drawn))
        else:
            drafts.append(Draft(score, score.drop, model.theta))
    drafts = sorted((d for d in drafts if d.drop > least), key=lambda d: -d.drop)
    near = [d for d in drafts if d.drop > NEAR * drafts[0].drop]
    return near[:MOST_REFITS] if len(near) > FEWEST_REFITS else drafts[:FEWEST_REFITS]


def _one_corner(scores: list[Score]) -> list[Score]:
    """Of the rotors, only the two best need a refit."""
    weak = [s for s in scores if s.candidate.effect == "weak_rotor"]
    drop = {id(s) for s in weak[2:]}
    return [s for s in scores if id(s) not in drop]


def tried(shooting: Shooting, model: Model, draft: Draft, tests: int) -> Trial:
    """Refits `model` with the candidate of a draft; `tests` alternatives were looked at."""
    candidate, time = draft.score.candidate, draft.score.time
    start = draft.start
    if candidate.timed is not None and time is not None:
        start = model.theta.copy()
        start[candidate.timed] = time
    extended = extend(shooting, model, candidate, start)
    if candidate.timed is not None:
        extended = _refine_time(shooting, extended, candidate)
    gain = paired_gain(model.held_out, extended.held_out)
    return Trial(candidate, extended, gain, model.deviance - extended.deviance, tests * draft.score.trials)


def _refine_time(shooting: Shooting, model: Model, candidate: Candidate) -> Model:
    """Moves the onset in ever smaller steps around the best, other parameters fixed, then refits."""
    assert candidate.timed is not None
    none = shooting.free([])
    best_theta = model.theta
    for step in (0.2, 0.05):
        costs = []
        for offset in (-2.0, -1.0, 0.0, 1.0, 2.0):
            theta = best_theta.copy()
            theta[candidate.timed] += offset * step
            costs.append((float(shooting.linearise(theta, none, model.states).cost.sum()), offset, theta))
        best_theta = min(costs, key=lambda c: c[0])[2]
    return replace(fit_model(shooting, best_theta, model.causes, model.states, iterations=4), worth=model.worth)
