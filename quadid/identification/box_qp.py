"""A small quadratic problem with bounds, by an active set.

The library's own solver does the same, but its import takes longer than a short fit.
"""

from __future__ import annotations

import numpy as np

from quadid.types import FloatArray

FLAT = 1e-14
"""Curvature, relative to the largest, below which a direction is flat: no step is made along it."""
_ROUNDING = 1e-11
"""Pull at a bound, relative to the largest of all, that counts as none."""


def least_within(h: FloatArray, g: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Minimises ``2 g z + z h z`` for low <= z <= high.

    Bounded-variable least squares, Stark & Parker, Computational Statistics 10 (1995) 129: parameters rest on bounds or
    are free; the free ones go to their own optimum or to the first bound on the way; one that the optimum would have
    leave its bound is set free.

    Args:
        h: positive semi-definite with a diagonal of about 1, shape (P, P).
        g: shape (P,).
        low: shape (P,), at most 0.
        high: shape (P,), at least 0.
    """
    z = _least(h, g)
    if np.all((z >= low) & (z <= high)):
        return z
    z = np.clip(z, low, high)
    free = (z > low) & (z < high)
    for _ in range(20 * len(g)):
        place = np.flatnonzero(free)
        wanted = _least(h[np.ix_(place, place)], g[place] + h[np.ix_(place, np.flatnonzero(~free))] @ z[~free])
        step = wanted - z[place]
        room = np.where(step > 0.0, high[place] - z[place], z[place] - low[place])
        blocked = np.abs(step) > room
        if blocked.any():
            share = np.min(room[blocked] / np.abs(step[blocked]))
            z[place] = np.clip(z[place] + share * step, low[place], high[place])
            first = blocked & (room <= share * np.abs(step) * (1.0 + 1e-12))
            z[place[first]] = np.where(step[first] > 0.0, high[place[first]], low[place[first]])
            free[place[first]] = False
            continue
        # Rounding would leave some beyond their bounds, where there is less than no room and no step.
        z[place] = np.clip(wanted, low[place], high[place])
        pull = -(h @ z + g)
        outward = np.where(free | (low == high), 0.0, np.where(z <= low, pull, -pull))
        best = int(np.argmax(outward))
        if outward[best] <= _ROUNDING * max(float(np.max(np.abs(g))), 1e-300):
            break
        free[best] = True
    return z


def _least(h: FloatArray, g: FloatArray) -> FloatArray:
    """Shortest step to the optimum without bounds."""
    if not len(g):
        return np.zeros(0)
    values, vectors = np.linalg.eigh(h)
    seen = values > FLAT * max(float(values[-1]), 0.0)
    return np.asarray(-vectors[:, seen] @ ((vectors[:, seen].T @ g) / values[seen]))
