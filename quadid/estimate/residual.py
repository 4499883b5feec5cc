"""Terms beyond the catalogue, learnt on the smoothed missing force and moment.

Candidates are products of motions, of airspeed or of the rotors' speed with a motion: never the rotors' own thrust or
torque, which answer in closed loop what is missing, so that a file with these terms may fly.  On each axis terms are
selected forwards by the squares that each takes off with the others adjusted (orthogonal matching pursuit: Pati,
Rezaiifar and Krishnaprasad 1993, doi:10.1109/ACSSC.1993.342465); parts of the data that were not fitted decide how many
are worth having, and flights that were not fitted whether an axis keeps any.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from quadid.estimate.missing import FACTORS, MOTIONS, Missing
from quadid.types import FloatArray
from quadid.vehicle import SIGNALS, TARGETS, ResidualTerm

MOST = 3
"""Terms of one axis, at most."""
LEAST = 0.05
"""Share of the squared missing force or moment that terms must take off data that were not fitted."""
FOLDS = 6
"""Parts of the training data, each judged once by what the others teach."""
_SHORTEST = 2.5
"""Shortest piece of a flight that is such a part [s]."""


def candidate_products(flown: bool = True) -> tuple[tuple[str, ...], ...]:
    """Products that may be chosen: motions, drag with the speed, motions with the rotors' speed, products of motions.

    Args:
        flown: the velocity is measured; else nothing that depends on it can be learnt.
    """
    motions = [m for m in MOTIONS if flown or SIGNALS[m] != "m/s"]
    products: list[tuple[str, ...]] = [(m,) for m in motions]
    products += [("V", m) for m in motions if flown and SIGNALS[m] == "m/s"]
    products += [("W", m) for m in motions]
    return (*products, *combinations_with_replacement(motions, 2))


class _Sums(NamedTuple):
    """Of one part of the data: squares of products (P, P), with what is missing (P, 6), and of that alone (6,).

    The last includes the variance of what is missing, as `quadid.estimate.missing.size` does.
    """

    products: FloatArray
    cross: FloatArray
    missing: FloatArray


def learn(
    train: Sequence[Missing], unseen: Sequence[Sequence[Missing]] = (), flown: bool = True
) -> tuple[ResidualTerm, ...]:
    """Terms that act on what is missing, in body axes at the centre of gravity.

    Args:
        train: stretches of flight to learn from; parts of them, each predicted by the others, say how many terms are
            worth having.
        unseen: other flights, a sequence of stretches each, of which an axis must miss less on every one; without any,
            those parts decide alone.
        flown: the velocity is measured on all of them.
    """
    products = candidate_products(flown)
    folds = [_sums(part, products) for part in _parts(train)]
    if len(folds) < 2:  # too short for a part to learn from and another to judge
        return ()
    every = _total(folds)
    size = np.sqrt(np.diag(every.products)) + 1e-300
    judges = [_sums(flight, products) for flight in unseen]
    out = []
    for axis, target in enumerate(TARGETS):
        if target.startswith("force") and not flown:
            continue
        # 1. How many: the fewest terms within a standard error of the best.
        left = np.array(
            [
                [_left(fold, _fitted(chosen, others, axis), axis) for chosen in _pursued(others, axis, size)]
                for fold, others in ((f, _total([g for g in folds if g is not f])) for f in folds)
            ]
        )
        best = int(np.argmin(left.mean(axis=0)))
        worse = left - left[:, best : best + 1]
        within = worse.mean(axis=0) <= worse.std(axis=0, ddof=1) / np.sqrt(len(folds))
        count = int(np.flatnonzero(within)[0])
        # 2. Worth having: on data that were not fitted.
        chosen = _pursued(every, axis, size)[count]
        value = _fitted(chosen, every, axis)
        shares = [float(left[:, count].mean()), *(_left(judge, value, axis) for judge in judges)]
        if count and max(shares[1:] or shares) <= 1.0 - LEAST:
            out += [ResidualTerm(acts_on=target, product=products[i], value=float(f"{value[i]:.5g}")) for i in chosen]
    return tuple(out)


def _parts(flights: Sequence[Missing]) -> list[list[Missing]]:
    """Flights in `FOLDS` groups; fewer flights in pieces, short ones in fewer."""
    pieces = list(flights)
    if len(flights) < FOLDS:
        pieces = []
        for m in flights:
            n = max(min(-(-FOLDS // len(flights)), int((m.t[-1] - m.t[0]) / _SHORTEST)), 1)
            edges = np.linspace(0, len(m.t), n + 1).astype(int)
            pieces += [m.rows(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    groups: list[list[Missing]] = [[] for _ in range(min(FOLDS, len(pieces)))]
    for piece in sorted(pieces, key=lambda m: -len(m.t)):
        min(groups, key=lambda group: sum(len(m.t) for m in group)).append(piece)
    return groups


def _sums(part: Sequence[Missing], products: Sequence[tuple[str, ...]]) -> _Sums:
    factors = np.concatenate([m.factors for m in part])
    value = np.column_stack([np.prod(factors[:, [FACTORS.index(s) for s in p]], axis=1) for p in products])
    missing = np.concatenate([np.column_stack([m.force, m.moment]) for m in part])
    spread = np.concatenate([np.column_stack([m.force_sigma, m.moment_sigma]) for m in part])
    return _Sums(value.T @ value, value.T @ missing, np.sum(missing**2 + spread**2, axis=0))


def _total(parts: Sequence[_Sums]) -> _Sums:
    return _Sums(*(np.sum(each, axis=0) for each in zip(*parts, strict=True)))


def _pursued(sums: _Sums, axis: int, size: FloatArray) -> list[list[int]]:
    """Products chosen with none, one, … `MOST` of them; `size` makes them comparable."""
    out: list[list[int]] = [[]]
    while len(out) <= MOST:
        have = out[-1]
        slope = sums.cross[:, axis] - sums.products @ _fitted(have, sums, axis)
        left = np.diag(sums.products).copy()
        if have:
            left -= np.sum(sums.products[:, have] * np.linalg.solve(_square(sums, have), sums.products[have]).T, axis=1)
        gain = np.where(left > 1e-6 * size**2, slope**2 / np.maximum(left, 1e-300), 0.0)
        gain[have] = 0.0
        out.append([*have, int(np.argmax(gain))])
    return out


def _square(sums: _Sums, chosen: Sequence[int]) -> FloatArray:
    square = sums.products[np.ix_(chosen, chosen)]
    return np.asarray(square + 1e-9 * np.diag(np.diag(square)) + 1e-300 * np.eye(len(chosen)))


def _fitted(chosen: Sequence[int], sums: _Sums, axis: int) -> FloatArray:
    """Least-squares coefficients, shape (P,); 0 where not chosen."""
    out = np.zeros(len(sums.cross))
    if chosen:
        out[list(chosen)] = np.linalg.solve(_square(sums, chosen), sums.cross[list(chosen), axis])
    return out


def _left(sums: _Sums, value: FloatArray, axis: int) -> float:
    """Share of the squared missing force or moment of an axis that coefficients leave."""
    left = sums.missing[axis] - 2.0 * value @ sums.cross[:, axis] + value @ sums.products @ value
    return float(left / sums.missing[axis]) if sums.missing[axis] > 0.0 else 1.0
