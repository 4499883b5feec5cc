"""Score tests: what each move of the selection should bring, from one linearisation of everything.

One Jacobian of the whole catalogue, with initial states eliminated segment by segment, gives the predicted deviance of
every model that adds a cause, drops one or puts one in another's place, by linear algebra (Rao, Proc. Camb. Phil. Soc.
44 (1948) 50).  Causes that begin at an unknown time are scanned over all segment boundaries by sums from the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quadid.diagnosis.candidates import Candidate, unset_times
from quadid.diagnosis.model import Model, free_names, taken_out_causes
from quadid.identification.priors import prior_terms
from quadid.identification.schur_complement import eliminated, freed
from quadid.identification.segment_cost import Linearised
from quadid.identification.shooting import Shooting
from quadid.types import FloatArray, IndexArray


@dataclass(frozen=True)
class Score:
    """Linear prediction for one move.

    Attributes:
        candidate: the cause that comes in.
        drop: predicted fall of the deviance on the fitted data, negative for a rise.
        time: best moment of onset [s] for timed causes.
        trials: how many alternatives were looked at: causes, and onsets of them.
        gone: the cause that leaves; None: none does.
    """

    candidate: Candidate
    drop: float
    time: float | None = None
    trials: int = 1
    gone: Candidate | None = None


class _Own(NamedTuple):
    """The model's own parameters: their information and gradient, prior included, (o, o) and (o,), and columns.

    The gradient counts although it is small at an optimum: only with it is the quadratic a sum of squares, which no
    step can bring below zero, and a fit that stopped short of its optimum promises no more than there is to gain.
    """

    h: FloatArray
    g: FloatArray
    place: IndexArray

    @property
    def fall(self) -> float:
        """Fall of the deviance when they alone follow."""
        return float(self.g @ np.linalg.solve(self.h, self.g))


@dataclass(frozen=True)
class Everything:
    """The current model linearised with every candidate's entries free.

    Attributes:
        model: the current model; listed: the candidates; lin: the linearisation; place: column of each entry.
    """

    model: Model
    listed: Sequence[Candidate]
    lin: Linearised
    place: dict[str, int]

    @classmethod
    def of(cls, shooting: Shooting, model: Model, listed: Sequence[Candidate]) -> Everything:
        """Linearises `model` with all of `listed` free, but for refinements of what it has not."""
        there = {c.label for c in model.causes}
        some = [c for c in listed if not c.refines or c.requires in there]
        names = list(dict.fromkeys([*model.free.names, *(n for c in some for n in c.names)]))
        theta = unset_times(model.theta, model.effects)
        lin = shooting.linearise(theta, shooting.free(names), model.states)
        return cls(model, listed, lin, {n: i for i, n in enumerate(names)})

    def loss(self, gone: Candidate) -> float:
        """Predicted rise of the deviance when `gone`, and what requires it, is dropped."""
        _, own, risen = self._left(gone)
        return risen - own.fall + self._unspent()

    def scores(self, gone: Candidate | None = None) -> list[Score]:
        """What each candidate that is not in the model would do, in the place of `gone` if given; best first."""
        lin, own, risen = self._left(gone)
        risen += self._unspent()
        present = set(self.model.free.names)
        there = {name for c in self.model.causes if c is not gone for name in (c.effect, c.label)}
        out = []
        for candidate in self.listed:
            if present.intersection(candidate.names) or (candidate.requires and candidate.requires not in there):
                continue
            mine = np.array([self.place[n] for n in candidate.names])
            found = (_score if candidate.timed is None else _scan)(candidate, lin, own, mine)
            out.append(replace(found, drop=found.drop - risen, trials=found.trials * len(self.listed), gone=gone))
        return sorted(out, key=lambda s: -s.drop)

    def _unspent(self) -> float:
        """Fall of the deviance that the fit of the model itself left undone."""
        return self._left(None)[1].fall

    def _left(self, gone: Candidate | None) -> tuple[Linearised, _Own, float]:
        """The quadratic, the model's parameters and the rise of the deviance where `gone` is neutral."""
        model = self.model
        stays = np.isin(model.free.names, free_names(taken_out_causes(model.causes, gone)))
        place = np.array([self.place[n] for n in model.free.names])
        z = np.zeros(len(self.place))
        z[place[~stays]] = -model.free.from_neutral(model.theta)[~stays]
        moved = self.lin.gram @ z
        lin = replace(self.lin, grad=self.lin.grad + moved)
        precision, pull, _ = prior_terms(model.free, model.prior, model.theta)
        place = place[stays]
        h = lin.information[np.ix_(place, place)] + np.diag(precision[stays])
        own = _Own(h, lin.gradient[place] + pull[stays], place)
        return lin, own, float(np.sum(2.0 * self.lin.grad @ z + moved @ z))


