"""Models of a diagnosis at the maximum of their likelihood, random forces and all noise with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.hypotheses import (
    RELEVANT,
    Candidate,
    HeldOut,
    Named,
    Quadratic,
    calibration,
    free_names,
    held_out,
    surely_gained,
)
from quadid.effects import EFFECTS, NEVER
from quadid.estimate import kalman as k
from quadid.estimate.fit import ALL_NOISE, MOST, NEAR, NO_NOISE, scoring, settle_noise, tails
from quadid.estimate.kalman import Beyond, Gains, Track
from quadid.estimate.problem import PER_FLIGHT, PLACES, Problem, Sensitivities, moments_at
from quadid.estimate.track import from_window
from quadid.identification.problem import Free
from quadid.identification.uncertainty import Uncertainty
from quadid.model.layout import places
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray, IndexArray
from quadid.vehicle import Vehicle

# --- The likelihood near a model, by stretches of time


STRETCH = 1.0
"""Length of the stretches whose scores are summed [s]."""


def stretches(track: Track) -> IndexArray:
    """First row of each stretch of a flight."""
    count = max(int((track.t[-1] - track.t[0]) / STRETCH), 1)
    return np.unique(np.linspace(0, len(track.t), count, endpoint=False).astype(np.intp))


def innovations(track: Track, p: FloatArray, psi: FloatArray, g: Gains) -> FloatArray:
    """Whitened innovations of a flight at physics p under the gains of a pass nearby, shape (n, M)."""
    out = np.zeros((len(track.t), k.M))
    k.replay(track, p, psi, g, moments_at(track, g, p), out)
    return out


def costs(problem: Problem, gains: Sequence[Gains]) -> tuple[FloatArray, FloatArray, IndexArray, FloatArray]:
    """Deviance of every stretch under the gains of a pass, its scalar measurements, its flight, its begin [s]."""
    parts = []
    for j, (track, g) in enumerate(zip(problem.tracks, gains, strict=True)):
        first, seen = stretches(track), g.S > 0.0
        S = np.where(seen, g.S, 1.0)
        density = np.where(seen, g.nu**2 / S + np.log(S) + problem.price(g), 0.0)
        cost, rows = (np.add.reduceat(a.sum(axis=1), first) for a in (density, seen))
        parts.append((cost, rows.astype(float), np.full(len(first), j), track.t[first]))
    cost, rows, window, time = (np.concatenate(column) for column in zip(*parts, strict=True))
    return cost, rows, window, time


def quadratic(problem: Problem, gains: Sequence[Gains], found: Sequence[Sensitivities], size: int) -> Quadratic:
    """The likelihood near the point of these sensitivities, one a flight, by `size` entries."""
    grams, grads = [], []
    for track, mine in zip(problem.tracks, found, strict=True):
        for first, last in _spans(track):
            gram, grad = np.zeros((size, size)), np.zeros(size)
            gram[np.ix_(mine.entries, mine.entries)], grad[mine.entries] = mine.quadratic(slice(first, last))
            grams.append(gram)
            grads.append(grad)
    return Quadratic(np.array(grams), np.array(grads), *costs(problem, gains))


def _spans(track: Track) -> list[tuple[int, int]]:
    first = stretches(track).tolist()
    return list(zip(first, [*first[1:], len(track.t)], strict=True))


# --- A model at the maximum of its likelihood, random forces and all noise with it


@dataclass(frozen=True)
class Model(Named):
    """A model at the maximum of its likelihood.

    Attributes:
        causes: candidates it contains.
        free: entries of the full vector that are free; theta: that vector, of the first flight.
        problem: the flights.
        z: scaled parameters; psi: noise numbers.
        deviance: -2 ln of likelihood and prior.
        gains: of the filter's pass there, one a flight.
        near: the likelihood near it.
        held_out: deviance of each block in the density that the others predict.
        rest: deviance of all blocks but one under parameters fitted to them, for each block.
        by_flight: the same two of whole flights.
        tried: how many alternatives (causes, and onsets of them) were looked at when each cause was, by label.
    """

    causes: tuple[Candidate, ...]
    free: Free
    theta: FloatArray
    problem: Problem
    z: FloatArray
    psi: FloatArray
    deviance: float
    gains: Sequence[Gains]
    near: Quadratic
    held_out: FloatArray
    rest: FloatArray
    by_flight: HeldOut
    tried: Mapping[str, float] = field(default_factory=dict)

    @property
    def keys(self) -> tuple[tuple[str, int], ...]:
        """Name and flight (-1: all) of every scaled parameter."""
        return self.problem.keys

    @property
    def rows(self) -> float:
        """Scalar measurements."""
        return self.near.total_rows

    @property
    def information(self) -> FloatArray:
        """Information of the data on the scaled parameters, shape (P, P)."""
        return self.near.information

    @cached_property
    def precision(self) -> FloatArray:
        """Precision of the prior of the scaled parameters, shape (P,)."""
        return np.asarray(self.problem.prior[1] ** -2.0)

    @cached_property
    def covariance(self) -> FloatArray:
        """Of the scaled parameters, by this likelihood, shape (P, P)."""
        return np.asarray(np.linalg.inv(self.information + np.diag(self.precision)))

    @cached_property
    def inflation(self) -> FloatArray:
        """True variance of each parameter over what the model counts on, from the scores of its stretches, (P,)."""
        return self.near.spread(range(len(self.z)), np.zeros(len(self.z)), self.covariance)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Covariance of the parameters in `free`, in their scale."""
        names = [name for name, _ in self.keys]
        at = [names.index(name) for name in self.free.names]
        unit = np.where(self.free.is_log, 1.0, self.problem.size[at] / self.free.scale)
        covariance = self.covariance[np.ix_(at, at)] * np.outer(unit, unit)
        return Uncertainty(covariance, np.ones(len(at)), unit * self.problem.prior[1][at])

    def gains_beside(self, small: Model) -> bool:
        """Checks whether what it has more than a `small` model gains enough on unseen blocks, in units of its scores.

        What belongs to the vehicle must do so on unseen flights too, where there are several.
        """
        own = np.array([key not in small.keys for key in self.keys])
        parts = [(HeldOut(small.held_out, small.rest), HeldOut(self.held_out, self.rest))]
        more = [c for c in self.causes if c.label not in small.labels]
        if len(small.by_flight.block) > 1 and not any(c.timed is not None or EFFECTS[c.effect].per_log for c in more):
            parts.append((small.by_flight, self.by_flight))
        needed = RELEVANT * small.rows * calibration(self.inflation[own])
        return all(surely_gained(*pair) > needed for pair in parts)


