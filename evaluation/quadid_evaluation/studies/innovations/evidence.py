"""Evidence by innovations: which model is better, and what a move of the search promises."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadid.diagnosis.evidence import FALSE_ALARM, RELEVANT
from quadid.diagnosis.hypotheses import Candidate, HeldOut, free_names, paired_gain
from quadid.effects import EFFECTS
from quadid.estimate import kalman as k
from quadid.estimate.fit import newton_step
from quadid.estimate.kalman import Beyond, Gains
from quadid.estimate.problem import Problem, Sensitivities, reckoned
from quadid.types import BoolArray, FloatArray
from quadid_evaluation.studies.innovations.models import (
    Flights,
    Model,
    innovations,
    left_without,
    long_run,
    quadratic,
    stretches,
    times_of,
    with_additions,
)

# --- The one score: is model B better than model A?
#
# Twice the logarithm of the marginal likelihood by Laplace's approximation, with the priors that exist: on parameters
# those of the fit, on models that a cause is absent until proven (`FALSE_ALARM` shared by all that were tried).  Where
# the model leaves more than noise, or noise with a memory, squared errors are worth less than their size: deviances
# are divided by the ratio of the scores' true variance to that which the model counts on (Godambe, Ann. Math. Stat. 31
# (1960) 1208; as magnitude adjustment of a composite likelihood in Ribatet, Cooley and Davison, Statistica Sinica 22
# (2012) 813).  A cause must besides be of use: on blocks of data that its fit did not see it has to gain a share of
# the noise.


def better(b: Model, a: Model) -> bool:
    """Checks whether `b` is better than `a`: more likely, and of models of which one contains the other also of use."""
    if b.labels < a.labels:
        return not better(a, b)
    if a.labels < b.labels and not relevant(a, b):
        return False
    return advantage(b, a) > 0.0


def advantage(b: Model, a: Model) -> float:
    """Twice the log evidence of `b` less that of `a`, times the calibration, between models of the same data and noise.

    Each model pays for what only it has by the calibration of its own scores: where a parameter's scores vary much more
    than the deviance counts on, that is no reason to count less what the other model explains.
    """
    return a.deviance - b.deviance + _cost(a, b) - _cost(b, a)


def _cost(model: Model, other: Model) -> float:
    """Deviance that the causes and parameters which only `model` has must take away for it to be as likely."""
    own = np.array([key not in other.keys for key in model.keys])
    prior = sum(2.0 * np.log(model.tried[label] / FALSE_ALARM) for label in model.labels - other.labels)
    if not own.any():
        return float(prior)
    ratio = calibration(model, own)
    gram = model.near.information / np.sqrt(np.outer(model.precision, model.precision))
    wide = np.eye(len(gram)) + gram / ratio
    occam = np.linalg.slogdet(wide)[1] - np.linalg.slogdet(wide[np.ix_(~own, ~own)])[1]
    return ratio * float(occam + prior)


def calibration(model: Model, own: BoolArray) -> float:
    """By how much scores of the parameters `own` of `model` vary more than its deviance counts on, or 1."""
    return max(float(np.mean(model.inflation[own])), 1.0) if own.any() else 1.0


def relevant(small: Model, large: Model) -> bool:
    """True if what `large` has more gains enough on unseen blocks, and half of that where the best of them is missing.

    It is missing in the fit as well: what a single stretch determines, such as a step near the end, gains elsewhere by
    keeping that stretch apart.  What belongs to the vehicle must do so on unseen flights too, where there are several.
    """
    own = np.array([key not in small.keys for key in large.keys])
    needed = RELEVANT * small.rows * calibration(large, own)
    parts = [(small.left_out, large.left_out)]
    more = [c for c in large.causes if c.label not in small.labels]
    if len(small.by_flight.block) > 1 and not any(c.timed is not None or EFFECTS[c.effect].per_log for c in more):
        parts.append((small.by_flight, large.by_flight))
    return all(_gained(*pair) > needed for pair in parts)


def _gained(small: HeldOut, large: HeldOut) -> float:
    """Gain on unseen parts, or twice that without the best of them where that is less."""
    gain = paired_gain(small.block, large.block)
    best = int(np.argmax(gain.blocks))
    return min(gain.total, 2.0 * float(small.rest[best] - large.rest[best]))


# --- Score tests: what each move of the selection should bring, from one linearisation of everything
#
# The likelihood of innovations near a model, with every entry of the catalogue free and the gains of its filter pass,
# gives the predicted deviance of every model that adds a cause, drops one or puts one in another's place, by linear
# algebra (Rao, Proc. Camb. Phil. Soc. 44 (1948) 50).  Causes that begin at an unknown time are tried at onsets all over
# the flight, ever closer ones around the best.


ONSETS = 24
"""Onsets that are tried at first, spread over a flight."""
END = 0.025
"""Share of a flight at either end in which nothing begins …"""
LEAST_ROWS = 50
"""… and how many rows there are at least."""
TRUSTED = 2.0
"""Ratio of a score's variance to its information up to which a model is near enough for several causes at once."""
NUDGE, LATER = 1e-3, 0.1
"""Steps of scaled differences: of an effect's size, and of a delay where nothing is late."""