def missed(model: Model, least: float) -> tuple[Candidate, ...]:
    """Causes of `model` whose loss, one after the other, the rest could not make up for: at least `least` of deviance.

    Half of them at most are let go: the linear picture does not hold for all at once.
    """
    h = model.lin.information + np.diag(model.prior.precision)
    z, place = model.free.from_neutral(model.theta), {n: i for i, n in enumerate(model.free.names)}
    kept, alive = list(model.causes), np.ones(len(place), dtype=bool)
    for _ in range(max(len(kept) // 2, 1)):
        losses = []
        for cause in kept:
            if any(cause.carries(c) for c in kept):
                continue
            mine = np.array([place[n] for n in cause.names])
            rest = np.flatnonzero(alive & ~np.isin(np.arange(len(z)), mine))
            left = eliminated(h[np.ix_(mine, mine)], h[np.ix_(mine, rest)], h[np.ix_(rest, rest)])
            losses.append((float(z[mine] @ left.h @ z[mine]), cause, mine))
        if not losses:
            break
        loss, cause, mine = min(losses, key=lambda item: item[0])
        if loss > least:
            break
        kept.remove(cause)
        alive[mine] = False
    return tuple(kept)


def _fall(h_mm: FloatArray, h_mo: FloatArray, g_m: FloatArray, own: _Own) -> FloatArray:
    """Predicted fall of the deviance with candidates' parameters free, the model's own refitted, shape (n,).

    Args:
        h_mm: products of the parameters with themselves, (n, m, m).
        h_mo: and with those of the model, (n, m, o).
        g_m: gradient of the parameters (n, m).
        own: the model's parameters.
    """
    # Directions the model's own parameters already explain carry no information; keep them finite.
    kept = np.eye(h_mm.shape[-1]) * (1e-9 * h_mm + 1e-2)
    return own.fall + freed(h_mm + kept, h_mo, own.h, g_m, own.g)


def _score(candidate: Candidate, lin: Linearised, own: _Own, mine: IndexArray) -> Score:
    h, g = lin.information, lin.gradient
    drop = _fall(h[np.ix_(mine, mine)][None], h[np.ix_(mine, own.place)][None], g[mine][None], own)
    return Score(candidate, float(drop[0]))


def _scan(candidate: Candidate, lin: Linearised, own: _Own, mine: IndexArray) -> Score:
    """Scans the onset over segment boundaries: sums from the end turn the whole-log column into masked ones."""
    order = np.argsort(lin.time, kind="stable")
    from_end = slice(None, None, -1)
    h_mm = np.cumsum(lin.gram[order[:, None, None], mine[:, None], mine][from_end], axis=0)[from_end]
    h_mo = np.cumsum(lin.gram[order[:, None, None], mine[:, None], own.place][from_end], axis=0)[from_end]
    g_m = np.cumsum(lin.grad[order][:, mine][from_end], axis=0)[from_end]
    margin = max(len(order) // 40, 3)
    tried = slice(margin, len(order) - margin)
    drop = _fall(h_mm[tried], h_mo[tried], g_m[tried], own)
    if not len(drop):
        return Score(candidate, -np.inf)
    best = int(np.argmax(drop))
    return Score(candidate, float(drop[best]), float(lin.time[order[margin + best]]), len(order))
