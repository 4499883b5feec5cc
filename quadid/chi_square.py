"""The chi-square distribution.

SciPy's functions are imported where they are used: who only wants `Z95` does not wait for them.
"""

from functools import lru_cache

Z95 = 1.959963984540054
"""Standard deviations of a normal variable that 95 % lie within."""


def survival(x: float, freedom: int) -> float:
    """Probability that a chi-square variable of `freedom` degrees exceeds `x`."""
    from scipy.special import chdtrc

    return float(chdtrc(freedom, max(x, 0.0)))


@lru_cache(maxsize=64)
def exceeded(probability: float, freedom: int) -> float:
    """Value that a chi-square variable of `freedom` degrees exceeds with this probability, 0 < probability < 1."""
    from scipy.special import chdtri

    return float(chdtri(freedom, probability))


@lru_cache(maxsize=64)
def lower_mean(share: float, freedom: int) -> float:
    """Mean of the lowest `share` of a chi-square variable, relative to the mean of all of it."""
    # The density times x is that of two more degrees, times the mean.
    return (1.0 - survival(exceeded(1.0 - share, freedom), freedom + 2)) / share
