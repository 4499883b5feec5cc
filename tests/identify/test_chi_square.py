"""The chi-square distribution: tails of the tables, the mean of the lower part."""

import numpy as np
import pytest
from scipy import stats

from quadid.chi_square import Z95, exceeded, lower_mean, survival


def test_tails_are_those_of_the_tables() -> None:
    assert exceeded(0.05, 1) == pytest.approx(Z95**2, rel=1e-12)
    assert exceeded(0.01, 6) == pytest.approx(16.812, abs=5e-4)
    assert exceeded(1e-200, 3) == pytest.approx(stats.chi2.isf(1e-200, 3), rel=1e-9)
    assert survival(16.812, 6) == pytest.approx(0.01, abs=1e-5)
    assert survival(-1e-12, 6) == 1.0


@pytest.mark.parametrize("freedom", [1, 9, 24, 50])
def test_mean_of_the_lower_part_is_that_of_the_quantiles(freedom: int) -> None:
    p = (np.arange(400_000) + 0.5) / 400_000 * 0.98
    assert lower_mean(0.98, freedom) == pytest.approx(float(np.mean(stats.chi2.ppf(p, freedom)) / freedom), rel=1e-6)
