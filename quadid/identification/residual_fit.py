"""What a physical model leaves of a flight, learnt as terms beyond the catalogue.

Runs from measured states, up to half a second ahead, are linear enough in the coefficients of small forces and moments:
the errors of all runs give normal equations for every candidate term at once.  Terms are selected forwards by what each
takes off the summed error with the others adjusted (orthogonal matching pursuit: Pati, Rezaiifar and Krishnaprasad
1993, doi:10.1109/ACSSC.1993.342465), single signals first, then products of two as well; the equations are made anew
where the fit has gone.  Flights, or pieces of them, that were not fitted decide how many terms are worth having: the
fewest within a standard error of the best (Breiman and others 1984).  The physics never changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, islice

import numpy as np

from quadid.data.window import Window
from quadid.identification.multistep_errors import STAGES, MultistepErrors
from quadid.identification.schur_complement import eliminated
from quadid.identification.term_sensitivity import typical
from quadid.types import FloatArray
from quadid.vehicle import SIGNALS, TARGETS, ResidualTerm, Vehicle

PLAIN = (6, 15, 30)
"""Numbers of terms that are tried without products of two signals."""
RICH = (60, 120, 200)
"""Numbers of terms that are tried with them."""
SIZES = (0, *PLAIN, *RICH)
PRIOR_SECONDS = 1.0
"""Data [s] with a mean error of one that hold as firmly as the prior of a coefficient, its typical size."""
MOST_RUNS = 500
"""Runs that terms are selected, fitted and judged on; every n-th of more."""
FOLDS = 6
"""Parts of the data, each predicted once by what the others taught."""
_SHORTEST = 2.5
"""Shortest piece of a flight that is such a part [s]."""
STEPS = 2
"""Steps that a larger model takes from one selection."""
_STEPS = (1.0, 0.5, 0.25, 0.125)
"""Shares of a linear step that are tried; the first that lowers the error is taken."""

Terms = tuple[ResidualTerm, ...]


@dataclass(frozen=True)
class ResidualFit:
    """Learnt terms.

    Attributes:
        terms: with their coefficients, largest gain first; empty where none are worth having.
        unseen: mean error on data not fitted, as a share of no change, by number of terms; 0 is the physics alone.
    """

    terms: tuple[ResidualTerm, ...]
    unseen: dict[int, float]


def candidate_terms(flown: bool = True) -> tuple[ResidualTerm, ...]:
    """Terms that may be chosen, on every force and moment, coefficients zero.

    A constant, every signal by itself, drag with the speed, then the products of two signals.  Without a measured
    velocity (`flown` False) neither forces nor what depends on the velocity can be learnt.
    """
    plain = [name for name in SIGNALS if name != "V"]
    products = [(), *((name,) for name in plain), ("V", "v_x"), ("V", "v_y"), ("V", "v_z")]
    products += combinations_with_replacement(plain, 2)
    if not flown:
        products = [p for p in products if not any(SIGNALS[name] == "m/s" for name in p)]
    targets = [target for target in TARGETS if flown or target.startswith("moment")]
    return tuple(ResidualTerm(acts_on=target, product=p, value=0.0) for p in products for target in targets)


def fit_residual(windows: Sequence[Window], vehicle: Vehicle) -> ResidualFit:
    """Learns terms that let `vehicle` predict better, as many as data not fitted ask for.

    Args:
        windows: flights, on one grid.
        vehicle: physical model, effects included; its own residual terms are left out.

    Raises:
        NotIdentifiableError: no run of half a second fits into any window, or the physics run away at once.
    """
    candidates = candidate_terms(any(w.velocity is not None for w in windows))
    physical = vehicle.model_copy(update={"residual": ()})
    folds = _folds(windows)
    if len(folds) < 2:  # too short for a part to learn from and another to judge
        return ResidualFit((), {})
    others = [[w for i, fold in enumerate(folds) if i != held for w in fold] for held in range(len(folds))]
    paths = zip(*(_path(rest, physical, candidates) for rest in others), strict=True)
    errors: dict[int, FloatArray] = {}
    best = 0
    for size, fits in zip(SIZES, paths, strict=True):
        shares = [_runs(fold, physical, terms, STAGES[-1]).share() for fold, terms in zip(folds, fits, strict=True)]
        errors[size] = np.array(shares)
        if size > SIZES[1] and _clearly_below(errors[best], errors[size]):
            break  # more terms predict worse
        best = min(errors, key=lambda n: float(np.mean(np.log(errors[n]))))
    size = next(n for n in errors if n == best or not _clearly_below(errors[best], errors[n]))
    unseen = {n: float(np.mean(e)) for n, e in errors.items()}
    if size == 0:
        return ResidualFit((), unseen)
    final = _path(windows, physical, candidates)
    return ResidualFit(next(islice(final, SIZES.index(size), None)), unseen)


def _clearly_below(a: FloatArray, b: FloatArray) -> bool:
    """Whether the errors `a` of all folds are below `b` by more than a standard error of their logarithmic ratio."""
    if not np.isfinite(a).all() or not np.isfinite(b).all():  # a run went away
        return bool(np.isfinite(a).all())
    gain = np.log(b) - np.log(a)
    return bool(np.mean(gain) > np.std(gain, ddof=1) / np.sqrt(len(gain)))


def _folds(windows: Sequence[Window]) -> list[list[Window]]:
    """Flights in `FOLDS` groups of about the same length; fewer flights in pieces, short ones in fewer."""
    flights: dict[tuple[str, tuple[float, float]], list[Window]] = {}
    for w in windows:
        flights.setdefault((w.name, w.log_span), []).append(w)
    parts = list(flights.values())
    if len(parts) < FOLDS:
        parts = [[piece] for w in windows for piece in _pieces(w, -(-FOLDS // len(parts)))]
    groups: list[list[Window]] = [[] for _ in range(FOLDS)]
    for part in sorted(parts, key=lambda part: -sum(map(len, part))):
        min(groups, key=lambda group: sum(map(len, group))).extend(part)
    return [group for group in groups if group]


def _pieces(w: Window, most: int) -> list[Window]:
    """A window in at most so many pieces of the same length, none shorter than `_SHORTEST`."""
    n = max(min(most, int(len(w) * w.dt / _SHORTEST)), 1)
    return [w.slice(i * len(w) // n, (i + 1) * len(w) // n) for i in range(n)]


def _path(windows: Sequence[Window], physical: Vehicle, candidates: Terms) -> Iterator[Terms]:
    """Fits of growing size, terms in the order in which they came: the sizes of `SIZES`."""
    plain = tuple(term for term in candidates if len(term.product) < 2 or "V" in term.product)
    terms: Terms = ()
    yield terms
    for seconds in STAGES[:-1]:
        terms = _stepped(_selected(windows, physical, terms, plain, PLAIN[0], seconds))
    for size in SIZES[1:]:
        offered = plain if size in PLAIN else candidates
        terms = _stepped(_selected(windows, physical, terms, offered, size, STAGES[-1]))
        for _ in range(1, STEPS):
            terms = _stepped(_linear(windows, physical, terms, STAGES[-1]))
        yield terms


def _runs(windows: Sequence[Window], physical: Vehicle, terms: Terms, seconds: Sequence[float]) -> MultistepErrors:
    return MultistepErrors(windows, physical.model_copy(update={"residual": terms}), seconds, MOST_RUNS)


@dataclass(frozen=True)
class _Linear:
    """The linear problem of terms about their values, all in units of typical sizes.

    Attributes:
        terms: the terms; physical: vehicle; windows, seconds: what runs are compared over.
        error: mean error of the runs; curvature: shape (P, P); slope: shape (P,).
    """

    terms: Terms
    physical: Vehicle
    windows: Sequence[Window]
    seconds: Sequence[float]
    error: float
    curvature: FloatArray
    slope: FloatArray

    def of(self, chosen: Sequence[int]) -> _Linear:
        """The problem of some of the terms; those left out act on nothing yet."""
        terms = tuple(self.terms[i] for i in chosen)
        return replace(self, terms=terms, curvature=self.curvature[np.ix_(chosen, chosen)], slope=self.slope[chosen])


def _linear(
    windows: Sequence[Window], physical: Vehicle, terms: Terms, seconds: Sequence[float], more: Terms = ()
) -> _Linear:
    """The problem of `terms` and of `more`, which have coefficients of zero."""
    runs = _runs(windows, physical, terms, seconds)
    slopes, errors = runs.slopes((*terms, *more))
    prior = PRIOR_SECONDS / sum(len(w) * w.dt for w in windows)  # curvature beside that of the mean error
    values = np.array([t.value for t in (*terms, *more)]) / typical(physical, (*terms, *more))
    curvature = (slopes @ slopes.T).astype(np.float64) + prior * np.eye(len(values))
    slope = slopes @ errors + prior * values
    return _Linear((*terms, *more), physical, windows, seconds, runs.share(), curvature, slope)


def _selected(
    windows: Sequence[Window], physical: Vehicle, terms: Terms, candidates: Terms, size: int, seconds: Sequence[float]
) -> _Linear:
    """Adds candidates, with coefficients of zero, until there are `size` terms."""
    have = {(term.acts_on, term.product) for term in terms}
    more = tuple(c for c in candidates if (c.acts_on, c.product) not in have)
    linear = _linear(windows, physical, terms, seconds, more)
    return linear.of(_pursued(linear.curvature, linear.slope, list(range(len(terms))), size))


def _stepped(linear: _Linear) -> Terms:
    """Takes one step in all coefficients, as long a part of it as lowers the error."""
    terms, physical = linear.terms, linear.physical
    sizes = typical(physical, terms)
    values = np.array([t.value for t in terms]) / sizes
    change = -np.linalg.solve(linear.curvature, linear.slope)
    for part in _STEPS:
        at = (values + part * change) * sizes
        moved = tuple(t.model_copy(update={"value": float(v)}) for t, v in zip(terms, at, strict=True))
        if _runs(linear.windows, physical, moved, linear.seconds).share() < linear.error:
            return moved
    return terms


def _pursued(h: FloatArray, g: FloatArray, chosen: list[int], size: int) -> list[int]:
    """Adds the term that lowers the linear problem's error most, the others adjusted, until there are `size`."""
    chosen = list(chosen)
    while len(chosen) < min(size, len(g)):
        left, share = eliminated(np.diag(h)[:, None, None], h[:, None, chosen], h[np.ix_(chosen, chosen)])
        slope = g - share[:, 0] @ g[chosen]
        free = np.ones(len(g), dtype=bool)
        free[chosen] = False
        gain = np.where(free, slope**2, -np.inf)
        gain[free] /= left[free, 0, 0]
        chosen.append(int(np.argmax(gain)))
    return chosen
