"""Search for causes by innovations, where random forces act: the quick search's answer made better move by move.

Segments that are simulated freely take what gusts do for structure; there the quick search (`quadid.diagnosis.search`)
names too much, though what acts is nearly always among it.  Innovations separate the two.  A linearisation of
everything predicts what each move brings (Rao, Proc. Camb. Phil. Soc. 44 (1948) 50), moves are refitted, every model at
its own random forces and noise, and compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadid.diagnosis.evidence import worth_a_refit
from quadid.diagnosis.hypotheses import Candidate, calibration, free_names, taken_out_causes
from quadid.diagnosis.random_forces import Flights, Model, quadratic, times_of, with_additions
from quadid.diagnosis.search import ALIKE, NEAR, Move, Round, best_move, removable
from quadid.estimate import kalman as k
from quadid.estimate.fit import best_step
from quadid.estimate.problem import Sensitivities
from quadid.types import FloatArray

SPARE = 3.0
"""Times the least gain of use below which the loss of a cause must lie for a model without it to be fitted."""
MOST_REFITS = 3
"""Causes refitted on one model in a round: where the model misses much, predictions promise without end."""
NUDGE, LATER = 1e-5, 0.1
"""Steps of scaled differences: of an effect's size, and of a delay where nothing is late."""


def select(flights: Flights, known: Model) -> tuple[Model, tuple[Round[Model], ...]]:
    """Selects the causes that the data support, from a `known` selection, and the steps to them."""
    model, rounds = known, list[Round[Model]]()
    seen = {model.labels}
    while True:  # no model is visited twice
        # Models are compared along the same states.
        flights, model = flights.along(model)
        rounds.append(_round(flights, model, seen))
        if (accepted := rounds[-1].accepted) is None:
            return model, tuple(rounds)
        model = accepted.model
        seen.add(model.labels)


def _round(flights: Flights, model: Model, seen: set[frozenset[str]]) -> Round[Model]:
    """Refits the most promising additions and what can be dropped; where none is better, causes in others' places."""
    everything = Everything(flights, model)
    least = worth_a_refit(len(flights.listed), model.rows)
    moves: list[Move[Model]] = []
    best = None
    for generated in (_adds, _drops, _swaps):
        if best is None:
            moves += generated(flights, everything, least, seen)
            best = best_move(model, moves)
    return Round(model, tuple(moves), best)


def _adds(flights: Flights, everything: Everything, least: float, seen: set[frozenset[str]]) -> Iterator[Move[Model]]:
    yield from _refits(flights, everything.model, everything.scores(), least, NEAR, seen)


def _drops(flights: Flights, everything: Everything, least: float, seen: set[frozenset[str]]) -> Iterator[Move[Model]]:
    losses = sorted(everything.losses(), key=lambda s: -s.worth)
    yield from _refits(flights, everything.model, losses, -SPARE * least, 0.0, seen)


def _swaps(flights: Flights, everything: Everything, least: float, seen: set[frozenset[str]]) -> Iterator[Move[Model]]:
    """Look-alikes in the place of causes, those first that lose least by it."""
    rivals: list[Score] = []
    for lost in everything.losses():
        for score in everything.scores(lost.gone):
            alike = score.candidate and lost.gone and score.candidate.effect != lost.gone.effect
            if alike and score.candidate and not score.candidate.split and score.worth > (1.0 - ALIKE) * lost.worth:
                rivals.append(score)
    yield from _refits(flights, everything.model, sorted(rivals, key=lambda s: -s.worth), -np.inf, 0.0, seen)


def _refits(
    flights: Flights, model: Model, scores: Sequence[Score], least: float, near: float, seen: set[frozenset[str]]
) -> Iterator[Move[Model]]:
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
        new = () if score.candidate is None else score.candidate.split or (score.candidate,)
        causes = (*taken_out_causes(model.causes, score.gone), *new)
        if frozenset(c.label for c in causes) in seen:
            continue
        tried = {**model.tried, **{c.label: float(score.trials) for c in new}}
        # With another cause or one more the deviance has to fall; without one it may rise by what is of no use.
        wanted = model.deviance - (0.0 if new else least * score.ratio)
        found, count = flights.fit(causes, score.start, model.psi, times_of(model, causes), tried, wanted), count + 1
        if found is None:
            continue
        gained = max(gained, (model.deviance - found.deviance) / score.ratio)
        yield Move(score.candidate, score.gone, found)


@dataclass(frozen=True)
class Score:
    """Linear prediction for one move.

    Attributes:
        candidate: the cause that comes in, if any.
        drop: predicted fall of the deviance, negative for a rise.
        start: scaled parameters that the model then has, by key.
        trials: how many alternatives were looked at.
        gone: the cause that leaves, if any.
        ratio: by how much the scores there vary more than that counts on, or 1.
    """

    candidate: Candidate | None
    drop: float
    start: Mapping[tuple[str, int], float]
    trials: int
    gone: Candidate | None
    ratio: float

    @property
    def worth(self) -> float:
        """Fall of the deviance in units that the scores themselves vary by."""
        return self.drop / self.ratio


