"""Scores against what they must be for the truth: 1 on the noise floor, zero without noise, larger when wrong."""

import numpy as np
import pytest

from quadid.errors import NotIdentifiableError, ParameterError
from quadid.flight import Flight, SensorNoise, fly
from quadid.identification.noise import NoiseModel
from quadid.identification.predict import OpenLoop, horizon_scores, true_rate
from quadid.identification.result import mse_score
from quadid.model import layout as ix
from quadid.model.layout import Layout
from quadid.rotation import euler
from tests.identify.flights import PELICAN, true_theta


@pytest.fixture(scope="module")
def flight() -> Flight:
    """A lively flight with velocity and position."""
    return fly(PELICAN, seconds=60.0, seed=31, extras=("velocity", "position"))


def true_noise() -> NoiseModel:
    """The sensors' noise as flown; vibration adds to gyro and accelerometer."""
    s = SensorNoise()
    white = np.repeat([np.hypot(s.gyro, 0.3 * s.gyro_shake), s.attitude, s.accel, s.velocity, s.position], 3)
    slow = np.repeat([0.0, s.attitude_slow, 0.0, 0.0, 0.0], 3)
    return NoiseModel(white, slow, s.attitude_time)


def test_the_truth_scores_one(flight: Flight) -> None:
    score = mse_score([flight.window], PELICAN, true_theta(flight), true_noise())
    assert score.mse == pytest.approx(1.0, abs=0.12)
    for c in score.channels:
        assert c.mse == pytest.approx(1.0, abs=0.25), c.name
        assert c.samples > 2500


