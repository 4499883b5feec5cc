"""Normal equations of some parameters once others are fitted along: the Schur complement.

Minimised over the others o, the cost ``2 g z + z h z`` is that of the parameters m alone, with ``h_mm - gain h_om``
for h and ``g_m - gain g_o`` for g, where ``gain = h_mo h_oo^-1``.  Inverse covariances are marginalised alike.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quadid.types import FloatArray


class Schur(NamedTuple):
    """Parameters m with others o eliminated.

    Attributes:
        h: Schur complement, shape (..., m, m).
        gain: how a gradient of the others counts for them, shape (..., m, o).
    """

    h: FloatArray
    gain: FloatArray


def eliminated(h_mm: FloatArray, h_mo: FloatArray, h_oo: FloatArray) -> Schur:
    """Eliminates the parameters o.

    Args:
        h_mm: products of the parameters that stay, shape (..., m, m).
        h_mo: and with those that go, shape (..., m, o).
        h_oo: of those that go, positive definite, shape (o, o).
    """
    rows = h_mo.reshape(math.prod(h_mo.shape[:-1]), h_mo.shape[-1])
    gain = np.asarray(np.linalg.solve(h_oo, rows.T), dtype=np.float64).T.reshape(h_mo.shape)
    return Schur(h_mm - gain @ np.swapaxes(h_mo, -1, -2), gain)


def freed(h_mm: FloatArray, h_mo: FloatArray, h_oo: FloatArray, g_m: FloatArray, g_o: FloatArray) -> FloatArray:
    """By how much more the cost falls where the parameters m are free beside the others, shape (...).

    Args:
        h_mm: as in `eliminated`; positive definite together with the next two.
        h_mo: as there.
        h_oo: as there.
        g_m: gradient of the parameters m, shape (..., m).
        g_o: and of the others, shape (o,).
    """
    left = eliminated(h_mm, h_mo, h_oo)
    g = g_m - left.gain @ g_o
    return np.asarray(np.sum(g * np.linalg.solve(left.h, g[..., None])[..., 0], axis=-1))
