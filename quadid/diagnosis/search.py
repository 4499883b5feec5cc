"""Search for causes: add, drop or swap while the model gets better, on segments that grow as it does."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np

from quadid.diagnosis import random_forces
from quadid.diagnosis.evidence import Everything, M, Score, better, impossible_causes, missed, worth_a_refit
from quadid.diagnosis.hypotheses import Candidate, Model, Start, extend, fit_model, refit, sketch, taken_out, without
from quadid.identification.fit import flexible_names
from quadid.identification.problem import Shooting
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray

# --- Which lengths of segments decide: continuation from short ones to long ones as the model gets better


LINEAR_MISFIT = 4.0
"""Deviance per row above which segments are too long for the model: it does not follow the flight to their end."""
USUAL_SECONDS = 1.0
"""Longer segments decide only where airspeed matters and is not measured: every segment has a velocity of its own to
find, short ones hardly find it, and then drag comes out too large and one kind of it passes for another …"""
CLEAN_MISFIT = 1.2
"""… and where the model leaves hardly more than noise in them: a cause not found yet grows with their length."""


def is_long(shooting: Shooting) -> bool:
    """Checks whether segments are longer than usual: there the cost of a missing moment grows beyond all measure."""
    return shooting.seconds > 1.5 * USUAL_SECONDS


@dataclass(frozen=True)
class Stage:
    """State of the continuation.

    Attributes:
        schedule: the data cut into segments of falling length.
        rung: the one in use.
        model: fitted on it.
    """

    schedule: Sequence[Shooting]
    rung: int
    model: Model

    @classmethod
    def begin(cls, schedule: Sequence[Shooting], theta: FloatArray, known: Model | None = None) -> Stage:
        """The longest segments that the nominal model at `theta`, or the `known` one, follows; else the shortest."""
        shortest = len(schedule) - 1
        if known is None:
            return cls(schedule, shortest, fit_model(schedule[shortest], theta, ())).continued()
        return cls(schedule, shortest, known).at(shortest).continued()

    @property
    def shooting(self) -> Shooting:
        """The problem in use."""
        return self.schedule[self.rung]

    @property
    def follows(self) -> bool:
        """Checks whether segments are not too long for the model to decide on them."""
        return self.model.lin.reduced_chi_square < (CLEAN_MISFIT if is_long(self.shooting) else LINEAR_MISFIT)

    def at(self, rung: int) -> Stage:
        """On another rung, the model refitted there."""
        return replace(self, rung=rung, model=refit(self.schedule[rung], self.model, None, iterations=10))

    def continued(self) -> Stage:
        """On the longest segments that may decide about the model and that it follows, never shorter without need."""
        usual = next(rung for rung, shooting in enumerate(self.schedule) if not is_long(shooting))
        longest = 0 if self.model.finds_velocity else usual
        for rung in range(longest, self.rung):
            if (longer := self.at(rung)).follows:
                return longer
        return self if self.rung >= longest else self.at(longest)

    def longest(self) -> Stage | None:
        """The longest segments of all, where the model leaves hardly more than noise in them."""
        if self.rung == 0 or not is_long(self.schedule[0]):
            return None
        far = self.at(0)
        return far if far.follows else None


# --- Selection of causes: add, drop or swap while the model gets better, on segments that grow as it does


NEAR = 0.4
"""Additions predicted to gain this share of what the best one did are refitted too …"""
ALIKE = 0.8
"""… and so are causes that should regain this share of what is lost when another one leaves."""
MOST_REFITS = 7
"""Causes refitted on one model in a round: where the model misses much, predictions promise without end."""


@dataclass(frozen=True)
class Move(Generic[M]):
    """A move made: the cause that came (None: none), the one that left (None: none), and the refitted model."""

    candidate: Candidate | None
    gone: Candidate | None
    model: M


@dataclass(frozen=True)
class Round(Generic[M]):
    """One step of a selection: the moves refitted, and the one made (or None)."""

    before: M
    moves: tuple[Move[M], ...]
    accepted: Move[M] | None


@dataclass(frozen=True)
class Search:
    """Outcome of the selection.

    Attributes:
        shooting: the problem that decided.
        nominal: model without causes; model: the selected one.
        rounds: what was tried, in order, last by innovations where random forces act.
        listed: causes looked at in every round.
    """

    shooting: Shooting
    nominal: Model
    model: Model
    rounds: tuple[Round[Model] | Round[random_forces.Model], ...]
    listed: tuple[Candidate, ...]


def select(
    schedule: Sequence[Shooting],
    theta: FloatArray,
    listed: Sequence[Candidate],
    report: Callable[[str, float], None],
    known: Model | None = None,
) -> Search:
    """Selects the causes that the data support.

    Args:
        schedule: the data cut into segments of falling length.
        theta: nominal optimum.
        listed: causes to try.
        report: progress.
        known: selection to go on from.
    """
    stage = Stage.begin(schedule, theta, known)
    rounds: list[Round[Model]] = []
    seen = {_key(stage.shooting, stage.model)}
    while True:  # no model is visited twice
        report("search", len(rounds) / (len(rounds) + 2.0))
        where = stage
        rounds.append(_round(where, listed, seen))
        # Each short segment finds a velocity of its own, which makes up for most of what a small drag does.
        far = None if rounds[-1].accepted or stage.model.causes else stage.longest()
        if far and (airborne := [c for c in listed if far.shooting.finds_velocity(c.names)]):
            where = far
            rounds.append(_round(where, airborne, seen))
        if (accepted := rounds[-1].accepted) is None:
            break
        seen.add(_key(where.shooting, accepted.model))
        stage = replace(where, model=accepted.model).continued()
        seen.add(_key(stage.shooting, stage.model))
    nominal = fit_model(stage.shooting, theta, ()) if stage.model.causes else stage.model
    return Search(stage.shooting, nominal, stage.model, tuple(rounds), tuple(listed))


def _key(shooting: Shooting, model: Model) -> tuple[int, frozenset[str]]:
    """Length of segments and causes: what the search has visited once it never comes back to."""
    return shooting.length, frozenset(c.label for c in model.causes)


def from_everything(shooting: Shooting, theta: FloatArray, listed: Sequence[Candidate]) -> Model:
    """A start of its own: everything at once at `theta`, the flexible fit, less what is not missed.

    When several causes act at once and strongly, none of them alone leads out of the basin that the nominal fit fell
    into; the flexible model is outside of it.
    """
    allowed = set(flexible_names(shooting.layout, shooting))
    kept = tuple(c for c in listed if c.timed is None and not c.split and set(c.names) <= allowed)
    model = fit_model(shooting, _only(shooting, theta, kept), kept, iterations=8)
    while (kept := missed(model, worth_a_refit(len(listed), model.rows))) != model.causes:
        model = fit_model(shooting, _only(shooting, model.theta, kept), kept, model.states, iterations=8)
    return replace(model, tried={c.label: float(len(listed)) for c in kept})


def _only(shooting: Shooting, theta: FloatArray, causes: Sequence[Candidate]) -> FloatArray:
    """The vector with all effects at neutral but those of `causes`."""
    out = shooting.layout.initial(shooting.vehicle)
    kept = shooting.free([*NOMINAL_NAMES, *(n for c in causes for n in c.names)]).index
    out[kept] = theta[kept]
    return out


def pruned(shooting: Shooting, model: Model) -> Model:
    """`model` without the causes that make it no better."""
    while best := best_move(model, [Move(None, c, without(shooting, model, c)) for c in removable(model.causes)]):
        model = best.model
    return model


def _round(stage: Stage, listed: Sequence[Candidate], seen: Collection[tuple[int, frozenset[str]]]) -> Round[Model]:
    """Refits the most promising additions and what can be dropped; where none is better, causes in others' places."""
    shooting, model = stage.shooting, stage.model
    everything = Everything.of(shooting, model, listed)
    least = worth_a_refit(len(listed), model.rows)
    moves: list[Move[Model]] = []
    best = None
    for generated in (_adds_and_drops, _swaps):
        if best is None:
            new = generated(shooting, everything, least)
            moves += [t for t in new if _key(shooting, t.model) not in seen]
            best = best_move(model, moves)
    return Round(model, tuple(moves), best)


