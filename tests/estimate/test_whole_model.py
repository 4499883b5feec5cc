"""The table of effects in the filter: what acts along its states, what sensors remember, how a flight begins."""

import numba as nb
import numpy as np
import pytest

from quadid.data.window import Window
from quadid.estimate import kalman as k
from quadid.estimate.fit import estimate
from quadid.estimate.problem import PLACES, Problem
from quadid.estimate.track import from_window
from quadid.estimate.whole_model import WholeModel, _attitude
from quadid.flight import draw_truth, fly
from quadid.model.layout import Layout
from quadid.model.rollout import Segments
from quadid.rotation import turn
from quadid.types import FloatArray
from quadid.vehicle import ParameterPrior, Vehicle
from tests.estimate.test_fit import PELICAN, guessed

SEED = 5


def test_drag_that_grows_with_the_square_of_a_velocity_nobody_measures_is_found_and_leaves_no_random_force() -> None:
    """Only the accelerometer shows it, by the velocity that it depends on itself."""
    truth = draw_truth(PELICAN, SEED)
    window = fly(PELICAN, truth, 60.0, SEED, effects={"parasitic_drag": {"c": 0.05}}).window
    vehicle = guessed(truth.as_dict(), 1.2, SEED)
    name = "parasitic_drag.c"
    found = estimate(Problem.of([from_window(window, vehicle, air=True)], vehicle, (name,), [window]))
    value, sigma = found.value(name)
    assert sigma < 0.003
    assert abs(value - 0.05) < 3.0 * sigma
    assert found.psi[k.SIGMA] < 0.03, "m/s^2, the horizontal random force"


def test_the_pull_of_the_attitude_filter_is_followed_along_a_whole_flight() -> None:
    """Simulated attitudes differ by what is added to those of the filter."""
    truth = draw_truth(PELICAN, SEED)
    window = fly(PELICAN, truth, 20.0, SEED).window
    numbers = truth.as_dict()
    vehicle = PELICAN.model_copy(
        update={"parameters": {n: ParameterPrior(initial=numbers[n]) for n in PELICAN.parameters}}
    )
    layout = Layout(vehicle)
    plain = layout.initial(vehicle)
    pulled = plain.copy()
    pulled[layout.entry("ahrs_acceleration_error.k").index] = 0.3
    read = simulated(window, vehicle, np.array([plain, pulled]))
    means = np.zeros((read.shape[1] + 2, k.N_MEAN))
    means[1:-1, :4], means[1:-1, 4:7], means[1:-1, 7:10] = _attitude(read[0]), read[0, :, :3], read[0, :, 9:12]
    means[0, 0] = 1.0
    means[0, :4], means[-1] = means[1, :4], means[-2]
    added = WholeModel(window.slice(0, len(means)), vehicle, PLACES).beyond(pulled[None], means)[0, 1:-1, 12:15]
    differs = turn(_attitude(read[0]), _attitude(read[1]))
    assert np.max(np.abs(differs)) > 0.02
    np.testing.assert_allclose(added, differs, atol=0.03 * np.max(np.abs(differs)))


def test_a_stretch_shorter_than_the_memory_of_a_sensor_adds_nothing() -> None:
    """Logs at 500 Hz with a gap near their begin ended in a traceback."""
    window = fly(PELICAN, draw_truth(PELICAN, SEED), 2.0, SEED).window
    layout = Layout(PELICAN)
    theta = layout.initial(PELICAN)
    theta[layout.entry("imu_lag.period").index] = 0.1
    means = np.zeros((5, k.N_MEAN))
    means[:, 0] = 1.0
    assert not WholeModel(window.slice(0, 5), PELICAN, PLACES).beyond(theta[None], means)[0, :, 9:].any()


def simulated(window: Window, vehicle: Vehicle, thetas: np.ndarray) -> np.ndarray:
    """Gyro, attitude, accelerometer and velocity of two seconds without measurements, shape (vectors, rows, 12)."""
    assert window.attitude is not None
    assert window.gyro is not None
    start = np.concatenate([window.attitude[0], window.gyro[0], np.zeros(6)])
    rollout = WholeModel(window, vehicle, PLACES)._rollout
    lanes, _ = rollout.roll(Segments(100, 1, np.array([1])), thetas, start[None])
    return np.moveaxis(lanes[:, 0], 3, 1).reshape(-1, *lanes.shape[2:4])[: len(thetas)]


@pytest.mark.parametrize(
    "numbers",
    [
        {"thrust_curve.dead_speed": 40.0},
        {"thrust_curve.dead_speed": -80.0, "thrust_curve.offset": 0.2},
        {"axial_inflow.k_z": 0.6},
    ],
    ids=["dead speed", "curve with an offset", "inflow"],
)
def test_what_the_filter_has_in_its_own_equations_moves_it_as_the_model_moves(numbers: dict[str, float]) -> None:
    """Steps of the filter from the same states, with an effect in its equations and with the model's addition."""
    window = fly(PELICAN, draw_truth(PELICAN, SEED), 12.0, SEED).window
    layout = Layout(PELICAN)
    theta = layout.initial(PELICAN)
    for name, value in numbers.items():
        theta[layout.entry(name).index] = value
    track = from_window(window, PELICAN, air=True)
    own = Problem.fixed([track], PELICAN, theta, [window])
    gains = own.passes(own.start(), own.first_noise())[1][0]
    assert not len(gains.beyond.added), "nothing is added to the filter's own equations"
    without = [name for name in PLACES if name not in numbers]
    added = WholeModel(window, PELICAN, without).beyond(theta[None], gains.mean)[0]
    acting = own.physics(own.start(), 0)
    plain = acting.copy()
    plain[[PLACES[name] for name in numbers]] = 0.0
    for row in (20, 33, 46, 300, 313, 326):
        moved = one_step(track, gains, acting, row) - one_step(track, gains, plain, row)
        np.testing.assert_allclose(moved[4:7], added[row, :3], atol=0.02 * np.abs(added[:, :3]).max())
        np.testing.assert_allclose(moved[7:10], added[row, 6:9], atol=0.02 * np.abs(added[:, 6:9]).max())


def one_step(track: k.Track, gains: k.Gains, p: FloatArray, row: int) -> FloatArray:
    """Mean after one step of the filter's own equations from a row, nothing random, shape (N_MEAN,)."""
    x: FloatArray = gains.mean[row].copy()
    table = k.moments(track, *k.turning(p))
    x[k.FO + 1 :] = 0.0
    _advance(k._constants(p, track), table[row], float(track.t[row + 1] - track.t[row]), np.zeros(9), x)
    return x


@nb.njit
def _advance(c, row, h, keep, x):  # type: ignore[no-untyped-def]
    k._advance(c, row, h, keep, True, x)
