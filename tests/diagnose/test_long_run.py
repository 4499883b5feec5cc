"""Variance of summed scores of a diagnosis beside random forces: as long a memory as the scores have."""

import numpy as np
import pytest
from scipy.signal import lfilter

from quadid.diagnosis.random_forces import long_run

WHITE = np.random.default_rng(3).standard_normal((4000, 2))


def test_white_scores_vary_as_much_as_they_say() -> None:
    assert long_run(WHITE, np.zeros(4000, int)) / 4000 == pytest.approx([1.0, 1.0], abs=0.15)


def test_memory_multiplies_the_variance_of_their_sum() -> None:
    # A first-order series sums to (1 + rho) / (1 - rho) times its own variance, here 1 / (1 - rho)^2 of its noise.
    slow = lfilter([1.0], [1.0, -0.8], WHITE, axis=0)
    assert long_run(slow, np.zeros(4000, int)) / 4000 == pytest.approx([25.0, 25.0], rel=0.3)


def test_flights_have_no_memory_of_one_another() -> None:
    # Neighbours of one sign, each the last of its flight: with a memory over flights they would vary twice as much.
    pairs = np.repeat(WHITE[:1000], 2, axis=0)
    apart = long_run(pairs, np.arange(2000))
    assert apart == pytest.approx(np.sum((pairs - pairs.mean(axis=0)) ** 2, axis=0))
    assert np.all(long_run(pairs, np.zeros(2000, int)) > 1.5 * apart)