def best_move(model: M, moves: Sequence[Move[M]]) -> Move[M] | None:
    """The best of the moves that are better than `model`; those with impossible numbers only where no other is."""
    good = [t for t in moves if better(t.model, model)]
    best = None
    for t in [t for t in good if not impossible_causes(t.model)] or good:
        if best is None or better(t.model, best.model):
            best = t
    return best


def _adds_and_drops(shooting: Shooting, everything: Everything, least: float) -> Iterator[Move[Model]]:
    model = everything.model
    scores = [s for s in everything.scores() if s.candidate.start or s.drop > least]
    yield from _refits(shooting, model, scores, least, NEAR)
    for cause in removable(model.causes):
        if everything.loss(cause) < 4.0 * least:
            yield Move(None, cause, without(shooting, model, cause))


def _swaps(shooting: Shooting, everything: Everything, least: float) -> Iterator[Move[Model]]:
    """Look-alikes in the place of each cause."""
    model = everything.model
    for cause in removable(model.causes):
        lost = everything.loss(cause)
        wanted = max(ALIKE * lost, least)
        rivals = [s for s in everything.scores(cause) if _rivals(s, cause, lost + s.drop > wanted)]
        yield from _refits(shooting, taken_out(shooting, model, cause), rivals, least, ALIKE, lost)


