"""Forward selection of causes with look-alikes refitted against each other, and backward elimination."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from quadid.diagnose.blocks import Gain, paired_gain
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.models import Model, extend, fit_model, sketch
from quadid.diagnose.screen import Score, screen
from quadid.identify.shooting import Shooting
from quadid.model.layout import NEVER

FloatArray = NDArray[np.float64]

LINEAR_MISFIT = 4.0
"""Deviance per row above which the longer segments are too far from linear to search on."""
NEAR = 0.4
"""Candidates that should gain this share of what the best one should are refitted beside it …"""
MOST_SKETCHES = 10
FEWEST_REFITS, MOST_REFITS = 3, 7
"""… but no fewer and no more than these."""
MOST_CAUSES = 12
FALSE_ALARM = 1e-3
"""Chance that a model without any effect is extended at all, shared by all causes tried."""
ERRORS = 2.0
"""A gain on unseen blocks must exceed this many of its standard errors."""
LEAST_GAIN = 15.0
"""… and this much deviance …"""
LEAST_SHARE = 0.004
"""… and this share of the noise that no model can remove: less is of no use to anybody, and within what the time
step of a simulation or of an autopilot's own filter can imitate."""
RELATIVE_GAIN = 1e-4
"""… and this share of all gains so far, so that the tail of a huge effect is not named as another."""
FAMILY_SHARE = 0.01
"""… and, where a look-alike is already in the model, this share of what that one gained: the rest of a fading thrust
that is not quite linear is no second cause."""


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
    short: Shooting, decisive: Shooting, theta: FloatArray, listed: Sequence[Candidate],
    report: Callable[[str, float], None], known: Model | None = None,
) -> Search:  # fmt: skip
    """Selects the causes that the data support, most gain first.

    Args:
        short: segments so short that even a large error stays nearly linear; used while the misfit is large.
        decisive: longer segments, on which slow causes show; decides as soon as the model follows them.
        theta: nominal optimum.
        listed: causes to try.
        report: progress.
        known: selection made with a poorer noise model, to go on from.
    """
    nominal = fit_model(decisive, theta, ())
    rounds: list[Round] = []
    compared: set[str] = set()
    shooting, model, base = decisive, nominal, nominal
    if nominal.misfit > LINEAR_MISFIT:
        shooting, model = short, fit_model(short, theta, ())
        base = model
    tests = len(listed)
    if known is not None:
        shooting, base = decisive, nominal
        model = _prune(shooting, known, None, base, tests)
    while len(model.causes) < MOST_CAUSES:
        report("search", len(rounds) / (len(rounds) + 2.0))
        scores = screen(shooting, model, list(listed))
        tests = len(scores)
        trials = [_try(shooting, model, d, tests) for d in _drafts(shooting, model, scores, tests)]
        accepted = _choose(trials, model, base)
        rounds.append(Round(tuple(trials), accepted, tuple(scores)))
        if accepted is not None:
            worth = {**accepted.model.worth, accepted.candidate.label: accepted.gain.total}
            accepted = replace(accepted, model=split_causes(replace(accepted.model, worth=worth)))
            model = _prune(shooting, accepted.model, accepted.candidate, base, tests)
        if shooting is short:
            longer = replace(fit_model(decisive, model.theta, model.causes, iterations=10), worth=model.worth)
            if longer.misfit < LINEAR_MISFIT or accepted is None:
                shooting, base = decisive, nominal
                model, swaps = swap_look_alikes(decisive, longer, listed)
                rounds += swaps
                compared = {c.label for c in model.causes}
                continue
        if accepted is None:
            break
    if shooting is short:
        model = fit_model(decisive, model.theta, model.causes, iterations=10)
    if compared != {c.label for c in model.causes}:
        model, swaps = swap_look_alikes(decisive, model, listed)
        rounds += swaps
    return Search(nominal, model, tuple(rounds), tests)


@dataclass(frozen=True)
class _Draft:
    """A candidate worth refitting: what it should gain, and where to start."""

    score: Score
    drop: float
    start: FloatArray | None


def _drafts(shooting: Shooting, model: Model, scores: list[Score], tests: int) -> list[_Draft]:
    """Candidates to refit: the best by prediction, and look-alikes that come near them."""
    far = model.misfit > LINEAR_MISFIT
    least = 0.5 * max(float(stats.chi2.isf(FALSE_ALARM / tests, 1)), LEAST_GAIN, LEAST_SHARE * model.rows)
    linear = [s for s in scores if not s.candidate.starts and s.drop > least][:MOST_SKETCHES]
    drafts = []
    for score in _one_corner([s for s in scores if s.candidate.starts or s in linear]):
        if score.candidate.timed is not None:
            drafts.append(_Draft(score, score.drop, None))
        elif score.candidate.starts or far:
            drawn = sketch(shooting, model, score.candidate, far)
            drafts.append(_Draft(score, max(drawn.drop, score.drop if far else drawn.drop), drawn.theta))
        else:
            drafts.append(_Draft(score, score.drop, model.theta))
    drafts = sorted((d for d in drafts if d.drop > least), key=lambda d: -d.drop)
    near = [d for d in drafts if d.drop > NEAR * drafts[0].drop]
    return near[:MOST_REFITS] if len(near) > FEWEST_REFITS else drafts[:FEWEST_REFITS]


