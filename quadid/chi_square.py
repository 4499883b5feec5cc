"""The chi-square distribution of whole degrees of freedom, in closed form.

Only this much is needed of a statistics library, whose import would take longer than a short fit.
"""

from __future__ import annotations

import math
from functools import lru_cache

Z95 = 1.959963984540054
"""Standard deviations of a normal variable that 95 % lie within."""


def survival(x: float, freedom: int) -> float:
    """Probability that a chi-square variable of `freedom` degrees exceeds `x`.

    Finite sums of the regularised upper incomplete gamma function Q(freedom / 2, x / 2), Abramowitz & Stegun 26.4.4 and
    26.4.5, each term through its logarithm.
    """
    half = 0.5 * x
    if half <= 0.0:
        return 1.0
    odd = freedom % 2
    total = math.erfc(math.sqrt(half)) if odd else 0.0
    for i in range(freedom // 2):
        order = i + 0.5 * odd
        total += math.exp(order * math.log(half) - half - math.lgamma(order + 1.0))
    return min(total, 1.0)


def exceeded(probability: float, freedom: int) -> float:
    """Value that a chi-square variable of `freedom` degrees exceeds with this probability, 0 < probability < 1."""
    low, high = 0.0, 2.0 * freedom + 2.0
    while survival(high, freedom) > probability:
        low, high = high, 2.0 * high
    while high - low > 4e-16 * high:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if survival(middle, freedom) > probability else (low, middle)
    return 0.5 * (low + high)


@lru_cache(maxsize=64)
def lower_mean(share: float, freedom: int) -> float:
    """Mean of the lowest `share` of a chi-square variable, relative to the mean of all of it."""
    # The density times x is that of two more degrees, times the mean.
    return (1.0 - survival(exceeded(1.0 - share, freedom), freedom + 2)) / share