class Possible(Problem):
    """A problem whose effects stay within the bounds of the catalogue."""

    @cached_property
    def limits(self) -> FloatArray:
        """Bounds of the scaled parameters, shape (2, P)."""
        out = super().limits
        for i, (name, place, _) in enumerate(self.entries):
            if place >= k.TRIM and name in self.layout.entries:
                entry = self.layout.entry(name)
                out[:, i] = (np.array([entry.lower, entry.upper]) - entry.neutral) / self.size[i]
        return out


@dataclass(frozen=True)
class Flights:
    """Flights to diagnose, and every cause that these data could show.

    Attributes:
        windows: the flights.
        whole: the same, everything free that any cause frees.
        listed: the causes.
    """

    windows: tuple[Window, ...]
    whole: Problem
    listed: tuple[Candidate, ...]

    @classmethod
    def of(cls, windows: Sequence[Window], vehicle: Vehicle, listed: Sequence[Candidate]) -> Flights:
        """The flights of `windows`."""
        tracks = [from_window(w, vehicle, air=True) for w in windows]
        names = tuple(dict.fromkeys(n for c in listed for n in c.names))
        return cls(tuple(windows), Possible.of(tracks, vehicle, names, windows), tuple(listed))

    def problem(self, names: Sequence[str], times: Mapping[str, float]) -> Problem:
        """The same flights with these entries free, and effects that begin at these `times` [s].

        The others lie before the flight, so that the derivative by their size covers all of it.
        """
        theta, layout = self.whole.theta.copy(), self.whole.layout
        for spec in EFFECTS.values():
            if spec.timed:
                theta[list(places(f"{spec.name}.time"))] = times.get(spec.name, -NEVER)
        rest = [e for e in layout.entries.values() if e.name not in PLACES and not e.name.endswith(".time")]
        own = set(names) <= set(PLACES) and not any(theta[e.index] != e.neutral for e in rest)
        problem = replace(self.whole, names=tuple(names), theta=theta)
        return replace(problem, models=(), paths=()) if own else problem

    def along(self, model: Model) -> tuple[Flights, Model]:
        """The flights with effects simulated along the states of a model, and that model fitted so."""
        flights = replace(self, whole=self.whole.along(self.whole.start(), model.psi, model.gains))
        if not model.problem.models:
            return flights, model
        start = dict(zip(model.keys, model.z.tolist(), strict=True))
        again = flights.fit(model.causes, start, model.psi, times_of(model, model.causes), model.tried)
        return (flights, again) if again else (self, model)

    def nominal(self, theta: FloatArray) -> tuple[Flights, Model]:
        """The model without causes, from where the six are those of `theta`, and the flights with its unit of noise."""
        problem = self.problem(NOMINAL_NAMES, {})
        z = np.log(theta[: len(NOMINAL_NAMES)])
        # Random forces large at first, so that no flight runs away from a bad guess; then they shrink.
        z = scoring(problem, z, problem.first_noise(), 2 * NEAR, NO_NOISE)[0]
        problem, z = problem.based_on(z)
        z, psi, gains = settle_noise(problem, z, problem.first_noise())
        tail = tails(problem.tracks, gains)
        whole = replace(self.whole, base=problem.base, control=problem.control, tracks=problem.tracks, tail=tail)
        flights = replace(self, whole=whole)
        nominal = flights.fit((), dict(zip(problem.keys, z, strict=True)), psi, {}, {})
        assert nominal is not None
        return flights.along(nominal)

    def fit(
        self,
        causes: tuple[Candidate, ...],
        start: Mapping[tuple[str, int], float],
        psi: FloatArray,
        times: Mapping[str, float],
        tried: Mapping[str, float],
        wanted: float = np.inf,
    ) -> Model | None:
        """The model with `causes`, from scaled parameters `start` by key and noise numbers `psi`.

        None as soon as its deviance will hardly come down to what is `wanted`, or where it runs away.
        """
        problem = self.problem(free_names(causes), times)
        z = np.clip([start.get(key, 0.0) for key in problem.keys], *problem.limits)
        try:
            z, psi, deviance, gains, _ = scoring(problem, z, psi, MOST, ALL_NOISE, wanted=wanted)
        except np.linalg.LinAlgError:  # the filter ran away
            return None
        if not np.isfinite(deviance):
            return None
        problem = problem.weighted(gains)
        found = [problem.sensitivities(j, z, psi, g) for j, g in enumerate(gains)]
        near = quadratic(problem, gains, found, len(z))
        if not np.isfinite(near.information).all():
            return None
        blocks, flights = (held_out(part, problem.prior[1] ** -2.0) for part in (near, near.by_flight))
        free = Free(tuple(problem.layout.entry(n) for n in free_names(causes)))
        theta = problem.vector(z, 0)
        for i, (name, place, _) in reversed([*enumerate(problem.entries)]):
            if name in free.names and place < k.N_PHYSICS and name.startswith(PER_FLIGHT):  # biases beside the vector
                theta[problem.layout.entry(name).index] = z[i] * problem.size[i]
        return Model(causes, free, theta, problem, z, psi, deviance, gains, near, *blocks, flights, tried)


def times_of(model: Model, causes: Sequence[Candidate]) -> dict[str, float]:
    """Onsets of those of `causes` that `model` has, by effect [s]."""
    timed = {c.effect: c.timed for c in causes if c.timed is not None}
    return {effect: float(model.problem.theta[index]) for effect, index in timed.items() if effect in model.effects}


def with_additions(g: Gains) -> Gains:
    """Gains of a pass without additions, with additions of nothing: what is simulated beside it may then be added."""
    if len(g.beyond.slope):
        return g
    rows = len(g.mean)
    none = Beyond(np.zeros((rows, 9 + k.M)), np.zeros((rows, 12, 6)), np.ascontiguousarray(g.mean[:, 4:10]))
    return g._replace(beyond=none)
