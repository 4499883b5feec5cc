"""Lanes: exact nesting of models, independence of one another and of threads, smoothness in the parameters."""

import numpy as np
import pytest

from quadid.data.window import Sampling, Window
from quadid.model import layout as ix
from quadid.model.layout import Entry, Layout
from quadid.model.rollout import Rollout, Segments
from quadid.model.simd import LANES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.model.flights import lively_input, values_of, vector

VEHICLE = Vehicle.shipped("pelican").model_copy(update={"reference_voltage": 11.5})
LAYOUT = Layout(VEHICLE)
DT = 0.02
N_PRE = 8


def noisy_window(seconds: float = 1.4, sampling: Sampling = "held", motion: bool = True) -> Window:
    """A window whose measurements are noise: residuals are as good for comparing as any other."""
    given = lively_input(VEHICLE, seconds, DT, sampling=sampling)
    n, rng = len(given.rows), np.random.default_rng(3)
    attitude = np.array([1.0, 0.0, 0.0, 0.0]) + 0.05 * rng.standard_normal((n, 4))
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    gyro, accel, velocity, position = 0.2 * rng.standard_normal((4, n, 3))
    return Window(
        0.0,
        DT,
        given.rows,
        gyro,
        attitude,
        accel - [0.0, 0.0, 9.8],
        velocity if motion else None,
        position - [0.0, 0.0, 1.5] if motion else None,
        np.linspace(12.4, 10.4, n),
        sampling=sampling,
    )


def rolled(window: Window, thetas: FloatArray) -> FloatArray:
    """Residuals of each vector, shape (m, segments, length, channels)."""
    rollout = Rollout(window, VEHICLE)
    segments = Segments.cut(len(window), 25, N_PRE)
    out, _ = rollout.roll(segments, thetas, rollout.initial_states(segments, N_PRE), n_pre=N_PRE)
    return np.moveaxis(out, -1, 1).reshape(-1, *out.shape[1:4])[: len(thetas)]


def moved(theta: FloatArray, entry: Entry, by: float) -> FloatArray:
    out = theta.copy()
    out[entry.index] += by * entry.typical
    return out


def times_within(theta: FloatArray) -> FloatArray:
    """The times of change moved into the window, where they matter."""
    out = theta.copy()
    out[[ix.MASS_TIME, ix.DROP_TIME]] = 0.5071, 0.7113
    return out


EFFECTS = [e for e in LAYOUT.entries.values() if e.index > ix.JR and not e.name.endswith(".time")]
NOMINAL = vector(VEHICLE, values_of(VEHICLE))


@pytest.mark.parametrize("sampling", ["held", "instant"])
@pytest.mark.parametrize("entry", EFFECTS, ids=lambda e: e.name)
def test_neutral_is_neutral_beside_lanes_that_have_the_effect(entry: Entry, sampling: Sampling) -> None:
    """A neutral lane, computed by the kernel with that effect, gives to rounding what the kernel without it gives."""
    window = noisy_window(sampling=sampling)
    alone = rolled(window, NOMINAL[None])[0]
    beside = rolled(window, np.stack([NOMINAL, moved(times_within(NOMINAL), entry, 1.0)]))
    assert np.any(beside[1] != beside[0]) or entry.name.endswith((".h_x", ".h_y", ".north", ".east", ".central"))
    # Groups of effects are compiled apart, with other fused pairs.  A delay splits a step into nothing and the whole.
    allowed = 1e-11 if entry.name == "command_delay.delay" else 1e-13
    assert np.abs(beside[0] - alone).max() <= allowed


def test_model_without_velocity_agrees_with_the_full_one() -> None:
    window = noisy_window(motion=False)
    core = rolled(window, NOMINAL[None])[0]
    full = rolled(window, moved(NOMINAL, LAYOUT.entry("rotor_drag.k_x"), 1e-30)[None])[0]
    assert np.abs(core - full).max() < 1e-11


