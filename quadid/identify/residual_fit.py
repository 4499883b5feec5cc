"""What a physical model leaves of a flight, learnt as terms beyond the catalogue.

Runs from measured states, up to half a second ahead, are linear enough in the coefficients of small forces and moments:
the errors of all runs give normal equations for every candidate term at once, block by block.  Terms are selected
forwards by what each takes off the summed error with the others adjusted (orthogonal matching pursuit: Pati, Rezaiifar
and Krishnaprasad 1993, doi:10.1109/ACSSC.1993.342465), the equations are made anew where the fit has gone, and how many
terms are worth having is decided on flights, or halves of one, that were not fitted.  The physics never changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.identify.run_errors import STAGES, RunErrors
from quadid.model.layout import Layout
from quadid.residual import SIGNALS, TARGETS, ResidualTerm
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Window

SIZES = (6, 15, 30, 60)
"""Numbers of terms that are tried."""
RIDGE = 1e-3
"""Curvature that holds coefficients of typical size back, relative to a mean error of one."""
SIMPLER = 0.02
"""A smaller model is preferred when its error on data not fitted is larger by no more than this share."""
WORTH = 0.97
"""Terms are kept when they bring the error on data not fitted below this share."""
MOST_RUNS = 600
"""Runs that the equations are made of; every n-th of more."""
_SHORTEST = 5.0
"""A flight is cut in two only into halves at least so long [s]."""
_STEPS = (1.0, 0.5, 0.25, 0.125)
"""Shares of a linear step that are tried; the first that lowers the error is taken."""


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
    """A constant and every signal by itself, on every force and moment, and drag with the speed; coefficients zero.

    Without a measured velocity (`flown` False) neither forces nor what depends on the velocity can be learnt.
    """
    products = [(), *((name,) for name in SIGNALS if name != "V"), ("V", "v_x"), ("V", "v_y"), ("V", "v_z")]
    if not flown:
        products = [p for p in products if not any(SIGNALS[name] == "m/s" for name in p)]
    targets = [target for target in TARGETS if flown or target.startswith("moment")]
    return tuple(ResidualTerm(acts_on=target, product=p, value=0.0) for target in targets for p in products)


def fit_residual(windows: Sequence[Window], vehicle: Vehicle) -> ResidualFit:
    """Learns terms that let `vehicle` predict better, as many as data not fitted ask for.

    Args:
        windows: flights, on one grid.
        vehicle: physical model, effects included; its own residual terms are left out.

    Raises:
        NotIdentifiableError: no run of half a second fits into any window, or the physics run away at once.
    """
    flown = any(w.velocity is not None for w in windows)
    wide = vehicle.model_copy(update={"residual": candidate_terms(flown)})
    folds = _folds(windows)
    if len(folds) < 2:  # too short for a part to learn from and another to judge
        return ResidualFit((), {})
    unseen: dict[int, list[float]] = {}
    for held in range(len(folds)):
        judge = RunErrors(folds[held], wide, STAGES[-1], MOST_RUNS)
        rest = [w for i, fold in enumerate(folds) if i != held for w in fold]
        unseen.setdefault(0, []).append(judge.share(Layout(wide).initial(wide)))
        for size, theta, _ in _path(rest, wide, SIZES[-1]):
            unseen.setdefault(size, []).append(judge.share(theta))
    errors = {size: float(np.mean(shares)) for size, shares in unseen.items()}
    best = min(errors.values())
    size = min(n for n, error in errors.items() if error <= (1.0 + SIMPLER) * best)
    if size == 0 or not errors[size] < WORTH * errors[0]:
        return ResidualFit((), errors)
    _, theta, chosen = _path(windows, wide, size)[-1]
    values = theta[_first(wide) + np.array(chosen)]
    terms = [wide.residual[i].model_copy(update={"value": float(v)}) for i, v in zip(chosen, values, strict=True)]
    return ResidualFit(tuple(terms), errors)


def _first(vehicle: Vehicle) -> int:
    """Index of the first term in the full vector."""
    return Layout(vehicle).size - len(vehicle.residual)


def _folds(windows: Sequence[Window]) -> list[list[Window]]:
    """Flights in two groups of about the same length, or the halves of one flight."""
    flights: dict[tuple[str, tuple[float, float]], list[Window]] = {}
    for w in windows:
        flights.setdefault((w.name, w.log_span), []).append(w)
    if len(flights) == 1:
        halves: list[list[Window]] = [[], []]
        for w in windows:
            middle = len(w) // 2
            if middle * w.dt < _SHORTEST:
                halves[len(halves[0]) > len(halves[1])].append(w)
            else:
                halves[0].append(w.slice(0, middle))
                halves[1].append(w.slice(middle, len(w)))
        return [half for half in halves if half]
    groups: list[list[Window]] = [[], []]
    for flight in sorted(flights.values(), key=lambda part: -sum(map(len, part))):
        min(groups, key=lambda group: sum(map(len, group))).extend(flight)
    return [group for group in groups if group]


def _path(windows: Sequence[Window], vehicle: Vehicle, most: int) -> list[tuple[int, FloatArray, list[int]]]:
    """Fits of growing size: number of terms, full vector, the terms in the order in which they came."""
    theta = Layout(vehicle).initial(vehicle)
    chosen: list[int] = []
    path = []
    problems = [RunErrors(windows, vehicle, seconds, MOST_RUNS) for seconds in STAGES]
    for problem in problems:
        theta, chosen = _grown(problem, vehicle, theta, chosen, SIZES[0])
    for size in SIZES:
        if size > most:
            break
        theta, chosen = _grown(problems[-1], vehicle, theta, chosen, size)
        path.append((size, theta, list(chosen)))
    return path


def _grown(
    problem: RunErrors, vehicle: Vehicle, theta: FloatArray, chosen: list[int], size: int
) -> tuple[FloatArray, list[int]]:
    """Adds terms until there are `size`, and takes one step in all of them."""
    first, layout = _first(vehicle), Layout(vehicle)
    typical = np.array([layout.entries[f"residual.{i + 1}"].typical for i in range(len(vehicle.residual))])
    step = np.zeros((len(typical), len(theta)))
    step[np.arange(len(typical)), first + np.arange(len(typical))] = typical
    h, g = problem.equations(theta, step)
    z = theta[first:] / typical
    chosen = _selected(h, g, z, chosen, size)
    change = np.zeros(len(typical))
    change[chosen] = _solved(h, g, z, chosen)
    before = problem.share(theta)
    for part in _STEPS:
        moved = theta.copy()
        moved[first:] += part * change * typical
        if problem.share(moved) < before:
            return moved, chosen
    return theta, chosen


def _solved(h: FloatArray, g: FloatArray, z: FloatArray, chosen: list[int]) -> FloatArray:
    """Best change of the chosen coefficients."""
    inner = h[np.ix_(chosen, chosen)] + RIDGE * np.eye(len(chosen))
    return np.asarray(np.linalg.solve(inner, -(g[chosen] + RIDGE * z[chosen])))


def _selected(h: FloatArray, g: FloatArray, z: FloatArray, chosen: list[int], size: int) -> list[int]:
    """Adds the term that lowers the linear problem's error most, the others adjusted, until there are `size`."""
    chosen = list(chosen)
    curvature = np.diag(h) + RIDGE
    while len(chosen) < min(size, len(z)):
        change = np.zeros(len(z))
        left = curvature
        if chosen:
            change[chosen] = _solved(h, g, z, chosen)
            inner = h[np.ix_(chosen, chosen)] + RIDGE * np.eye(len(chosen))
            left = curvature - np.einsum("ij,ij->j", h[chosen], np.linalg.solve(inner, h[chosen]))
        slope = g + h @ change + RIDGE * (z + change)
        gain = slope**2 / np.maximum(left, RIDGE)
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
    return chosen
