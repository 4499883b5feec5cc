"""The filter against dense textbook algebra, its score against differences, its motion against the kernel's."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.estimate import kalman as k
from quadid.estimate.track import from_window
from quadid.flight import draw_truth, fly
from quadid.model.layout import Layout
from quadid.model.simulate import simulate
from quadid.types import FloatArray
from tests.estimate.linear import NOISE, PELICAN, batch, dense_filter, physics, tiny_flight

GAUSS = np.zeros(4)


def test_likelihood_and_means_are_those_of_a_dense_filter() -> None:
    track = tiny_flight()
    total, means = dense_filter(track)
    value, gains = k.kalman(track, physics(), NOISE, GAUSS, True)
    assert value == pytest.approx(total, rel=1e-9)
    np.testing.assert_allclose(gains.mean[:, 4:], means[:, 3:], atol=1e-9)
    np.testing.assert_allclose(2.0 * gains.mean[:, 1:4], means[:, :3], atol=1e-9)


def test_smoother_is_batch_least_squares() -> None:
    track = tiny_flight()
    mean, variance = batch(track)
    _, gains = k.kalman(track, physics(), NOISE, GAUSS, True)
    _, found, spread = k.backward(track, physics(), NOISE, gains, True)
    np.testing.assert_allclose(found, mean[:, k.FO :], atol=1e-9)
    np.testing.assert_allclose(spread, variance[:, k.FO :], rtol=1e-6)


def flown(seed: int = 1, seconds: float = 12.0) -> tuple[k.Track, FloatArray]:
    truth = draw_truth(PELICAN, seed)
    p = np.zeros(k.N_PHYSICS)
    p[:6] = list(truth.as_dict().values())
    flight = fly(PELICAN, truth, seconds, seed, extras=("velocity",))
    return from_window(flight.window, PELICAN), p


def test_score_is_the_slope_of_the_likelihood() -> None:
    track, p = flown()
    p[k.DRAG] = p[k.DRAG + 1] = 0.3
    _, gains = k.kalman(track, p, NOISE, GAUSS, True)
    score = k.backward(track, p, NOISE, gains, False)[0] * NOISE
    for i in range(k.N_NOISE):
        by = np.zeros(k.N_NOISE)
        by[i] = 1e-4 * NOISE[i]
        up, down = (k.kalman(track, p, NOISE + s * by, GAUSS, False)[0] for s in (1.0, -1.0))
        assert score[i] == pytest.approx((up - down) / 2e-4, rel=2e-2, abs=0.3), i


def test_random_forces_of_size_zero_change_nothing() -> None:
    track, p = flown()
    still, other = NOISE.copy(), NOISE.copy()
    still[k.SIGMA : k.SIGMA + 4] = other[k.SIGMA : k.SIGMA + 4] = 0.0
    other[k.TIME : k.TIME + 4] *= 3.0
    value, gains = k.kalman(track, p, still, GAUSS, True)
    assert value == k.kalman(track, p, other, GAUSS, False)[0]
    assert not gains.mean[:, k.FO + 1 : k.AE + 1].any()
    _, force, spread = k.backward(track, p, still, gains, True)
    assert not force[:, :6].any()
    assert not spread[:, :6].any()


def test_a_replay_of_the_same_physics_gives_the_same_innovations() -> None:
    track, p = flown()
    tail = np.full(4, 0.2)
    _, g = k.kalman(track, p, NOISE, tail, True)
    out = np.zeros((len(track.t), k.M))
    total = k.replay(track, p, NOISE, g, g.table, out)
    seen = g.S > 0.0
    np.testing.assert_allclose(out[seen], (g.nu * np.sqrt(g.w / np.where(seen, g.S, 1.0)))[seen], atol=1e-9)
    assert total == pytest.approx(float(np.sum(out**2)))


def test_motion_is_the_simulations() -> None:
    """The means move as `quadid.model` says, effects included; the filter only adds what was measured."""
    effects = {
        "rotor_drag": {"k_x": 0.3, "k_y": 0.4, "central": 1.0}, "cg_offset": {"x": 0.004, "y": -0.003},
        "rate_damping": {"l_p": 0.5, "m_q": 0.8, "n_r": 0.2},
    }  # fmt: skip
    vehicle = PELICAN.model_copy(update={"effects": effects})
    flight = fly(vehicle, seconds=4.0, seed=2)
    speed, dt = np.asarray(flight.window.rotor_speed), flight.window.dt
    wanted = simulate(vehicle, speed, dt, theta=Layout(vehicle).initial(vehicle))
    p = physics()
    p[:6] = vehicle.initial
    p[k.DRAG : k.DRAG + 2], p[k.CG : k.CG + 2] = (0.3, 0.4), (0.004, -0.003)
    p[k.DAMP : k.DAMP + 3] = 0.5, 0.8, 0.2
    seen = np.zeros((len(speed), 4), dtype=np.bool_)
    seen[0, 3] = True
    blind = from_window(flight.window, vehicle)._replace(seen=seen)
    _, g = k.kalman(blind, p, np.concatenate([NOISE[:12], np.zeros(6), NOISE[18:]]), GAUSS, True)
    np.testing.assert_allclose(g.mean[1:, 4:7], wanted.rate[:-1], atol=2e-3 * float(np.std(wanted.rate)))
    np.testing.assert_allclose(g.mean[1:, k.VE + 1 : k.VE + 4], wanted.velocity[:-1], atol=2e-2)
