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

LINEAR_MISFIT = 4.0
"""Deviance per row above which the longer segments are too far from linear to search on."""
SHORT_LIST = 5
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
    report: Callable[[str, float], None],
) -> Search:  # fmt: skip
    """Selects the causes that the data support, most gain first.

    Args:
        short: segments so short that even a large error stays nearly linear; used while the misfit is large.
        decisive: longer segments, on which slow causes show; decides as soon as the model follows them.
        theta: nominal optimum.
        listed: causes to try.
        report: progress.
    """
    nominal = fit_model(decisive, theta, ())
    rounds: list[Round] = []
    shooting, model, base = decisive, nominal, nominal
    if nominal.misfit > LINEAR_MISFIT:
        shooting, model = short, fit_model(short, theta, ())
        base = model
    tests = 1
    while len(model.causes) < MOST_CAUSES:
        report("search", len(rounds) / (len(rounds) + 2.0))
        scores = screen(shooting, model, list(listed))
        tests = len(scores)
        trials = [_try(shooting, model, s, tests) for s in _short_list(scores, tests)]
        accepted = _choose(trials, model, base)
        rounds.append(Round(tuple(trials), accepted, tuple(scores)))
        if accepted is not None:
            worth = {**accepted.model.worth, accepted.candidate.label: accepted.gain.total}
            accepted = replace(accepted, model=split_causes(replace(accepted.model, worth=worth)))
            model = _prune(shooting, accepted.model, accepted.candidate, base, tests)
        if shooting is short:
            longer = replace(fit_model(decisive, model.theta, model.causes, iterations=10), worth=model.worth)
            if longer.misfit < LINEAR_MISFIT or accepted is None:
                shooting, model, base = decisive, swap_look_alikes(decisive, longer, listed), nominal
                continue
        if accepted is None:
            break
    if shooting is short:
        model = fit_model(decisive, model.theta, model.causes, iterations=10)
    model = swap_look_alikes(decisive, model, listed)
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
    extended = extend(shooting, start, candidate, far=model.misfit > LINEAR_MISFIT)
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


def swap_look_alikes(shooting: Shooting, model: Model, listed: Sequence[Candidate]) -> Model:
    """Puts a look-alike in the place of a cause where that fits unseen blocks better.

    Which of two look-alikes was taken first may have been decided on segments too short to tell them apart, or before
    another cause was known.
    """
    for cause in model.causes:
        if any(c.requires == cause.effect for c in model.causes):
            continue
        present = {c.label for c in model.causes}
        rivals = [
            c for c in listed
            if c.family == cause.family and c.label not in present and not c.split and c.timed is None
            and c.effect != cause.effect
        ]  # fmt: skip
        if not rivals:
            continue
        rest = without(shooting, model, cause)
        best = min((extend(shooting, rest, r) for r in rivals), key=lambda m: float(m.held_out.sum()))
        gain = paired_gain(model.held_out, best.held_out)
        if gain.total > LEAST_GAIN and gain.total > gain.error:
            model = best
    return model


def split_causes(model: Model) -> Model:
    """Replaces a joint cause by the causes it stands for; the parameters are the same."""
    causes: list[Candidate] = []
    for c in model.causes:
        causes += [part for part in (c.split or (c,)) if part.label not in {x.label for x in causes}]
    return replace(model, causes=tuple(causes))


def without(shooting: Shooting, model: Model, cause: Candidate) -> Model:
    """Refits `model` without `cause` and what requires it."""
    left = tuple(c for c in model.causes if c.label != cause.label and c.requires != cause.effect)
    gone = [c for c in model.causes if c not in left]
    theta = model.theta.copy()
    for c in gone:
        theta[shooting.free(list(c.names)).index] = 0.0
        if c.timed is not None:
            theta[c.timed] = NEVER
    return replace(fit_model(shooting, theta, left, model.states), worth=model.worth)


def _prune(shooting: Shooting, model: Model, newest: Candidate, nominal: Model, tests: int) -> Model:
    """Drops causes that the newest one made superfluous."""
    for cause in [c for c in model.causes if c.label != newest.label]:
        if cause.label not in {c.label for c in model.causes} or any(c.requires == cause.effect for c in model.causes):
            continue
        rest = without(shooting, model, cause)
        gain = paired_gain(rest.held_out, model.held_out)
        evidence = min(rest.deviance - model.deviance, model.wald(cause))
        if not _significant(gain, evidence, cause, tests, _context(rest, nominal)):
            model = rest
    return model
