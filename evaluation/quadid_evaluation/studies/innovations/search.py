"""Search for causes: add, drop or swap while the model gets better."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from quadid.diagnosis.evidence import impossible_causes, worth_a_refit
from quadid.diagnosis.hypotheses import Candidate
from quadid_evaluation.studies.innovations.evidence import Everything, Score, better
from quadid_evaluation.studies.innovations.models import Flights, Model, left_without, times_of

NEAR = 0.4
"""Additions predicted to gain this share of what the best one did are refitted too …"""
ALIKE = 0.5
"""… and so are causes that should regain this share of what is lost when another one leaves."""
SPARE = 3.0
"""Times the least gain of use below which the loss of a cause must lie for a model without it to be fitted."""
MOST_REFITS = 3
"""Causes refitted on one model in a round: where the model misses much, predictions promise without end."""


@dataclass(frozen=True)
class Move:
    """A move made: the cause that came (None: none), the one that left (None: none), and the refitted model."""

    candidate: Candidate | None
    gone: Candidate | None
    model: Model


@dataclass(frozen=True)
class Round:
    """One step of the selection: the moves refitted, and the one made (or None)."""

    before: Model
    moves: tuple[Move, ...]
    accepted: Move | None


@dataclass(frozen=True)
class Search:
    """Outcome of the selection.

    Attributes:
        flights: what was diagnosed.
        nominal: model without causes; model: the selected one.
        rounds: what was tried, in order.
    """

    flights: Flights
    nominal: Model
    model: Model
    rounds: tuple[Round, ...]


def select(flights: Flights, nominal: Model) -> Search:
    """Selects the causes that the data support, from the model without any."""
    model, rounds = nominal, list[Round]()
    seen = {model.labels}
    while True:  # no model is visited twice
        rounds.append(_round(flights, model, seen))
        if (accepted := rounds[-1].accepted) is None:
            return Search(flights, nominal, model, tuple(rounds))
        model = accepted.model
        seen.add(model.labels)


def _round(flights: Flights, model: Model, seen: set[frozenset[str]]) -> Round:
    """Refits the most promising additions and what can be dropped; where none is better, causes in others' places."""
    everything = Everything(flights, model)
    least = worth_a_refit(len(flights.listed), model.rows)
    moves: list[Move] = []
    best = None
    for generated in (_adds, _drops, _swaps):
        if best is None:
            moves += generated(flights, everything, least, seen)
            best = _best(model, moves)
    return Round(model, tuple(moves), best)


def _best(model: Model, moves: Sequence[Move]) -> Move | None:
    """The best of the moves that are better than `model`; those with impossible numbers only where no other is."""
    good = [t for t in moves if better(t.model, model)]
    best = None
    for t in [t for t in good if not impossible_causes(t.model)] or good:
        if best is None or better(t.model, best.model):
            best = t
    return best


def _adds(flights: Flights, everything: Everything, least: float, seen: set[frozenset[str]]) -> Iterator[Move]:
    """The most promising causes alone, or beside others all that promise something beside those before them."""
    scores, model = everything.scores(), everything.model
    together = everything.together(scores, 2.0 * least) if model.causes else None
    if together and len(together.causes) > 1:
        move = next(_refits(flights, model, [together], least, 0.0, seen), None)
        if move and better(move.model, model):
            yield move
            return
    yield from _refits(flights, model, scores, least, NEAR, seen)


def _drops(flights: Flights, everything: Everything, least: float, seen: set[frozenset[str]]) -> Iterator[Move]:
    losses = sorted(everything.losses().values(), key=lambda s: -s.worth)
    yield from _refits(flights, everything.model, losses, -SPARE * least, 0.0, seen)


def _swaps(flights: Flights, everything: Everything, least: float, seen: set[frozenset[str]]) -> Iterator[Move]:
    """Look-alikes in the place of each cause."""
    for label, lost in everything.losses().items():
        cause = next(c for c in everything.model.causes if c.label == label)
        others = [c for c in everything.scores(cause) if not any(x.split for x in c.causes)]
        rivals = [s for s in others if s.causes[0].effect != cause.effect]
        yield from _refits(flights, everything.model, rivals, lost.worth * (1.0 - ALIKE), 0.0, seen)


def _refits(
    flights: Flights, model: Model, scores: Sequence[Score], least: float, near: float, seen: set[frozenset[str]]
) -> Iterator[Move]:
    """Refits with one cause more or less each, at most `MOST_REFITS`.

    A prediction is linear and the effects are not, so what a refit brought counts, not what another one promised.

    Args:
        flights: the data.
        model: what to change.
        scores: the moves, the most promising first.
        least: gain below which none is of use.
        near: share of the largest gain so far that a prediction must reach.
        seen: labels of models that were visited.
    """
    gained, count = 0.0, 0
    for score in scores:
        if count == MOST_REFITS or score.worth < (max(least, near * gained) if near else least):
            return
        new = tuple(x for c in score.causes for x in c.split or (c,))
        causes = (*left_without(model.causes, score.gone), *new)
        if frozenset(c.label for c in causes) in seen:
            continue
        times = times_of(model, causes)
        if score.time is not None:
            times |= {c.effect: score.time for c in new if c.timed is not None}
        tried = {**model.tried, **{c.label: float(score.trials) for c in new}}
        # Without a cause the deviance rises; with another or one more it has to fall.
        wanted = model.deviance if new else np.inf
        found, count = flights.fit(causes, score.start, model.psi, times, tried, wanted), count + 1
        if found is None:
            continue
        if score.time is not None:
            found = flights.in_time(found, score.causes[0])
        gained = max(gained, (model.deviance - found.deviance) / score.ratio)
        yield Move(score.candidate, score.gone, found)
