"""The swarm's cost: weighted squares less what the initial states explain, against the formula on residuals."""

import numpy as np
import pytest

from quadid.data.window import Window
from quadid.model.rollout import Rollout, Segments
from quadid.model.simd import LANES
from quadid.types import FloatArray
from tests.model.test_lanes import N_PRE, NOMINAL, VEHICLE, noisy_window, random_vectors


def explicit(
    rollout: Rollout, segments: Segments, thetas: FloatArray, x0: FloatArray, weights: FloatArray, basis: FloatArray
) -> FloatArray:
    """sum of |W r|^2 - |Q' W r|^2 over segments."""
    out, _ = rollout.roll(segments, thetas, x0, n_pre=N_PRE)
    r = np.moveaxis(out, -1, 1).reshape(-1, *out.shape[1:4])[: len(thetas)]
    rows = segments.starts[:, None] + np.arange(segments.length)
    flat = (r[..., : weights.shape[1]] * weights[rows]).reshape(len(thetas), len(rows), -1)
    inside = np.einsum("sij,msi->msj", basis, flat)
    return np.asarray(np.sum(flat**2, axis=(1, 2)) - np.sum(inside**2, axis=(1, 2)))


def problem(
    window: Window, channels: int, directions: int
) -> tuple[Rollout, Segments, FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(9)
    rollout = Rollout(window, VEHICLE)
    segments = Segments.cut(len(window), 12, N_PRE)
    weights = rng.uniform(0.5, 5.0, (len(window), channels)) * (rng.random((len(window), channels)) > 0.2)
    basis = np.linalg.qr(rng.standard_normal((len(segments.starts), 12 * channels, directions)))[0]
    return rollout, segments, rollout.initial_states(segments, N_PRE), weights, basis


@pytest.mark.parametrize("channels", [9, 12, 15])
@pytest.mark.parametrize("directions", [0, 6, 12])
@pytest.mark.parametrize("m", [1, LANES, 2 * LANES + 3])
def test_cost_is_the_formula(channels: int, directions: int, m: int) -> None:
    rollout, segments, x0, weights, basis = problem(noisy_window(), channels, directions)
    thetas = random_vectors(m)
    found = rollout.costs(segments, thetas, x0, weights, basis, N_PRE)
    assert found.shape == (m,)
    assert np.allclose(found, explicit(rollout, segments, thetas, x0, weights, basis), rtol=1e-11, atol=0.0)


def test_unweighted_samples_do_not_count() -> None:
    """A sample that was not measured has weight 0; whatever stands there is ignored."""
    window = noisy_window(motion=False)
    assert window.gyro is not None
    gyro = np.array(window.gyro)
    gyro[20:30] = np.nan
    holed = Window(0.0, window.dt, window.rotor_speed, gyro, window.attitude, window.accel)
    rollout, segments, x0, weights, basis = problem(holed, 9, 6)
    weights = weights * rollout.valid
    cost = rollout.costs(segments, NOMINAL[None], x0, weights, basis, N_PRE)
    full = problem(window, 9, 6)[0].costs(segments, NOMINAL[None], x0, weights, basis, N_PRE)
    assert np.isfinite(cost).all()
    assert np.allclose(cost, full, rtol=1e-13)


def test_projection_removes_what_the_initial_state_explains() -> None:
    """Moving the initial state along the basis hardly changes the cost; without the basis it does."""
    window = noisy_window(motion=False)
    rollout, segments, x0, weights, _ = problem(window, 9, 6)
    h = 1e-6
    dx = np.concatenate([np.zeros((1, 12)), h * np.eye(12)[:6]])
    out, _ = rollout.roll(segments, np.tile(NOMINAL, (7, 1)), x0, dx, N_PRE)
    rows = segments.starts[:, None] + np.arange(segments.length)
    columns = (out[0, ..., 1:7] - out[0, ..., :1]) / h * weights[rows][..., None]
    basis = np.linalg.qr(columns.reshape(len(segments.starts), -1, 6))[0]
    moved = x0.copy()
    moved[:, 4:7] += 0.01
    costs = [rollout.costs(segments, NOMINAL[None], x, weights, basis, N_PRE)[0] for x in (x0, moved)]
    bare = [rollout.costs(segments, NOMINAL[None], x, weights, basis[..., :0], N_PRE)[0] for x in (x0, moved)]
    assert abs(costs[1] - costs[0]) < 1e-2 * abs(bare[1] - bare[0])


def test_shapes_that_do_not_fit_are_refused() -> None:
    rollout, segments, x0, weights, basis = problem(noisy_window(motion=False), 9, 6)
    with pytest.raises(ValueError, match="scale of shape|channels; allowed"):
        rollout.costs(segments, NOMINAL[None], x0, weights[:-1], basis, N_PRE)
    with pytest.raises(ValueError, match="scale of shape|channels; allowed"):
        rollout.costs(segments, NOMINAL[None], x0, np.ones((len(rollout), 12)), basis, N_PRE)
    with pytest.raises(ValueError, match="basis of shape"):
        rollout.costs(segments, NOMINAL[None], x0, weights, basis[:, 1:], N_PRE)