class Everything:
    """The current model linearised with every candidate's entries free."""

    def __init__(self, flights: Flights, model: Model) -> None:
        """Linearises `model` with all causes free, but for refinements of what it has not."""
        self.flights, self.model = flights, model
        there = {c.label for c in model.causes}
        self._some = [c for c in flights.listed if not c.refines or c.requires in there]
        names = dict.fromkeys([*model.problem.names, *(n for c in self._some for n in c.names)])
        problem = flights.problem(tuple(names), times_of(model, model.causes))
        problem = replace(problem, models=flights.whole.models, paths=flights.whole.paths)
        self._keys = problem.keys
        known = dict(zip(model.keys, model.z, strict=True))
        self._z = z = np.array([known.get(key, 0.0) for key in self._keys])
        # What has no slope at neutral has one to where its search begins.
        begin = {n: v for c in self._some for n, v in zip(c.names, c.start, strict=False)}
        secant = np.array([begin.get(name, 0.0) for name, _ in self._keys]) / problem.size
        nudge = np.where((z == 0.0) & (secant != 0.0), secant, NUDGE)
        nudge[[place == k.DELAY and z[i] == 0.0 for i, (_, place, _) in enumerate(problem.entries)]] = LATER
        gains = [with_additions(g) for g in model.gains]
        found = [self._whole(problem.sensitivities(j, z, model.psi, g, nudge)) for j, g in enumerate(gains)]
        # What runs away where the model is promises nothing.
        with np.errstate(over="ignore", invalid="ignore"):
            tame = np.all([np.isfinite(np.sum(one.J**2, axis=(1, 2))) for one in found], axis=0)
        wild = {name for (name, _), stays in zip(self._keys, tame, strict=True) if not stays}
        self._some = [c for c in self._some if wild.isdisjoint(c.names)]
        for one in found:
            one.J[[name in wild for name, _ in self._keys]] = 0.0
        self._near = near = quadratic(problem, gains, found, len(z))
        mean, sigma = problem.prior
        self._h = near.information + np.diag(sigma**-2.0)
        self._g = near.gradient + (z - mean) / sigma**2
        least, most = problem.limits - z
        positive = [name in problem.layout.entries and problem.layout.entry(name).sign > 0 for name, _ in self._keys]
        self._box = np.where(positive, np.maximum(least, -np.maximum(z, 0.0)), least), most
        self._own = [self._keys.index(key) for key in model.keys]

    def _whole(self, found: Sensitivities) -> Sensitivities:
        """Sensitivities by all entries, those of other flights zero."""
        J = np.zeros((len(self._keys), *found.plain.shape))
        J[found.entries] = found.J
        return found._replace(entries=list(range(len(self._keys))), J=J)

    @cached_property
    def unspent(self) -> float:
        """Fall of the deviance that the fit of the model itself left undone."""
        return self._best(self._own, self._g)[1]

    def losses(self) -> list[Score]:
        """Predicted fall of the deviance without each cause that no other stands on, the others following: a loss."""
        out = []
        for gone in removable(self.model.causes):
            stay, slope, risen = self._left(gone)
            step, fall = self._best(stay, slope)
            away = np.array([name in gone.names for name, _ in self.model.keys])
            ratio, drop = calibration(self.model.inflation[away]), fall - risen - self.unspent
            out.append(Score(None, drop, self._start(stay, step), 0, gone, ratio))
        return out

    def scores(self, gone: Candidate | None = None) -> list[Score]:
        """Effect of each candidate that is not in the model, in the place of `gone` if given; best first."""
        stay, slope, risen = self._left(gone)
        left = taken_out_causes(self.model.causes, gone)
        there, present = {x for c in left for x in (c.effect, c.label)}, {self._keys[i][0] for i in stay}
        out = []
        trials = len(self.flights.listed)
        for c in self._some:
            known = present.intersection(c.names) or c.label in there or c == gone
            if known or c.timed is not None or (c.requires and c.requires not in there):
                continue
            free = stay + [i for i, (name, _) in enumerate(self._keys) if name in c.names]
            step, fall = self._best(free, slope)
            ratio, drop = self._ratio(free, len(stay), step, gone), fall - risen - self.unspent
            out.append(Score(c, drop, self._start(free, step), trials, gone, ratio))
        return sorted(out, key=lambda s: -s.worth)

    def _ratio(self, free: list[int], own: int, step: FloatArray, gone: Candidate | None) -> float:
        """By how much scores of the entries `free` from the `own`-th on vary more than information says, or 1.

        They are taken a step away, or a cause that is missing would itself make them vary.
        """
        if len(free) == own:
            return 1.0
        whole = self._away(gone)
        whole[free] = step
        inverse = np.asarray(np.linalg.inv(self._h[np.ix_(free, free)]))
        return max(float(np.mean(self._near.spread(free, whole, inverse)[own:])), 1.0)

    def _best(self, free: list[int], slope: FloatArray) -> tuple[FloatArray, float]:
        """Step of these entries to the minimum within bounds, and the fall of the deviance."""
        return best_step(self._h, slope, self._box, free)

    def _start(self, free: list[int], step: FloatArray) -> dict[tuple[str, int], float]:
        return {self._keys[i]: float(self._z[i] + s) for i, s in zip(free, step, strict=True)}

    def _left(self, gone: Candidate | None) -> tuple[list[int], FloatArray, float]:
        """Entries of the model without `gone`, the slope where that is neutral, and the rise of the deviance."""
        names = free_names(taken_out_causes(self.model.causes, gone))
        stay = [i for i in self._own if self._keys[i][0] in names]
        z = self._away(gone)
        moved = self._h @ z
        return stay, self._g + moved, float(2.0 * self._g @ z + z @ moved)

    def _away(self, gone: Candidate | None) -> FloatArray:
        """Step that makes what leaves with `gone` neutral, shape (P,)."""
        z, names = np.zeros(len(self._keys)), free_names(taken_out_causes(self.model.causes, gone))
        away = [i for i in self._own if self._keys[i][0] not in names]
        z[away] = -self._z[away]
        return z
