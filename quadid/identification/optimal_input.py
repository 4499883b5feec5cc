"""Which movements to fly: blocks of a manoeuvre chosen so that the parameters' joint interval shrinks most.

D-optimal design: the determinant of the Fisher information is maximised by adding the best block again and again and
then exchanging blocks while that helps.  Wynn, Ann. Math. Statist. 41 (1970) 1655; Fedorov, *Theory of Optimal
Experiments* (1972).
"""

from __future__ import annotations

import numpy as np

from quadid.chi_square import Z95
from quadid.errors import ParameterError
from quadid.types import FloatArray


def d_optimal(information: FloatArray, known: FloatArray, blocks: int) -> list[int]:
    """Chooses blocks, with repetition, whose summed information has the largest determinant.

    Args:
        information: Fisher information of the scaled parameters that each candidate brings, shape (candidates, P, P).
        known: information there already is, prior included; positive definite, shape (P, P).
        blocks: how many to choose.

    Returns:
        Indices of the chosen candidates, best first.

    Raises:
        ParameterError: nothing to choose from, or no block to choose.
    """
    if len(information) == 0 or blocks < 1:
        raise ParameterError(f"{blocks} blocks out of {len(information)} candidates", "at least one of each")
    chosen: list[int] = []
    total = known.copy()
    for _ in range(blocks):
        best = int(np.argmax(np.linalg.slogdet(total + information)[1]))
        chosen.append(best)
        total = total + information[best]
    for _ in range(10):
        before = list(chosen)
        for place, index in enumerate(chosen):
            rest = total - information[index]
            best = int(np.argmax(np.linalg.slogdet(rest + information)[1]))
            chosen[place], total = best, rest + information[best]
        if chosen == before:
            break
    return chosen


def halfwidths(information: FloatArray) -> FloatArray:
    """Relative 95 % half-width of each log parameter, all others unknown too, shape (P,): exp(1.96 sigma) - 1."""
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    return np.asarray(np.expm1(np.minimum(Z95 * sigma, 50.0)))
