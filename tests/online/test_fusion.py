"""Fusion: exact for quadratic costs, counts every second once, forgets, widens when windows scatter, sees changes."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from quadid.online.fit_job import WindowEstimate
from quadid.online.fusion import Fusion
from tests.online.made_up import nothing_left_out

P = 3
PRIOR = np.full(P, 0.7)


def window(start: float, z: np.ndarray, information: np.ndarray, seconds: float = 10.0) -> WindowEstimate:
    return WindowEstimate(start, start + seconds, z, information, np.zeros(P), 100.0, 100.0, nothing_left_out())


def random_information(rng: np.random.Generator) -> np.ndarray:
    a = rng.normal(size=(P, P))
    return 1e4 * (a @ a.T + 0.1 * np.eye(P))


@given(st.integers(0, 10_000), st.integers(1, 8))
def test_disjoint_windows_fuse_to_the_weighted_least_squares_solution(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    fusion = Fusion(np.zeros(P), PRIOR, memory=1e12)
    h, hz = np.diag(1.0 / PRIOR**2), np.zeros(P)
    for k in range(n):
        z, information = 0.01 * rng.normal(size=P), random_information(rng)
        fusion.add(window(10.0 * k, z, information))
        h, hz = h + information, hz + information @ z
    fused = fusion.estimate()
    assert fused is not None
    assert np.allclose(fused.z, np.linalg.solve(h, hz), rtol=1e-9, atol=1e-12)
    assert np.all(np.diag(fused.covariance) >= np.diag(np.linalg.inv(h)) * (1 - 1e-9))


def test_a_score_that_is_not_zero_is_a_step_still_to_be_made() -> None:
    information = random_information(np.random.default_rng(1))
    best, away = np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.1, 0.1])
    fusion = Fusion(np.zeros(P), np.full(P, 1e6), memory=1e12)
    fusion.add(
        WindowEstimate(0.0, 10.0, away, information, information @ (away - best), 100.0, 100.0, nothing_left_out())
    )
    fused = fusion.estimate()
    assert fused is not None
    assert np.allclose(fused.z, best, atol=1e-9)


def test_overlapping_windows_count_every_second_once() -> None:
    information = random_information(np.random.default_rng(2))
    rolling, apart = Fusion(np.zeros(P), PRIOR, 1e12), Fusion(np.zeros(P), PRIOR, 1e12)
    for k in range(51):
        rolling.add(window(float(k), np.zeros(P), information))
    for k in range(6):
        apart.add(window(10.0 * k, np.zeros(P), information))
    a, b = rolling.estimate(), apart.estimate()
    assert a is not None
    assert b is not None
    assert np.allclose(a.covariance, b.covariance, rtol=1e-6)


def test_old_information_fades_with_the_time_constant() -> None:
    information = random_information(np.random.default_rng(3))
    fusion = Fusion(np.zeros(P), PRIOR, memory=50.0)
    fusion.add(window(0.0, np.full(P, 0.1), information))
    for k in range(1, 40):
        fusion.add(window(10.0 * k, np.zeros(P), information))
    fused = fusion.estimate()
    assert fused is not None
    assert np.abs(fused.z).max() < 1e-3


def test_scattered_windows_widen_the_interval() -> None:
    rng = np.random.default_rng(4)
    information = np.eye(P) * 1e4  # claims 1 %
    calm, wild = Fusion(np.zeros(P), PRIOR, 1e12), Fusion(np.zeros(P), PRIOR, 1e12)
    for k in range(12):
        calm.add(window(10.0 * k, 0.01 * rng.normal(size=P), information))
        wild.add(window(10.0 * k, 0.05 * rng.normal(size=P), information))
    a, b = calm.estimate(), wild.estimate()
    assert a is not None
    assert b is not None
    assert np.all(b.sigma > 2.0 * a.sigma)


def test_a_change_is_seen_and_noise_is_not() -> None:
    rng = np.random.default_rng(5)
    information = np.eye(P) * 1e6
    fusion = Fusion(np.zeros(P), PRIOR, 120.0)
    alarms = 0
    for k in range(200):
        item = window(float(k), 1e-3 * rng.normal(size=P), information)
        alarms += not fusion.agrees(item)
        fusion.add(item)
    assert alarms == 0
    assert not fusion.agrees(window(200.0, np.array([0.15, 0.0, 0.0]), information))


def test_poor_residuals_make_a_window_count_less() -> None:
    information = np.eye(P) * 1e4
    good = WindowEstimate(0.0, 10.0, np.zeros(P), information, np.zeros(P), 100.0, 100.0, nothing_left_out())
    poor = WindowEstimate(10.0, 20.0, np.full(P, 0.01), information, np.zeros(P), 900.0, 100.0, nothing_left_out())
    fusion = Fusion(np.zeros(P), PRIOR, 1e12)
    fusion.add(good)
    fusion.add(poor)
    fused = fusion.estimate()
    assert fused is not None
    assert np.allclose(fused.z, 0.001, rtol=0.01)  # weights 1 and 1/9


def test_forgetting_leaves_nothing() -> None:
    fusion = Fusion(np.zeros(P), PRIOR, 100.0)
    fusion.add(window(0.0, np.zeros(P), np.eye(P)))
    fusion.forget()
    assert fusion.estimate() is None
    assert fusion.disjoint() == []
    assert fusion.before(100.0) is None