def _one_corner(scores: list[Score]) -> list[Score]:
    """Of the rotors, only the two best need a refit."""
    weak = [s for s in scores if s.candidate.effect == "weak_rotor"]
    drop = {id(s) for s in weak[2:]}
    return [s for s in scores if id(s) not in drop]


def _try(shooting: Shooting, model: Model, draft: _Draft, tests: int) -> Trial:
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
    shooting.restore(model.states)
    for step in (0.2, 0.05):
        costs = []
        for offset in (-2.0, -1.0, 0.0, 1.0, 2.0):
            theta = best_theta.copy()
            theta[candidate.timed] += offset * step
            costs.append((float(shooting.linearise(theta, none).cost.sum()), offset, theta))
        best_theta = min(costs, key=lambda c: c[0])[2]
    return replace(fit_model(shooting, best_theta, model.causes, model.states, iterations=4), worth=model.worth)


@dataclass(frozen=True)
class _Context:
    """What a gain is measured against: all gains so far, independent rows, and how much each family has gained."""

    earned: float
    rows: float
    families: dict[str, float]


def _significant(gain: Gain, evidence: float, cause: Candidate, tests: int, context: _Context) -> bool:
    """Whether a gain on unseen blocks is real, worth having, and beyond what so many trials bring by luck."""
    least = max(
        LEAST_GAIN,
        LEAST_SHARE * context.rows,
        RELATIVE_GAIN * context.earned,
        FAMILY_SHARE * context.families.get(cause.family, 0.0),
    )
    return (
        gain.total > ERRORS * gain.error
        and gain.total > least
        and float(stats.chi2.sf(evidence, len(cause.names))) * tests < FALSE_ALARM
    )


def _context(model: Model, nominal: Model) -> _Context:
    earned = float(nominal.held_out.sum() - model.held_out.sum())
    families: dict[str, float] = {}
    for cause in model.causes:
        families[cause.family] = families.get(cause.family, 0.0) + model.worth.get(cause.label, 0.0)
    return _Context(earned, model.rows, families)


def _choose(trials: list[Trial], model: Model, nominal: Model) -> Trial | None:
    """The best trial, or a simpler one within one standard error of it; None when none is significant."""
    context = _context(model, nominal)
    good = [t for t in trials if _significant(t.gain, t.evidence, t.candidate, t.tests, context)]
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


def swap_look_alikes(shooting: Shooting, model: Model, listed: Sequence[Candidate]) -> tuple[Model, list[Round]]:
    """Puts a look-alike in the place of a cause where that fits unseen blocks better.

    Which of two look-alikes was taken first may have been decided on segments too short to tell them apart, or before
    another cause was known.

    Returns:
        The better model, and for each cause what its rivals did in its place.
    """
    rounds = []
    for cause in model.causes:
        rivals = _rivals(model, cause, listed)
        if not rivals or any(c.requires == cause.effect for c in model.causes):
            continue
        rest = without(shooting, model, cause)
        sketches = sorted(((sketch(shooting, rest, r), r) for r in rivals), key=lambda pair: -pair[0].drop)
        worth = rest.deviance - model.deviance
        drawn = [(s, r) for s, r in sketches if s.drop > NEAR * worth][:2]
        trials = [_stand_in(rest, extend(shooting, rest, r, s.theta), r) for s, r in drawn]
        if not trials:
            continue
        holder = _stand_in(rest, model, cause)
        best = max(trials, key=lambda t: t.gain.total)
        gain = paired_gain(model.held_out, best.model.held_out)
        swapped = gain.total > LEAST_GAIN and gain.total > gain.error
        rounds.append(Round((holder, *trials), best if swapped else holder, ()))
        model = best.model if swapped else model
    return model, rounds


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


def _prune(shooting: Shooting, model: Model, newest: Candidate | None, nominal: Model, tests: int) -> Model:
    """Drops causes that the newest one, or a better noise model, made superfluous."""
    for cause in [c for c in model.causes if newest is None or c.label != newest.label]:
        if cause.label not in {c.label for c in model.causes} or any(c.requires == cause.effect for c in model.causes):
            continue
        rest = without(shooting, model, cause)
        gain = paired_gain(rest.held_out, model.held_out)
        evidence = min(rest.deviance - model.deviance, model.wald(cause))
        if not _significant(gain, evidence, cause, tests, _context(rest, nominal)):
            model = rest
    return model
