"""What a physical model leaves of a flight, learnt as terms beyond the catalogue.

Runs from measured states, up to half a second ahead, are linear enough in the coefficients of small forces and moments:
the errors of all runs give normal equations for every candidate term at once.  Terms are selected forwards by what each
takes off the summed error with the others adjusted (orthogonal matching pursuit: Pati, Rezaiifar and Krishnaprasad
1993, doi:10.1109/ACSSC.1993.342465), single signals first, then products of two as well; the equations are made anew
where the fit has gone, and how many terms are worth having is decided on flights, or pieces of them, that were not
fitted.  The physics never changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, islice

import numpy as np

from quadid.identify.run_errors import STAGES, RunErrors
from quadid.identify.schur_complement import eliminated
from quadid.model.layout import Layout
from quadid.residual import SIGNALS, TARGETS, ResidualTerm
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from quadid.window import Window

PLAIN = (6, 15, 30)
"""Numbers of terms that are tried without products of two signals."""
RICH = (60, 120, 200)
"""Numbers of terms that are tried with them."""
SIZES = (0, *PLAIN, *RICH)
RIDGE = 1e-3
"""Curvature that holds coefficients of typical size back, relative to a mean error of one."""
SIMPLER = 0.02
"""Share of the error on data not fitted that more terms must take off; less ends the trials."""
WORTH = 0.97
"""Terms are kept when they bring the error on data not fitted below this share."""
MOST_RUNS = 500
"""Runs that terms are fitted and judged on; every n-th of more."""
SELECT_RUNS = 250
"""Runs that terms are selected by."""
_BLOCK = 84
"""Candidates whose slopes are taken at once: each of their runs evaluates all of them."""
FOLDS = 3
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
    errors: dict[int, float] = {}
    for size, fits in zip(SIZES, paths, strict=True):
        shares = [_share(fold, physical, terms, STAGES[-1]) for fold, terms in zip(folds, fits, strict=True)]
        errors[size] = float(np.mean(shares))
        if size > SIZES[1] and errors[size] > (1.0 - SIMPLER) * errors[SIZES[SIZES.index(size) - 1]]:
            break  # more terms predict no better
    size = min(errors, key=lambda n: errors[n] * (1.0 + SIMPLER) ** SIZES.index(n))
    if size == 0 or not errors[size] < WORTH * errors[0]:
        return ResidualFit((), errors)
    final = _path(windows, physical, candidates)
    return ResidualFit(next(islice(final, SIZES.index(size), None)), errors)


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
        terms = _fitted(windows, physical, _selected(windows, physical, terms, plain, PLAIN[0], seconds), seconds)
    for size in SIZES[1:]:
        offered = plain if size in PLAIN else candidates
        terms = _selected(windows, physical, terms, offered, size, STAGES[-1])
        for _ in range(STEPS):
            terms = _fitted(windows, physical, terms, STAGES[-1])
        yield terms


def _share(windows: Sequence[Window], physical: Vehicle, terms: Terms, seconds: Sequence[float]) -> float:
    """Mean error as a share of no change."""
    vehicle = physical.model_copy(update={"residual": terms})
    return RunErrors(windows, vehicle, seconds, MOST_RUNS).share(Layout(vehicle).initial(vehicle))


def _slopes(
    windows: Sequence[Window], physical: Vehicle, terms: Terms, more: Terms, seconds: Sequence[float], runs: int
) -> tuple[FloatArray, FloatArray]:
    """Slopes (len(terms + more), M) of all runs along terms of typical size, and their errors (M,)."""
    blocks = [terms] if terms else []
    blocks += [more[i : i + _BLOCK] for i in range(0, len(more), _BLOCK)]
    rows, errors = [], np.zeros(0)
    for block in blocks:
        wide = physical.model_copy(update={"residual": terms if block is terms else (*terms, *block)})
        theta, sizes = Layout(wide).initial(wide), _typical(wide)
        directions = np.zeros((len(block), len(theta)))
        places = np.arange(len(block))
        directions[places, len(theta) - len(block) + places] = sizes[len(sizes) - len(block) :]
        slopes, errors = RunErrors(windows, wide, seconds, runs).slopes(theta, directions)
        rows.append(slopes)
    return np.concatenate(rows), errors


def _typical(vehicle: Vehicle) -> FloatArray:
    """Sizes at which the residual terms of a vehicle matter."""
    return np.array([term.typical(vehicle.mass * GRAVITY, vehicle.arm) for term in vehicle.residual])


def _selected(
    windows: Sequence[Window], physical: Vehicle, terms: Terms, candidates: Terms, size: int, seconds: Sequence[float]
) -> Terms:
    """Adds candidates, with coefficients of zero, until there are `size` terms."""
    have = {(term.acts_on, term.product) for term in terms}
    more = tuple(c for c in candidates if (c.acts_on, c.product) not in have)
    j, errors = _slopes(windows, physical, terms, more, seconds, SELECT_RUNS)
    z = np.array([t.value for t in terms]) / _typical(physical.model_copy(update={"residual": terms}))
    z = np.concatenate([z, np.zeros(len(more))])
    chosen = _pursued(j @ j.T, j @ errors, z, list(range(len(terms))), size)
    return tuple((*terms, *more)[i] for i in chosen)


def _fitted(windows: Sequence[Window], physical: Vehicle, terms: Terms, seconds: Sequence[float]) -> Terms:
    """Takes one step in all coefficients, as long a part of it as lowers the error."""
    typical = _typical(physical.model_copy(update={"residual": terms}))
    values = np.array([t.value for t in terms])
    j, errors = _slopes(windows, physical, terms, (), seconds, MOST_RUNS)
    h, g = j @ j.T + RIDGE * np.eye(len(terms)), j @ errors + RIDGE * values / typical
    change = -np.linalg.solve(h, g) * typical
    before = _share(windows, physical, terms, seconds)
    for part in _STEPS:
        moved = tuple(
            term.model_copy(update={"value": float(v)}) for term, v in zip(terms, values + part * change, strict=True)
        )
        if _share(windows, physical, moved, seconds) < before:
            return moved
    return terms


def _pursued(h: FloatArray, g: FloatArray, z: FloatArray, chosen: list[int], size: int) -> list[int]:
    """Adds the term that lowers the linear problem's error most, the others adjusted, until there are `size`."""
    chosen = list(chosen)
    h, g = h + RIDGE * np.eye(len(z)), g + RIDGE * z
    while len(chosen) < min(size, len(z)):
        left, share = eliminated(np.diag(h)[:, None, None], h[:, None, chosen], h[np.ix_(chosen, chosen)])
        slope = g - share[:, 0] @ g[chosen]
        gain = slope**2 / np.maximum(left[:, 0, 0], RIDGE)
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
    return chosen
