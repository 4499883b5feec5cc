"""Which parameter vectors share a block of lanes: those that need the same of the model, so that no block needs all."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import permutations

import numpy as np

from quadid.model import layout as ix
from quadid.model.needs_kernel import FACTOR_ENTRIES, HUB_ENTRIES, RARE_ENTRIES, ROTOR_ENTRIES, SOLID_ENTRIES
from quadid.model.simd import LANES
from quadid.types import BoolArray, FloatArray, IndexArray

_AIR, _HUB, _SOLID, _RARE, _ROTORS, _DELAYED, _FILTER, _LATE, _AHRS = range(9)
_PLAIN, _AIR_COST, _HUB_COST, _SOLID_COST, _RARE_COST = 10.0, 7.0, 6.0, 10.0, 7.0
_ROTOR_COST, _DELAYED_COST, _FILTER_COST, _LATE_COST, _AHRS_COST = 10.0, 22.0, 7.0, 14.0, 10.0
"""Nanoseconds a particle and step, beside the plain ones; `python -m benchmarks.speed --parts pieces` measures them."""


def packing(thetas: FloatArray, rotors: int, channels: int) -> IndexArray:
    """Lane of each of these parameter vectors (m, size), the first one in lane 0, shape (m,).

    Of a few orders by what a vector needs beyond the first one, the one that should take least time.  Lanes beyond the
    last vector are free to repeat the first.
    """
    if len(thetas) <= LANES:
        return np.arange(len(thetas))
    features = np.zeros((len(thetas), 9), dtype=bool)
    groups = ((_HUB, HUB_ENTRIES + RARE_ENTRIES), (_SOLID, SOLID_ENTRIES + FACTOR_ENTRIES), (_RARE, RARE_ENTRIES))
    for feature, entries in groups:
        features[:, feature] = (thetas[:, list(entries)] != 0.0).any(axis=1)
    features[:, _AIR] = features[:, _HUB] | (channels > 9)
    own = np.concatenate([thetas[:, list(ROTOR_ENTRIES)], thetas[:, ix.LOSS : ix.LOSS + 2 * rotors]], axis=1)
    features[:, _ROTORS] = (own != own[0]).any(axis=1)
    for feature, entry in ((_DELAYED, ix.DELAY), (_FILTER, ix.IMU_PERIOD), (_LATE, ix.ATT_DELAY), (_AHRS, ix.AHRS_K)):
        features[:, feature] = thetas[:, entry] != 0.0
    return _cheapest(features.tobytes(), len(thetas))


def packed(vectors: FloatArray, lane: IndexArray) -> FloatArray:
    """Vectors (m, n) in whole blocks of lanes, spare ones repeating the first."""
    out = np.repeat(vectors[:1], -(-len(vectors) // LANES) * LANES, axis=0)
    out[lane] = vectors
    return out


@lru_cache(maxsize=512)
def _cheapest(features: bytes, m: int) -> IndexArray:
    needs = np.frombuffer(features, dtype=bool).reshape(m, -1)
    best = min(_orders(needs), key=lambda order: _cost(needs, order))
    place = np.empty(m, dtype=np.intp)
    lanes = np.flatnonzero(best >= 0)
    place[best[lanes]] = lanes
    place.setflags(write=False)
    return place


def _orders(needs: BoolArray) -> Iterator[IndexArray]:
    """Vectors by lane, -1 for those that repeat the first: sorted by groups of needs, spare lanes early or late."""
    m = len(needs)
    spare = np.full(-(-m // LANES) * LANES - m, -1)
    groups = ([_ROTORS, _DELAYED], [_FILTER, _LATE, _AHRS], [_AIR, _HUB, _SOLID, _RARE])
    for keys in permutations(groups):
        columns = [needs[1:, f] for group in reversed(keys) for f in group]
        order = 1 + np.lexsort(columns)
        yield np.concatenate([[0], order, spare])
        yield np.concatenate([[0], spare, order])


def _cost(needs: BoolArray, order: IndexArray) -> float:
    """Time of all blocks, nanoseconds a lane and step."""
    total = 0.0
    for first in range(0, len(order), LANES):
        need: BoolArray = np.any(needs[np.maximum(order[first : first + LANES], 0)], axis=0)
        total += (
            _PLAIN
            + need[_AIR] * _AIR_COST
            + need[_HUB] * _HUB_COST
            + need[_SOLID] * _SOLID_COST
            + need[_RARE] * _RARE_COST
        )
        total += (_DELAYED_COST if need[_DELAYED] else _ROTOR_COST) * need[_ROTORS]
        total += need[_FILTER] * _FILTER_COST + need[_LATE] * _LATE_COST + need[_AHRS] * _AHRS_COST
    return total
