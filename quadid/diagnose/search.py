"""Forward selection of causes with look-alikes refitted against each other, and backward elimination."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from quadid.diagnose.blocks import Gain, paired_gain
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.models import Model, extend, fit_model
from quadid.diagnose.screen import Score, screen
from quadid.identify.shooting import Shooting
from quadid.model.layout import NEVER

FloatArray = NDArray[np.float64]

SHORT_LIST = 5
MOST_CAUSES = 12
FALSE_ALARM = 1e-3
"""Chance that a model without any effect is extended at all, shared by all causes tried."""
ERRORS = 2.0
"""A gain on unseen blocks must exceed this many of its standard errors."""
LEAST_GAIN = 8.0
"""… and this much deviance."""
RELATIVE_GAIN = 0.004
"""… and this share of all gains so far, so that the tail of a huge effect is not named as another."""


@dataclass(frozen=True)
class Trial:
    """One candidate refitted: the extended model, what it gains on blocks not fitted and on fitted data, tests made."""

    candidate: Candidate
    model: Model
    gain: Gain
    drop: float
    tests: int


@dataclass(frozen=True)
class Round:
    """One step of the selection: all candidates refitted, and the one accepted (or None)."""

    trials: tuple[Trial, ...]
    accepted: Trial | None
    screened: tuple[Score, ...]


@dataclass(frozen=True)
class Search:
    """Outcome of the selection.

    Attributes:
        nominal: model without causes; model: the selected one.
        rounds: what was tried, in order.
        tests: number of alternatives looked at in one round, for the correction.
    """

    nominal: Model
    model: Model
    rounds: tuple[Round, ...]
    tests: int


def select(
    shooting: Shooting, theta: FloatArray, listed: Sequence[Candidate], report: Callable[[str, float], None]
) -> Search:
    """Selects the causes that the data support, most gain first."""
    nominal = fit_model(shooting, theta, ())
    model, rounds, tests = nominal, [], 1
    while len(model.causes) < MOST_CAUSES:
        report("search", len(rounds) / (len(rounds) + 2.0))
        scores = screen(shooting, model, list(listed))
        tests = len(scores)
        trials = [_try(shooting, model, s, tests) for s in _short_list(scores, tests)]
        accepted = _choose(trials, model, nominal)
        rounds.append(Round(tuple(trials), accepted, tuple(scores)))
        if accepted is None:
            break
        model = _prune(shooting, accepted.model, accepted.candidate, nominal, tests)
    return Search(nominal, model, tuple(rounds), tests)


def _short_list(scores: list[Score], tests: int) -> list[Score]:
    """Best causes of the screen, with all their look-alikes and all that cannot be linearised."""
    threshold = 0.5 * float(stats.chi2.isf(FALSE_ALARM / tests, 1))
    top = [s for s in scores if s.drop > threshold][:SHORT_LIST]
    families = {s.candidate.family for s in top}
    out = list(top)
    for s in scores:
        nonlinear = bool(s.candidate.starts)
        timed_noise = s.candidate.timed is not None and s.drop <= threshold
        if s not in out and (nonlinear or s.candidate.family in families) and not timed_noise:
            out.append(s)
    return _one_corner(out)


def _one_corner(scores: list[Score]) -> list[Score]:
    """Of the rotors, only the two best need a refit."""
    weak = [s for s in scores if s.candidate.effect == "weak_rotor"]
    drop = {id(s) for s in weak[2:]}
    return [s for s in scores if id(s) not in drop]


def _try(shooting: Shooting, model: Model, score: Score, tests: int) -> Trial:
    candidate = score.candidate
    start = model
    if candidate.timed is not None and score.time is not None:
        theta = model.theta.copy()
        theta[candidate.timed] = score.time
        start = replace(model, theta=theta)
    extended = extend(shooting, start, candidate)
    if candidate.timed is not None:
        extended = _refine_time(shooting, extended, candidate)
    gain = paired_gain(model.held_out, extended.held_out)
    return Trial(candidate, extended, gain, model.deviance - extended.deviance, tests * score.trials)


def _refine_time(shooting: Shooting, model: Model, candidate: Candidate) -> Model:
    """Moves the onset in ever smaller steps around the best, other parameters fixed, then refits."""
    assert candidate.timed is not None
    none = shooting.free([])
    best_theta = model.theta
    shooting.restore(model.states)
    for step in (0.2, 0.05):
        costs = []
        for offset in (-2.0, -1.0, 0.0, 1.0, 2.0):
            theta = best_theta.copy()
            theta[candidate.timed] += offset * step
            costs.append((float(shooting.linearise(theta, none).cost.sum()), offset, theta))
        best_theta = min(costs, key=lambda c: c[0])[2]
    return fit_model(shooting, best_theta, model.causes, model.states, iterations=4)


def _significant(gain: Gain, drop: float, added: int, earned: float, tests: int) -> bool:
    """Whether a gain on unseen blocks is real, worth having, and beyond what so many trials bring by luck."""
    return (
        gain.total > ERRORS * gain.error
        and gain.total > LEAST_GAIN
        and gain.total > RELATIVE_GAIN * earned
        and float(stats.chi2.sf(drop, added)) * tests < FALSE_ALARM
    )


def _choose(trials: list[Trial], model: Model, nominal: Model) -> Trial | None:
    """The best trial, or a simpler one within one standard error of it; None when none is significant."""
    earned = float(nominal.held_out.sum() - model.held_out.sum())
    good = [t for t in trials if _significant(t.gain, t.drop, len(t.candidate.names), earned, t.tests)]
    if not good:
        return None
    best = max(good, key=lambda t: t.gain.total)
    for t in sorted(good, key=lambda t: (len(t.candidate.names), -t.gain.total)):
        if len(t.candidate.names) >= len(best.candidate.names):
            break
        lost = paired_gain(t.model.held_out, best.model.held_out)
        if lost.total < lost.error:
            return t
    return best


def without(shooting: Shooting, model: Model, cause: Candidate) -> Model:
    """Refits `model` without `cause` and what requires it."""
    left = tuple(c for c in model.causes if c.label != cause.label and c.requires != cause.effect)
    gone = [c for c in model.causes if c not in left]
    theta = model.theta.copy()
    for c in gone:
        theta[shooting.free(list(c.names)).index] = 0.0
        if c.timed is not None:
            theta[c.timed] = NEVER
    return fit_model(shooting, theta, left, model.states)


def _prune(shooting: Shooting, model: Model, newest: Candidate, nominal: Model, tests: int) -> Model:
    """Drops causes that the newest one made superfluous."""
    for cause in [c for c in model.causes if c.label != newest.label]:
        if cause not in model.causes or any(c.requires == cause.effect for c in model.causes):
            continue
        rest = without(shooting, model, cause)
        gain = paired_gain(rest.held_out, model.held_out)
        earned = float(nominal.held_out.sum() - rest.held_out.sum())
        if not _significant(gain, rest.deviance - model.deviance, len(cause.names), earned, tests):
            model = rest
    return model
