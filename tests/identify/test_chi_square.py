"""The chi-square distribution beside scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from quadid.chi_square import exceeded, lower_mean, survival


@pytest.mark.parametrize("freedom", [1, 2, 3, 7, 24, 25, 50, 500])
def test_survival_and_its_inverse_are_those_of_scipy(freedom: int) -> None:
    for probability in (1e-200, 1e-9, 1e-3, 0.02, 0.5, 0.98):
        x = float(stats.chi2.isf(probability, freedom))
        assert survival(x, freedom) == pytest.approx(probability, rel=1e-9)
        assert exceeded(probability, freedom) == pytest.approx(x, rel=1e-11)
    assert survival(0.0, freedom) == 1.0


@pytest.mark.parametrize("freedom", [1, 9, 24, 50])
def test_mean_of_the_lower_part_is_that_of_the_quantiles(freedom: int) -> None:
    p = (np.arange(400_000) + 0.5) / 400_000 * 0.98
    assert lower_mean(0.98, freedom) == pytest.approx(float(np.mean(stats.chi2.ppf(p, freedom)) / freedom), rel=1e-6)
