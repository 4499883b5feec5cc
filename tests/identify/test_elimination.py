"""Parameters eliminated from normal equations: what is left is the cost with them at their best."""

import numpy as np
import pytest

from quadid.identification.elimination import Reduced, StatePrior, eliminated, freed, reduce_segments


@pytest.mark.parametrize("grown", [1.0, 1e3, 1e6, 1e9, 1e10, 1e12, 1e14])
def test_a_cost_of_which_rounding_is_left_is_one_that_ran_away(grown: float) -> None:
    """Columns that all grow alike: the costs were 0 or less than nothing: better than that of every right model."""
    rng, own, free, rows = np.random.default_rng(0), 9, 6, 700
    mode = grown ** np.linspace(0.0, 1.0, rows)[:, None] * rng.normal(size=rows)[:, None]
    white = rng.normal(size=(4, rows, 1 + own + free)) + mode * rng.normal(size=(4, 1, 1 + own + free))
    prior, into = StatePrior(np.ones(own), 0.0, np.zeros((4, 3))), Reduced.room(4, own, free, rows, 1)
    reduce_segments(white, prior, into)
    for columns, cost, largest in zip(white, into.cost, into.largest, strict=True):
        basis = np.linalg.qr(np.vstack([columns[:, 1 : 1 + own], np.eye(own)]))[0]
        left = np.append(columns[:, 0], np.zeros(own))
        for _ in range(2):
            left -= basis @ (basis.T @ left)
        assert np.isinf(largest) or cost == pytest.approx(left @ left, rel=0.01)
        assert np.isinf(largest) == (grown > 1e6)


@pytest.mark.parametrize(("stay", "go"), [(1, 4), (3, 2), (3, 0), (0, 2)])
def test_what_is_left_is_the_cost_at_the_best_of_the_others(stay: int, go: int) -> None:
    rng = np.random.default_rng(stay + 10 * go)
    a, y = rng.standard_normal((20, stay + go)), rng.standard_normal(20)
    h, g, m, o = a.T @ a, -a.T @ y, slice(0, stay), slice(stay, None)
    left = eliminated(h[m, m], h[m, o], h[o, o])
    g_left = g[m] - left.gain @ g[o]
    own = g[o] @ np.linalg.solve(h[o, o], g[o])
    for z in rng.standard_normal((5, stay)):
        best = np.linalg.lstsq(a[:, o], y - a[:, m] @ z, rcond=None)[0]
        cost = np.sum((y - a[:, m] @ z - a[:, o] @ best) ** 2)
        assert cost == pytest.approx(y @ y - own + 2.0 * g_left @ z + z @ left.h @ z)


def test_what_freeing_parameters_gains_is_the_fall_of_the_least_cost() -> None:
    rng = np.random.default_rng(7)
    a, y = rng.standard_normal((30, 6)), rng.standard_normal(30)
    h, g, m, o = a.T @ a, -a.T @ y, slice(0, 2), slice(2, None)
    before, after = (np.linalg.lstsq(b, y, rcond=None)[1][0] for b in (a[:, o], a))
    assert freed(h[m, m], h[m, o], h[o, o], g[m], g[o]) == pytest.approx(before - after)


def test_the_covariance_of_what_is_left_is_that_of_the_whole() -> None:
    a = np.random.default_rng(3).standard_normal((30, 5))
    h = a.T @ a
    left = eliminated(h[:2, :2], h[:2, 2:], h[2:, 2:])
    np.testing.assert_allclose(np.linalg.inv(left.h), np.linalg.inv(h)[:2, :2])


def test_many_at_once_are_as_one_at_a_time() -> None:
    a = np.random.default_rng(5).standard_normal((30, 9))
    h = a.T @ a
    h_mm = np.stack([h[k : k + 2, k : k + 2] for k in (0, 2, 4)])
    h_mo = np.stack([h[k : k + 2, 6:] for k in (0, 2, 4)])
    whole = eliminated(h_mm, h_mo, h[6:, 6:])
    for k in range(3):
        one = eliminated(h_mm[k], h_mo[k], h[6:, 6:])
        np.testing.assert_allclose(whole.h[k], one.h)
        np.testing.assert_allclose(whole.gain[k], one.gain)
