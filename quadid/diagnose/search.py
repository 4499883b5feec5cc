"""Forward selection of causes with look-alikes refitted against each other, and backward elimination."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadid.chi_square import exceeded, survival
from quadid.diagnose.blocks import Gain, paired_gain
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.climb import LINEAR_MISFIT, USUAL_SECONDS, Climb
from quadid.diagnose.exchange import LEAST_GAIN, NEAR, Round, Trial, split_causes, swap_look_alikes, without
from quadid.diagnose.handover import hand_over
from quadid.diagnose.models import Model, Sketch, extend, fit_model, sketch, thinned
from quadid.diagnose.screen import Score, screen
from quadid.identify.shooting import Shooting

FloatArray = NDArray[np.float64]

MOST_SKETCHES = 10
"""Most linear candidates whose gain is predicted while the misfit is large."""
FAR_SEGMENTS = 60
"""Segments on which candidates are compared while the misfit is large, and so any difference shows on a few."""
FEWEST_REFITS, MOST_REFITS = 3, 7
"""Fewest and most candidates refitted in one round."""
MOST_CAUSES = 12
MOST_SECOND_THOUGHTS = 2
"""Times a cause may give way to one it was once preferred to …"""
CLOSE = 0.8
"""… which then gained at least this share of what it did itself."""
FALSE_ALARM = 1e-3
"""Chance that a model without any effect is extended at all, shared by all causes tried."""
ERRORS = 2.0
"""A gain on unseen blocks must exceed this many of its standard errors, or be spread over most of them, or …"""
BEYOND_DOUBT = 100.0
"""… exceed one, the evidence on the fitted data being this chi-square or more: an effect that shows in a few manoeuvres
only gains in few blocks, whose spread says little about chance …"""
LEAST_SHARE = 0.004
"""… and `LEAST_GAIN`, and this share of the noise that no model can remove: less is of no use to anybody, and within
what the time step of a simulation or of an autopilot's own filter can imitate."""
RELATIVE_GAIN = 1e-4
"""… and this share of all gains so far, so that the tail of a huge effect is not named as another."""
FAMILY_SHARE = 0.01
"""… and, where a look-alike is already in the model, this share of what that one gained: the rest of a fading thrust
that is not quite linear is no second cause."""


@dataclass(frozen=True)
class Search:
    """Outcome of the selection.

    Attributes:
        shooting: the problem that decided.
        nominal: model without causes; model: the selected one.
        rounds: what was tried, in order.
        tests: number of alternatives looked at in one round, for the correction.
    """

    shooting: Shooting
    nominal: Model
    model: Model
    rounds: tuple[Round, ...]
    tests: int


def select(
    ladder: Sequence[Shooting], theta: FloatArray, listed: Sequence[Candidate], report: Callable[[str, float], None],
    elsewhere: Sequence[FloatArray] = (), known: Model | None = None,
) -> Search:  # fmt: skip
    """Selects the causes that the data support, most gain first.

    The search begins on the longest segments that the model follows for their whole length.  While it follows only
    short ones, where even a large error stays nearly linear, causes are sought there; as soon as it follows longer
    ones, on which slow causes show too, they decide.

    Args:
        ladder: the data cut into segments of falling length.
        theta: nominal optimum.
        listed: causes to try.
        report: progress.
        elsewhere: nominal parameters, shape (6,), to start from too while the misfit is large.
        known: selection made with a poorer noise model, to go on from.
    """
    climb = Climb(ladder, theta, known)
    rounds: list[Round] = []
    if known is not None:
        climb.model = _prune(climb.shooting, climb.model, None, climb.base, len(listed))
    tests = _forwards(climb, rounds, listed, elsewhere, report)
    for _ in range(MOST_SECOND_THOUGHTS):
        doubt = _second_thought(climb, rounds, tests, elsewhere)
        if doubt is None or doubt.accepted is None:
            break
        rounds.append(doubt)
        climb = Climb(ladder, theta, doubt.accepted.model)
        tests = _forwards(climb, rounds, listed, elsewhere, report)
    handed = hand_over(climb.shooting, climb.model, listed, tests)
    if handed is not None and handed.accepted is not None:
        climb.model = _prune(climb.shooting, handed.accepted.model, handed.accepted.candidate, climb.base, tests)
        rounds.append(handed)
    return Search(climb.shooting, climb.nominal, climb.model, tuple(rounds), tests)