def _rivals(score: Score, cause: Candidate, regains: bool) -> bool:
    """True if a candidate may stand in the place of `cause`: a look-alike by name, or by what it should regain."""
    candidate = score.candidate
    if candidate.split or candidate.effect == cause.effect:
        return False
    return regains or (candidate.family == cause.family and candidate.timed is None)


def _refits(
    shooting: Shooting, model: Model, scores: Sequence[Score], least: float, near: float, lost: float = 0.0
) -> Iterator[Move[Model]]:
    """Refits with one cause each, at most `MOST_REFITS`, until none is predicted to come `near` what one did gain.

    A prediction is linear and the effects are not, so what a refit brought counts, not what another one promised.

    Args:
        shooting: the problem.
        model: what to extend.
        scores: the causes.
        least: gain below which none is of use.
        near: share of the largest gain so far that a prediction must reach.
        lost: deviance that `model` lost when another cause left it, to be gained again.
    """
    gained = 0.0
    drafts = sorted(((s, _start(shooting, model, s)) for s in scores), key=lambda draft: -draft[1].drop)
    for score, start in drafts[:MOST_REFITS]:
        if lost + start.drop < max(least, near * gained):
            break
        extended = extend(shooting, model, score.candidate, start, tried=score.trials)
        if score.time is not None:
            extended = _refine_time(shooting, extended, score.candidate)
        gained = max(gained, lost + model.deviance - extended.deviance)
        yield Move(score.candidate, score.gone, extended)


def removable(causes: Collection[Candidate]) -> list[Candidate]:
    """Causes that no other stands on; their own refinements leave with them."""
    return [c for c in causes if not any(c.carries(x) and not x.refines for x in causes)]


def _start(shooting: Shooting, model: Model, score: Score) -> Start:
    """Start of a refit and what to expect; a sketch leads to causes that no slope at neutral shows."""
    if score.candidate.start:
        return sketch(shooting, model, score.candidate)
    theta = model.theta.copy()
    if score.time is not None:
        theta[score.candidate.timed] = score.time
    return Start(theta, model.states, score.drop)


def _refine_time(shooting: Shooting, model: Model, candidate: Candidate) -> Model:
    """Moves the onset in ever smaller steps around the best, other parameters fixed, then refits."""
    none = shooting.free([])

    def cost(theta: FloatArray) -> float:
        return shooting.linearise(theta, none, model.states).total_cost

    theta = model.theta
    step = 0.25 * shooting.seconds  # the scan resolves one segment
    while step > 0.01:
        moved = np.repeat(theta[None], 5, axis=0)
        moved[:, candidate.timed] += step * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
        theta = min(moved, key=cost)
        step *= 0.25
    return refit(shooting, replace(model, theta=theta), model.states, iterations=4)
