"""Choosing blocks: exchange against brute force, and what is known already counts."""

from itertools import combinations_with_replacement

import numpy as np
import pytest

from quadid.errors import ParameterError
from quadid.identification.uncertainty import d_optimal, halfwidths


def information(seed: int, count: int) -> np.ndarray:
    """Random information of `count` candidates, each about a few directions of three parameters."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((count, 2, 3)) * 10.0 ** rng.uniform(-1.0, 1.0, (count, 1, 3))
    return np.asarray(np.einsum("cri,crj->cij", rows, rows))


@pytest.mark.parametrize("seed", range(20))
def test_the_exchange_comes_close_to_the_best_of_all_choices(seed: int) -> None:
    candidates, known = information(seed, 6), np.eye(3)
    chosen = d_optimal(candidates, known, 4)
    found = np.linalg.slogdet(known + candidates[chosen].sum(axis=0))[1]
    best = max(
        np.linalg.slogdet(known + candidates[list(pick)].sum(axis=0))[1]
        for pick in combinations_with_replacement(range(6), 4)
    )
    assert best - 0.05 < found <= best + 1e-9


def test_what_is_known_already_is_not_flown_again() -> None:
    roll, pitch = np.diag([100.0, 0.0]), np.diag([0.0, 100.0])
    assert set(d_optimal(np.array([roll, pitch]), np.diag([1e4, 1.0]), 1)) == {1}
    assert sorted(d_optimal(np.array([roll, pitch]), np.eye(2), 4)) == [0, 0, 1, 1]


def test_nothing_to_choose_from() -> None:
    with pytest.raises(ParameterError, match="at least one"):
        d_optimal(np.empty((0, 2, 2)), np.eye(2), 3)


def test_half_widths_are_those_of_the_log_scale() -> None:
    sigma = np.array([0.01, 0.5])
    np.testing.assert_allclose(halfwidths(np.diag(sigma**-2.0)), np.exp(1.959964 * sigma) - 1.0, rtol=1e-6)