@dataclass(frozen=True)
class Score:
    """Linear prediction for one move.

    Attributes:
        causes: those that come in.
        drop: predicted fall of the deviance, negative for a rise.
        ratio: by how much the scores there vary more than that counts on, or 1.
        start: scaled parameters that the model then has, by key.
        time: best moment of onset [s] for timed causes.
        trials: how many alternatives were looked at: causes, and onsets of them.
        gone: the cause that leaves; None: none does.
    """

    causes: tuple[Candidate, ...]
    drop: float
    start: Mapping[tuple[str, int], float]
    time: float | None = None
    trials: int = 1
    gone: Candidate | None = None
    ratio: float = 1.0

    @property
    def worth(self) -> float:
        """Fall of the deviance in units that the scores themselves vary by."""
        return self.drop / self.ratio

    @property
    def candidate(self) -> Candidate | None:
        """The first of the causes that come in."""
        return self.causes[0] if self.causes else None


class Everything:
    """The current model linearised with every candidate's entries free."""

    def __init__(self, flights: Flights, model: Model) -> None:
        """Linearises `model` with all causes free, but for refinements of what it has not."""
        self.flights, self.model = flights, model
        there = {c.label for c in model.causes}
        self._some = [c for c in flights.listed if not c.refines or c.requires in there]
        names = dict.fromkeys([*model.problem.names, *(n for c in self._some for n in c.names)])
        problem = flights.problem(tuple(names), times_of(model, model.causes))
        self._problem = problem = replace(problem, models=flights.whole.models)
        self._keys = [(name, flight) for name, _, flight in problem.entries]
        known = dict(zip(model.keys, model.z, strict=True))
        self._z = z = np.array([known.get(key, 0.0) for key in self._keys])
        # What has no slope at neutral has one to where its search begins.
        begin = {n: v for c in self._some for n, v in zip(c.names, c.start, strict=False)}
        secant = np.array([begin.get(name, 0.0) for name, _ in self._keys]) / problem.size
        nudge = np.where((z == 0.0) & (secant != 0.0), secant, 1e-5)
        nudge[[place == k.DELAY and z[i] == 0.0 for i, (_, place, _) in enumerate(problem.entries)]] = LATER
        self._gains = [with_additions(g) for g in model.gains]
        self._found = [self._whole(problem.sensitivities(j, z, model.psi, g, nudge)) for j, g in enumerate(self._gains)]
        self._near = near = quadratic(problem, self._gains, self._found, len(z))
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
        return Sensitivities(list(range(len(self._keys))), found.plain, J)

    @cached_property
    def unspent(self) -> float:
        """Fall of the deviance that the fit of the model itself left undone."""
        return self._best(self._own, self._g)[1]

    def losses(self) -> dict[str, Score]:
        """Predicted fall of the deviance without each cause that no other stands on, the others following: a loss."""
        out = {}
        for gone in removable(self.model):
            stay, slope, risen = self._left(gone)
            step, fall = self._best(stay, slope)
            away = np.array([name in gone.names for name, _ in self.model.keys])
            ratio, drop = calibration(self.model, away), fall - risen - self.unspent
            out[gone.label] = Score((), drop, self._start(stay, step), gone=gone, ratio=ratio)
        return out

    def scores(self, gone: Candidate | None = None) -> list[Score]:
        """Effect of each candidate that is not in the model, in the place of `gone` if given; best first."""
        stay, slope, risen = self._left(gone)
        left = left_without(self.model.causes, gone)
        there, present = {x for c in left for x in (c.effect, c.label)}, {self._keys[i][0] for i in stay}
        out = []
        for c in self._some:
            if (
                present.intersection(c.names)
                or (c.requires and c.requires not in there)
                or c.label in there
                or c == gone
            ):
                continue
            if c.timed is None:
                free = stay + [i for i, (name, _) in enumerate(self._keys) if name in c.names]
                step, fall = self._best(free, slope)
                found = Score((c,), fall, self._start(free, step), ratio=self._ratio(free, len(stay), step, gone))
            elif gone is None:
                found = self._scan(c)
            else:
                continue
            trials = found.trials * len(self.flights.listed)
            out.append(replace(found, drop=found.drop - risen - self.unspent, trials=trials, gone=gone))
        return sorted(out, key=lambda s: -s.worth)

    def _ratio(self, free: list[int], own: int, step: FloatArray, gone: Candidate | None) -> float:
        """By how much scores of the entries `free` from the `own`-th on vary more than information says, or 1.

        They are taken a step away, or a cause that is missing would itself make them vary.
        """
        if len(free) == own:
            return 1.0
        whole = self._away(gone)
        whole[free] = step
        inverse = np.linalg.inv(self._h[np.ix_(free, free)])
        return max(float(np.mean(self._near.spread(free, whole, inverse)[own:])), 1.0)

    def together(self, scores: Sequence[Score], least: float) -> Score:
        """The causes that still promise at least so much beside those before them, the most promising first."""
        free, chosen, fall, families = list(self._own), list[Candidate](), self.unspent, set[str]()
        step = self._best(free, self._g)[0]
        trusted = [s for s in scores if s.drop > least and s.ratio < TRUSTED]
        waiting = [c for s in trusted for c in s.causes if c.timed is None]
        while waiting:
            tried = []
            for c in waiting:
                own = [i for i, (name, _) in enumerate(self._keys) if name in c.names and i not in free]
                tried.append((*self._best([*free, *own], self._g), c, own))
            new, best, c, own = max(tried, key=lambda t: t[1])
            if best - fall < least:
                break
            free, step, fall = [*free, *own], new, best
            chosen.append(c)
            families.add(c.family)
            waiting = [w for w in waiting if w.family not in families and not set(w.names) & set(c.names)]
        return Score(tuple(chosen), fall - self.unspent, self._start(free, step), trials=len(self.flights.listed))

    def _best(self, free: list[int], slope: FloatArray) -> tuple[FloatArray, float]:
        """Step of these entries to the minimum within bounds, and the fall of the deviance."""
        h, g = self._h[np.ix_(free, free)], slope[free]
        step = newton_step(h, g, 0.0, self._box[0][free], self._box[1][free])
        return step, -float(2.0 * g @ step + step @ h @ step)

    def _start(self, free: list[int], step: FloatArray) -> dict[tuple[str, int], float]:
        return {self._keys[i]: float(self._z[i] + s) for i, s in zip(free, step, strict=True)}

    def _left(self, gone: Candidate | None) -> tuple[list[int], FloatArray, float]:
        """Entries of the model without `gone`, the slope where that is neutral, and the rise of the deviance."""
        names = free_names(left_without(self.model.causes, gone))
        stay = [i for i in self._own if self._keys[i][0] in names]
        z = self._away(gone)
        moved = self._h @ z
        return stay, self._g + moved, float(2.0 * self._g @ z + z @ moved)

    def _away(self, gone: Candidate | None) -> FloatArray:
        """Step that makes what leaves with `gone` neutral, shape (P,)."""
        z, names = np.zeros(len(self._keys)), free_names(left_without(self.model.causes, gone))
        away = [i for i in self._own if self._keys[i][0] not in names]
        z[away] = -self._z[away]
        return z

    def _scan(self, candidate: Candidate) -> Score:
        """Score of a cause at its best onset: additions to the motion from there on, each a column of its own."""
        own, best = self._own, Score((candidate,), -np.inf, {})
        root, trials = np.linalg.cholesky(self._h[np.ix_(own, own)]), 0
        pull = np.linalg.solve(root, self._g[own])
        settled = np.linalg.solve(root.T, pull)
        for j, g in enumerate(self._gains):
            track, n = self._problem.tracks[j], len(self._problem.tracks[j].t)
            mine = {(candidate.names[0], j), (candidate.names[0], -1)}
            (place,) = (i for i, key in enumerate(self._keys) if key in mine)
            columns = _Onsets(self._problem, j, self._z, self.model.psi, g, place)
            plain, J = self._found[j].plain, self._found[j].J[own]
            weighted = (J * self._problem.expected).reshape(len(own), -1)
            prior, starts = float(self._problem.prior[1][place]) ** -2.0, stretches(track)

            def at(row: int) -> tuple[float, float, float]:
                column = columns.from_row(row)  # noqa: B023
                flat = (column * self._problem.expected).ravel()
                across = np.linalg.solve(root, weighted @ flat)  # noqa: B023
                left = float(flat @ flat) + prior - float(across @ across)  # noqa: B023
                slope = float(np.sum(column * plain)) - float(across @ pull)  # noqa: B023
                # What of it the model's own entries do not take up, times what is left there, stretch by stretch.
                apart = flat - np.linalg.solve(root.T, across) @ weighted  # noqa: B023
                rest = plain.ravel() - settled @ weighted - slope / left * apart  # noqa: B023
                scores = np.add.reduceat((apart * rest).reshape(column.shape).sum(axis=1), starts)  # noqa: B023
                ratio = float(long_run(scores[:, None], np.zeros(len(starts)))[0]) / left  # noqa: B023
                return slope**2 / left, -slope / left, max(ratio, 1.0)

            margin = max(int(END * n), LEAST_ROWS)
            if n <= 2 * margin:
                continue
            rows = np.unique(np.linspace(margin, n - margin, ONSETS).astype(np.intp)).tolist()
            found = {row: at(row) for row in rows}
            step = max(int(np.diff(rows).max(initial=1)), 1)
            while step > 1:
                step = max(step // 3, 1)
                top = max(found, key=lambda row: found[row][0])
                close = {top + i * step for i in (-2, -1, 1, 2)} - found.keys()
                found |= {row: at(row) for row in close if LEAST_ROWS <= row < n - LEAST_ROWS}
            trials += n // LEAST_ROWS
            top = max(found, key=lambda row: found[row][0])
            if found[top][0] + self.unspent > best.drop:
                start = self._start([*own, place], np.append(np.zeros(len(own)), found[top][1]))
                best = Score(
                    (candidate,), found[top][0] + self.unspent, start, float(track.t[top]), ratio=found[top][2]
                )
        return replace(best, trials=max(trials, 1))


class _Onsets:
    """Derivatives of one flight's whitened innovations by an effect that begins at some row."""

    def __init__(self, problem: Problem, j: int, z: FloatArray, psi: FloatArray, g: Gains, place: int) -> None:
        """Simulates the effect of entry `place` over the whole flight."""
        moved = z.copy()
        moved[place] += NUDGE
        mean = reckoned(problem.tracks[j], g.mean)
        none, some = problem.models[j].beyond(np.array([problem.vector(v, j) for v in (z, moved)]), mean)
        self._none, self._more = none, some - none
        self._rates = np.ascontiguousarray(mean[:, 4:10])
        self._problem, self._j, self._psi, self._g = problem, j, psi, g
        self._p = problem.physics(z, j)
        self._plain = self._innovations(none)

    def _innovations(self, added: FloatArray) -> FloatArray:
        track = self._problem.tracks[self._j]._replace(beyond=Beyond(added, self._g.beyond.slope, self._rates))
        return innovations(track, self._p, self._psi, self._g)

    def from_row(self, row: int) -> FloatArray:
        """Derivative, shape (n, M), if the effect begins at `row`."""
        added = self._none.copy()
        added[row:] += self._more[row:]
        return (self._innovations(added) - self._plain) / NUDGE


def removable(model: Model) -> list[Candidate]:
    """Causes that no other stands on; their own refinements leave with them."""
    return [c for c in model.causes if not any(c.carries(x) and not x.refines for x in model.causes)]