def test_a_wrong_inertia_shows_on_its_axis(flight: Flight) -> None:
    theta = true_theta(flight)
    theta[ix.JXX] *= 1.3
    wrong = {c.name: c.mse for c in mse_score([flight.window], PELICAN, theta, true_noise()).channels}
    assert wrong["p"] > 1.5
    assert wrong["r"] == pytest.approx(1.0, abs=0.3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("growth", [10.0, 40.0])
def test_a_simulation_that_runs_away_scores_infinity_without_a_word(flight: Flight, growth: float) -> None:
    theta = true_theta(flight)
    theta[Layout(PELICAN).entry("rate_damping.l_p").index] = -growth
    assert mse_score([flight.window], PELICAN, theta, true_noise()).mse == np.inf


def test_fit_percent_is_the_contracts_formula(flight: Flight) -> None:
    score = mse_score([flight.window], PELICAN, Layout(PELICAN).initial(PELICAN), true_noise())
    y, y_sim = score.series.measured[:, 1], score.series.simulated[:, 1]
    expected = 100.0 * (1.0 - np.linalg.norm(y - y_sim) / np.linalg.norm(y - y.mean()))
    assert score.channels[1].fit_percent == pytest.approx(expected)
    assert score.channels[1].rmse == pytest.approx(np.sqrt(np.mean((y - y_sim) ** 2)))


def test_simulated_angles_belong_to_the_simulated_attitude(flight: Flight) -> None:
    score = mse_score([flight.window], PELICAN, true_theta(flight), true_noise())
    attitude = score.series.measured[:, 3:6]
    rows = np.searchsorted(flight.window.t, score.series.t - 1e-9)
    assert flight.window.attitude is not None
    np.testing.assert_allclose(np.cos(attitude), np.cos(euler(flight.window.attitude[rows])), atol=1e-9)
    assert np.std(score.series.simulated[:, 3:6] - attitude, axis=0) == pytest.approx([0.004] * 3, rel=0.5)


def test_channels_of_unknown_noise_are_shown_but_do_not_count(flight: Flight) -> None:
    nine = NoiseModel(true_noise().white[:9], true_noise().slow[:9], 1.0)
    score = mse_score([flight.window], PELICAN, true_theta(flight), nine)
    velocity = score.channels[9]
    assert (velocity.name, velocity.samples > 2500) == ("v_n", True)
    assert np.isnan(velocity.mse)
    assert 0.0 < velocity.rmse < 0.2
    assert score.mse == pytest.approx(1.0, abs=0.15)


def test_too_short_a_stretch_is_refused(flight: Flight) -> None:
    with pytest.raises(NotIdentifiableError, match="long enough"):
        mse_score([flight.window.slice(0, 40)], PELICAN, true_theta(flight))


def test_without_noise_the_truth_predicts_itself() -> None:
    quiet = fly(PELICAN, seconds=20.0, seed=32, noise_scale=0.0, extras=("velocity", "position"))
    pooled, _ = horizon_scores([[quiet.window]], PELICAN, true_theta(quiet))
    far = pooled.at(50)
    assert pooled.samples == len(quiet.window) - 50
    assert far["rate"] < 0.02
    assert far["rotation"] < 0.01
    assert far["velocity"] < 0.05
    assert far["position"] < 0.02


def test_gyro_errors_of_the_model_are_undone_at_the_start() -> None:
    effects = {
        "gyro_bias": {"x": 0.1, "y": -0.05, "z": 0.2},
        "gyro_scale": {"x": 0.04, "y": -0.03, "z": 0.02},
        "imu_misalignment": {"x": 0.03, "y": 0.02, "z": -0.04},
    }
    quiet = fly(PELICAN, seconds=20.0, seed=33, noise_scale=0.0, effects=effects, extras=("velocity", "position"))
    theta = true_theta(quiet)
    Layout(PELICAN).write_effects(theta, effects)
    known, _ = horizon_scores([[quiet.window]], PELICAN, theta)
    ignored, _ = horizon_scores([[quiet.window]], PELICAN, true_theta(quiet))
    assert known.at(50)["rotation"] < 0.02 < 0.1 < ignored.at(50)["rotation"]
    assert quiet.window.gyro is not None
    np.testing.assert_allclose(true_rate(quiet.window.gyro, theta), quiet.truth.rates, atol=2e-4)


def test_the_scale_of_the_velocity_is_undone_at_the_start_and_predicted_at_the_end() -> None:
    effects = {"velocity_scale": {"horizontal": 0.2, "vertical": -0.15}}
    quiet = fly(PELICAN, seconds=20.0, seed=35, noise_scale=0.0, effects=effects, extras=("velocity", "position"))
    theta = true_theta(quiet)
    ignored, _ = horizon_scores([[quiet.window]], PELICAN, theta)
    Layout(PELICAN).write_effects(theta, effects)
    known, _ = horizon_scores([[quiet.window]], PELICAN, theta)
    assert known.at(50)["position"] < 0.02 < 0.1 < ignored.at(50)["position"]
    assert known.at(50)["velocity"] < 0.05 < 0.1 < ignored.at(50)["velocity"]


def test_a_late_attitude_of_the_model_is_turned_on_at_the_start() -> None:
    effects = {"attitude_delay": {"delay": 0.05}}
    quiet = fly(PELICAN, seconds=20.0, seed=34, noise_scale=0.0, effects=effects, extras=("velocity", "position"))
    theta = true_theta(quiet)
    ignored, _ = horizon_scores([[quiet.window]], PELICAN, theta)
    Layout(PELICAN).write_effects(theta, effects)
    known, _ = horizon_scores([[quiet.window]], PELICAN, theta)
    for samples in (10, 50):
        assert known.at(samples)["rotation"] < 0.1 * ignored.at(samples)["rotation"]


def test_windows_and_files_pool_by_starts(flight: Flight) -> None:
    w = flight.window
    parts = [[w.slice(0, 300), w.slice(400, 500)], [w.slice(600, 1200)], [w.slice(0, 40)]]
    theta = Layout(PELICAN).initial(PELICAN)
    pooled, each = horizon_scores(parts, PELICAN, theta, (1, 20))
    assert [s.samples for s in each] == [250 + 50, 550, 0]
    assert pooled.samples == 850
    expected = (300 * each[0].mean[19] + 550 * each[1].mean[19]) / 850
    np.testing.assert_allclose(pooled.mean[19], expected)
    assert np.isnan(each[2].mean).all()


def test_impossible_horizons(flight: Flight) -> None:
    theta = Layout(PELICAN).initial(PELICAN)
    for horizons in ((), (0,), (5000,)):
        with pytest.raises(ParameterError):
            horizon_scores([[flight.window]], PELICAN, theta, horizons)
    with pytest.raises(NotIdentifiableError):
        horizon_scores([[flight.window.slice(0, 50)]], PELICAN, theta)


def test_rate_errors_by_axis_are_those_of_the_score(flight: Flight) -> None:
    theta = Layout(PELICAN).initial(PELICAN)
    misses = OpenLoop(flight.window, PELICAN, 10).misses(theta[None], np.array([10]))[0, :, 0, 3]
    errors = misses[~np.isnan(misses).any(axis=1)]
    pooled, _ = horizon_scores([[flight.window]], PELICAN, theta, [10])
    # The score's longest run is fifty samples, so it leaves out the last forty starts.
    mean = np.linalg.norm(errors[: pooled.samples], axis=1).mean()
    assert mean == pytest.approx(pooled.at(10)["rate"], rel=1e-9)
    assert len(errors) == pooled.samples + 40
