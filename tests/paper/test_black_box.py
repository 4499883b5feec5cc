"""Black boxes: what they see of a flight, that one is found under its stabiliser, and the score beside the model."""

import numpy as np
import pytest
from quadid_evaluation.paper.black_box import FEEDTHROUGH, fit_black_box, quadrotor_io, score_black_box
from quadid_evaluation.paper.subspace import METHODS, fit_subspace, predict

from quadid.data.window import Window
from quadid.errors import NotIdentifiableError, WindowError
from quadid.flight import fly
from quadid.identification.noise import NoiseModel
from quadid.identification.result import mse_score
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle

PELICAN = Vehicle.shipped("pelican")


def test_black_boxes_stand_on_the_same_scale_as_the_physical_model() -> None:
    """On a flight that the physical model describes fully it is at the floor, and a linear model cannot be below."""
    flights = [fly(PELICAN, seconds=60.0, seed=seed) for seed in (41, 42)]
    noise, theta = NoiseModel.guess(9), Layout(PELICAN).initial(PELICAN)
    values = flights[0].truth.parameters.as_dict()
    theta[: len(NOMINAL_NAMES)] = [values[n] for n in NOMINAL_NAMES]
    perfect = mse_score([flights[1].window], PELICAN, theta, noise).mse
    box = fit_black_box("cva", [flights[0].window], noise, (12, 20))
    unseen = score_black_box(box, [flights[1].window], PELICAN, noise)
    assert perfect < unseen < 5.0 * perfect
    with pytest.raises(NotIdentifiableError, match="1.4 s without gaps"):
        score_black_box(box, [flights[1].window.slice(0, 30)], PELICAN, noise)


def turning(rows: int = 5) -> Window:
    """Yaw through 180 degrees at fixed roll 0.2 and pitch -0.1, by the product of three elementary quaternions."""
    out = []
    for psi in np.linspace(3.0, 3.4, rows):
        roll, pitch, yaw = (np.array([np.cos(a / 2), np.sin(a / 2)]) for a in (0.2, -0.1, psi))
        (cr, sr), (cp, sp), (cy, sy) = roll, pitch, yaw
        out.append(
            [
                cy * cp * cr + sy * sp * sr,
                cy * cp * sr - sy * sp * cr,
                cy * sp * cr + sy * cp * sr,
                sy * cp * cr - cy * sp * sr,
            ]
        )
    speeds = np.full((rows, 4), 400.0)
    return Window(0.0, 0.02, speeds, gyro=np.ones((rows, 3)), attitude=np.array(out), accel=np.full((rows, 3), 2.0))


def test_inputs_are_squares_and_outputs_are_named_rates_angles_forces() -> None:
    inputs, outputs = quadrotor_io(turning())
    np.testing.assert_array_equal(inputs, 160_000.0)
    assert outputs.shape == (5, 9) == (5, len(FEEDTHROUGH))
    np.testing.assert_allclose(outputs[:, 3], 0.2)
    np.testing.assert_allclose(outputs[:, 4], -0.1)
    np.testing.assert_allclose(outputs[:, 5], np.linspace(3.0, 3.4, 5))  # unwrapped over pi
    np.testing.assert_array_equal(outputs[:, [0, 6]], [[1.0, 2.0]] * 5)


def test_missing_attitude_rows_stay_missing_and_do_not_break_the_unwrapping() -> None:
    window = turning()
    assert window.attitude is not None
    holes = window.attitude.copy()
    holes[1:3] = np.nan
    _, outputs = quadrotor_io(Window(0.0, 0.02, window.rotor_speed, window.gyro, holes, window.accel))
    assert np.all(np.isnan(outputs[1:3, 3:6]))
    np.testing.assert_allclose(outputs[[0, 3, 4], 5], [3.0, 3.3, 3.4])


def test_a_window_without_a_channel_is_refused_by_name() -> None:
    window = turning()
    with pytest.raises(WindowError, match="without accel"):
        quadrotor_io(Window(0.0, 0.02, window.rotor_speed, window.gyro, window.attitude))


def test_a_flight_under_its_stabiliser_gives_a_model_that_predicts_another_flight_for_a_second() -> None:
    train, validate = (quadrotor_io(fly(PELICAN, seconds=60.0, seed=seed).window) for seed in (1, 2))
    sigma = np.repeat([0.02, 0.005, 0.2], 3)
    for method in METHODS:
        model = fit_subspace(method, *train, 12, 15, 10, feedthrough=FEEDTHROUGH)
        prediction = predict(model, *validate, 50, sigma=sigma)
        measured = validate[1][prediction.starts[:, None] + np.arange(50)]
        error, spread = (prediction.outputs - measured) / sigma, (measured - np.mean(validate[1], axis=0)) / sigma
        # Rates and angles follow to a few percent of their movement, though nothing of a vehicle was told.
        assert np.all(np.mean(error**2, axis=(0, 1))[:6] < 0.1 * np.mean(spread**2, axis=(0, 1))[:6])
        assert np.mean(error**2) < 10.0
