"""Causes by innovations: a score test over the catalogue, then refits compared by evidence at their own noise.

One model is better than another if it is more likely by Laplace's approximation, with the priors of
`quadid.diagnosis.evidence`: a cause is absent until proven, and must be of use.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.evidence import FALSE_ALARM, RELEVANT
from quadid.diagnosis.hypotheses import Candidate, candidates
from quadid.diagnosis.search import NEAR
from quadid.estimate.fit import ALL_NOISE, MOST, NO_NOISE, scoring
from quadid.estimate.kalman import Gains
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_window
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

REFITS, TURNS = 3, 4
"""Causes refitted on one model in a round, and steps of physics and noise together that a refit takes."""


@dataclass(frozen=True)
class Explained:
    """One model at its maximum.

    Attributes:
        z: scaled parameters; psi: noise numbers.
        objective: -2 ln of likelihood and priors.
        tests: causes that were looked at.
    """

    causes: tuple[Candidate, ...]
    problem: Problem
    z: FloatArray
    psi: FloatArray
    objective: float
    gains: list[Gains]
    information: FloatArray
    tests: int

    @property
    def names(self) -> tuple[str, ...]:
        """Effects."""
        return tuple(dict.fromkeys(c.effect for c in self.causes))

    @property
    def rows(self) -> int:
        """Scalar measurements."""
        return sum(int(np.count_nonzero(g.S)) for g in self.gains)

    def places(self, cause: Candidate) -> list[int]:
        """Places in z of the entries of a cause."""
        return [i for i, (name, _, _) in enumerate(self.problem.entries) if name in cause.names]

    def theta(self) -> FloatArray:
        """Full vector, of the first flight."""
        return self.problem.vector(self.z, 0)

    def height(self) -> float:
        """-2 ln evidence: what is not explained, how much narrower than its prior, how many were tried."""
        prior = 2.0 * float(np.log(self.tests / FALSE_ALARM)) * len(self.causes)
        return self.objective + float(np.linalg.slogdet(self.information)[1]) + prior

    def better(self, other: Explained) -> bool:
        """True if this one is more likely, and of models of which one contains the other also of use."""
        mine, others = {c.label for c in self.causes}, {c.label for c in other.causes}
        if mine < others:
            return not other.better(self)
        useful = not others < mine or other.objective - self.objective > RELEVANT * self.rows
        return useful and self.height() < other.height()


def search(windows: Sequence[Window], vehicle: Vehicle, report: bool = False) -> tuple[Explained, Explained]:
    """The nominal model, and that with the causes that the flights support."""
    layout = Layout(vehicle)
    has_velocity, has_position = (all(getattr(w, n) is not None for w in windows) for n in ("velocity", "position"))
    rotors = ["readings" if vehicle.command.sampling == "instant" else "commands"]
    rotors += ["battery"] if vehicle.reference_voltage is not None and windows[0].battery is not None else []
    listed = [
        c
        for c in candidates(layout, has_velocity, has_position, rotors)
        if c.timed is None and not c.split and c.effect not in vehicle.effects
    ]
    tracks = [from_window(w, vehicle, air=True) for w in windows]
    whole = Problem.of(tracks, vehicle, tuple(n for c in listed for n in c.names), windows)
    nominal = _fitted(whole, (), None, len(listed))
    model = nominal
    while True:
        tried: list[Explained] = []
        for generated in (_added(model, whole, listed), _dropped(model, whole), _swapped(model, whole, listed)):
            tried += list(generated)
            best = model
            for one in tried:
                if one.better(best):
                    best = one
            if best is not model:
                break
        if report:
            for one in tried:
                gains = one.objective - nominal.objective, one.height() - nominal.height()
                print(f"    {one.names}: {gains[0]:.1f}, {gains[1]:.1f}", flush=True)
        if best is model:
            return nominal, model
        model = best


def _with(whole: Problem, causes: Sequence[Candidate]) -> Problem:
    return replace(whole, names=(*NOMINAL_NAMES, *dict.fromkeys(n for c in causes for n in c.names)))


def _carried(source: Explained, problem: Problem) -> FloatArray:
    """Scaled parameters of another problem, where they are free in both."""
    known = {(name, flight): value for (name, _, flight), value in zip(source.problem.entries, source.z, strict=True)}
    return np.array([known.get((name, flight), 0.0) for name, _, flight in problem.entries])


def _starts(problem: Problem, causes: Sequence[Candidate]) -> FloatArray:
    """Starts of the searches over causes that cannot be linearised at neutral, scaled; 0: elsewhere."""
    start = {n: v for c in causes for n, v in zip(c.names, c.start or [0.0] * len(c.names), strict=True)}
    return np.array([start.get(name, 0.0) for name, _, _ in problem.entries]) / problem.size


def _fitted(
    whole: Problem, causes: tuple[Candidate, ...], near: Explained | None, tests: int, new: Candidate | None = None
) -> Explained:
    problem = _with(whole, causes)
    if near is None:
        z, psi = problem.start(), problem.first_noise()
        z = scoring(problem, z, psi, 8, NO_NOISE)[0]
    else:
        z, psi = _carried(near, problem), near.psi
        if new is not None:
            z = z + _starts(problem, [new])
        z = scoring(problem, z, psi, 2, NO_NOISE)[0]
    turns = MOST if near is None else TURNS
    z, psi, value, gains, information = scoring(problem, z, psi, turns, ALL_NOISE)
    return Explained(causes, problem, z, psi, value, gains, information, tests)


def scores(model: Explained, whole: Problem, listed: Sequence[Candidate]) -> list[tuple[float, Candidate]]:
    """Expected drop of -2 ln L by each cause, all regressors at once, beside the parameters that are free."""
    present = {c.label for c in model.causes}
    open_to = [c for c in listed if c.label not in present and c.requires in (None, *model.names, *present)]
    problem = _with(whole, [*model.causes, *open_to])
    z = _carried(model, problem)
    secant = np.where(z == 0.0, _starts(problem, open_to), 0.0)
    information, gradient = problem.normal_equations(z, model.psi, model.gains, np.where(secant != 0.0, secant, 1e-5))
    base = [i for i, (name, _, _) in enumerate(problem.entries) if name in model.problem.names]
    out = []
    for c in open_to:
        own = [i for i, (name, _, _) in enumerate(problem.entries) if name in c.names]
        across = np.linalg.solve(information[np.ix_(base, base)], information[np.ix_(base, own)])
        left = information[np.ix_(own, own)] - information[np.ix_(own, base)] @ across
        slope = gradient[own] - across.T @ gradient[base]
        step = -np.linalg.solve(left, slope)
        out.append((float(-slope @ step), c))
    return sorted(out, key=lambda s: -s[0])


def _added(model: Explained, whole: Problem, listed: Sequence[Candidate]) -> Iterator[Explained]:
    gained = 0.0
    least = max(RELEVANT * model.rows, 2.0 * np.log(model.tests / FALSE_ALARM))
    for drop, cause in scores(model, whole, listed)[:REFITS]:
        if drop < max(0.5 * least, NEAR * gained):
            break
        found = _fitted(whole, (*model.causes, cause), model, model.tests, cause)
        gained = max(gained, model.objective - found.objective)
        yield found


def _dropped(model: Explained, whole: Problem) -> Iterator[Explained]:
    covariance = np.linalg.inv(model.information)
    for cause in model.causes if len(model.causes) > 1 else ():
        own = model.places(cause)
        lost = model.z[own] @ np.linalg.solve(covariance[np.ix_(own, own)], model.z[own])
        if lost < 4.0 * RELEVANT * model.rows:
            yield _fitted(whole, tuple(c for c in model.causes if c is not cause), model, model.tests)


def _swapped(model: Explained, whole: Problem, listed: Sequence[Candidate]) -> Iterator[Explained]:
    """Look-alikes in the place of each cause."""
    present = {c.label for c in model.causes}
    for cause in model.causes:
        rest = tuple(c for c in model.causes if c is not cause)
        for rival in listed:
            alike = rival.family == cause.family and rival.label not in present and rival.requires is None
            if alike and not any(cause.carries(c) for c in rest):
                yield _fitted(whole, (*rest, rival), model, model.tests, rival)