def _forwards(
    climb: Climb, rounds: list[Round], listed: Sequence[Candidate], elsewhere: Sequence[FloatArray],
    report: Callable[[str, float], None],
) -> int:  # fmt: skip
    """Adds causes until none gains, look-alikes set beside each other; returns how many were looked at in one round."""
    compared: set[str] = set()
    usual: list[Round] = []
    tests = len(listed)
    while len(climb.model.causes) < MOST_CAUSES:
        report("search", len(rounds) / (len(rounds) + 2.0))
        shooting, model = climb.shooting, climb.model
        scores = screen(shooting, model, list(listed))
        tests = len(scores)
        trials = [_try(shooting, model, d, tests) for d in _drafts(shooting, model, scores, tests, elsewhere)]
        accepted = _choose(trials, model, climb.base)
        rounds.append(Round(tuple(trials), accepted, tuple(scores)))
        if accepted is None:
            break
        worth = {**accepted.model.worth, accepted.candidate.label: accepted.gain.total}
        model = split_causes(replace(accepted.model, worth=worth))
        climb.model = _prune(shooting, model, accepted.candidate, climb.base, tests)
        if climb.up():
            climb.model, swaps = swap_look_alikes(climb.shooting, climb.model, listed, usual)
            usual = swaps if climb.shooting.seconds >= USUAL_SECONDS else []
            rounds += swaps
            compared = {c.label for c in climb.model.causes}
    if compared != {c.label for c in climb.model.causes}:
        climb.model, swaps = swap_look_alikes(climb.shooting, climb.model, listed)
        rounds += swaps
    return tests


def _second_thought(climb: Climb, rounds: Sequence[Round], tests: int, elsewhere: Sequence[FloatArray]) -> Round | None:
    """Sets a cause beside those that were nearly as good when it was accepted, now that the others are known.

    Two effects at once may look most like a third; look-alikes of its own family each cause has met already.

    Returns:
        The first comparison that another cause wins; None where all stay.
    """
    shooting, model = climb.shooting, climb.model
    for cause in model.causes:
        if any(c.requires == cause.effect for c in model.causes):
            continue
        rivals = [r for r in _close_seconds(rounds, cause) if r.label not in {c.label for c in model.causes}]
        if not rivals:
            continue
        rest = without(shooting, model, cause)
        rivals = [r for r in rivals if r.requires is None or r.requires in rest.effects]
        drafts = _drafts(shooting, rest, screen(shooting, rest, rivals), tests, elsewhere)
        trials = [_try(shooting, rest, d, tests) for d in drafts]
        best = max(trials, key=lambda t: t.gain.total, default=None)
        if best is None:
            continue
        lead = paired_gain(model.held_out, best.model.held_out)
        if lead.total > LEAST_GAIN and lead.total > lead.error:
            worth = {**best.model.worth, best.candidate.label: best.gain.total}
            won = replace(best, model=split_causes(replace(best.model, worth=worth)))
            return Round((won, *(t for t in trials if t is not best)), won, ())
    return None


def _close_seconds(rounds: Sequence[Round], cause: Candidate) -> list[Candidate]:
    """Causes of other families that gained nearly as much when `cause` was accepted."""
    out = []
    for step in rounds:
        if step.accepted is not None and step.accepted.candidate.label == cause.label:
            near = [t for t in step.trials if t.gain.total > CLOSE * step.accepted.gain.total]
            out += [t.candidate for t in near if t.candidate.family != cause.family]
    return list(dict.fromkeys(out))


@dataclass(frozen=True)
class _Draft:
    """A candidate worth refitting: what it should gain, and where to start."""

    score: Score
    drop: float
    start: FloatArray | Sketch | None


def _drafts(
    shooting: Shooting, model: Model, scores: list[Score], tests: int, elsewhere: Sequence[FloatArray]
) -> list[_Draft]:
    """Candidates to refit: the best by prediction, and look-alikes that come near them."""
    far = model.misfit > LINEAR_MISFIT
    least = 0.5 * max(exceeded(FALSE_ALARM / tests, 1), LEAST_GAIN, LEAST_SHARE * model.rows)
    linear = [s for s in scores if not s.candidate.starts and s.drop > least][:MOST_SKETCHES]
    thin, base, every = thinned(shooting, model, FAR_SEGMENTS) if far else (shooting, model, 1)
    drafts = []
    for score in _one_corner([s for s in scores if s.candidate.starts or s in linear]):
        if score.candidate.timed is not None:
            drafts.append(_Draft(score, score.drop, None))
        elif score.candidate.starts or far:
            drawn = sketch(thin, base, score.candidate, elsewhere if far else ())
            drop = max(every * drawn.drop, score.drop) if far else drawn.drop
            drafts.append(_Draft(score, drop, drawn.theta if far else drawn))
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
    errors = 1.0 if evidence > BEYOND_DOUBT else ERRORS
    return (
        (gain.total > errors * gain.error or gain.spread)
        and gain.total > least
        and survival(evidence, len(cause.names)) * tests < FALSE_ALARM
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