def random_vectors(m: int, seed: int = 1) -> FloatArray:
    rng = np.random.default_rng(seed)
    thetas = np.tile(times_within(NOMINAL), (m, 1))
    thetas[:, :6] *= np.exp(0.1 * rng.standard_normal((m, 6)))
    for e in EFFECTS:
        size = e.typical * rng.uniform(0.2, 1.0, m) * (0.02 if e.name.startswith("cg_offset") else 1.0)
        thetas[:, e.index] = e.neutral + size
    return thetas


def test_lanes_do_not_see_each_other() -> None:
    window, thetas = noisy_window(), random_vectors(3 * LANES)
    together = rolled(window, thetas)
    order = np.random.default_rng(2).permutation(len(thetas))
    assert np.array_equal(rolled(window, thetas[order]), together[order])
    for i in (0, LANES - 1, LANES, 2 * LANES + 5):
        pair = rolled(window, thetas[[i, (i + 7) % len(thetas)]])
        assert np.array_equal(pair[0], together[i])


def test_a_diverging_lane_harms_no_other() -> None:
    window, thetas = noisy_window(), random_vectors(LANES)
    calm = rolled(window, thetas)
    wild = thetas.copy()
    wild[5, [ix.JXX, ix.JYY]] = 1e-9
    wild[5, ix.KX] = -1e6
    found = rolled(window, wild)
    keep = np.arange(LANES) != 5
    assert np.array_equal(found[keep], calm[keep])
    assert not np.all(np.abs(found[5]) < 100.0)


def test_threads_give_the_same_bits_every_time() -> None:
    window, thetas = noisy_window(), random_vectors(8 * LANES)
    first = rolled(window, thetas)
    assert all(np.array_equal(rolled(window, thetas), first) for _ in range(3))


# --- derivatives, on which Gauss-Newton, covariances and score tests rest

INSIDE = {"motor_lag.tau": 0.05, "command_delay.delay": 0.0133, "imu_lag.period": 0.1, "attitude_delay.delay": 0.0233}
"""Points inside the bounds, off the edges of the grid at which delayed held inputs have kinks."""


def derivative(window: Window, theta: FloatArray, index: int, step: float, forward: bool = False) -> FloatArray:
    up, down = theta.copy(), theta.copy()
    up[index] += step
    down[index] -= 0.0 if forward else step
    one, two = rolled(window, np.stack([up, down]))
    return np.asarray(one - two) / (step if forward else 2.0 * step)


@pytest.mark.parametrize("name", list(LAYOUT.entries))
def test_finite_differences_of_several_steps_agree(name: str) -> None:
    window, entry = noisy_window(), LAYOUT.entry(name)
    theta = times_within(NOMINAL)
    for e in EFFECTS:
        theta[e.index] = INSIDE.get(e.name, e.neutral + (0.01 if e.name.startswith("cg_offset") else 0.5) * e.typical)
    steps = [entry.typical * h for h in (1e-3, 1e-4, 1e-5)]
    found = [derivative(window, theta, entry.index, step) for step in steps]
    size = np.abs(found[1]).max()
    assert size > 0.0
    assert np.abs(found[0] - found[1]).max() < 1e-3 * size
    assert np.abs(found[1] - found[2]).max() < 1e-4 * size


@pytest.mark.parametrize("name", ["motor_lag.tau", "command_delay.delay", "imu_lag.period", "attitude_delay.delay"])
def test_forward_differences_at_the_lower_bound(name: str) -> None:
    """Lags and delays start at 0, where only forward steps are allowed; a small step must tell the slope there."""
    window, entry = noisy_window(), LAYOUT.entry(name)
    found = [derivative(window, NOMINAL, entry.index, entry.typical * h, forward=True) for h in (1e-3, 1e-4, 1e-5)]
    size = np.abs(found[1]).max()
    assert np.abs(found[0] - found[1]).max() < 2e-2 * size
    assert np.abs(found[1] - found[2]).max() < 2e-3 * size
