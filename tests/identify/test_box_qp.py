"""The small quadratic problem with bounds: its optimum, also where that lies on a bound to the last digit."""

import numpy as np
import pytest

from quadid.identification.gauss_newton import least_within


def problem(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A sparse problem, half of them with the free optimum of some parameters exactly on a bound."""
    p = int(rng.integers(2, 7))
    a = rng.normal(size=(p + 1, p)) * (rng.random((p + 1, p)) < 0.5)
    length = np.sqrt(np.sum(a**2, axis=0))
    a /= np.where(length > 0.0, length, 1.0)
    h = a.T @ a
    low, high = -rng.integers(0, 3, p) / 10.0, rng.integers(0, 3, p) / 10.0
    there = a @ np.where(rng.random(p) < 0.5, high, low)
    return h, -a.T @ (there if rng.random() < 0.5 else rng.normal(size=p + 1)), low, high


@pytest.mark.parametrize("seed", range(4))
def test_the_optimum_lies_within_the_bounds_and_nothing_pulls_inwards(seed: int) -> None:
    """Also where rounding takes a parameter beyond its bound, from where no share of a step leads back."""
    rng = np.random.default_rng(seed)
    for _ in range(5000):
        h, g, low, high = problem(rng)
        with np.errstate(all="raise"):
            z = least_within(h, g, low, high)
        assert np.all((low <= z) & (z <= high))
        pull = -(h @ z + g)
        most = 1e-8 * np.max(np.abs(g), initial=1e-300)
        assert np.all((pull >= -most) | (z <= low))
        assert np.all((pull <= most) | (z >= high))
