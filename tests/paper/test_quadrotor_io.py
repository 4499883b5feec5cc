"""What the black box sees of a flight, and that it can be identified from a flight under its stabiliser."""

from __future__ import annotations

import numpy as np
import pytest
from quadid_evaluation.paper.quadrotor_io import FEEDTHROUGH, OUTPUT_NAMES, OUTPUT_UNITS, quadrotor_io
from quadid_evaluation.paper.state_space import predict
from quadid_evaluation.paper.subspace import METHODS, fit_subspace

from quadid.data.window import Window
from quadid.errors import WindowError
from quadid.flight import fly
from quadid.vehicle import Vehicle


def turning(rows: int = 5) -> Window:
    """Yaw through 180 degrees at fixed roll 0.2 and pitch -0.1, by the product of three elementary quaternions."""
    out = []
    for psi in np.linspace(3.0, 3.4, rows):
        roll, pitch, yaw = (np.array([np.cos(a / 2), np.sin(a / 2)]) for a in (0.2, -0.1, psi))
        (cr, sr), (cp, sp), (cy, sy) = roll, pitch, yaw
        out.append([cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr,
                    cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr])  # fmt: skip
    speeds = np.full((rows, 4), 400.0)
    return Window(0.0, 0.02, speeds, gyro=np.ones((rows, 3)), attitude=np.array(out), accel=np.full((rows, 3), 2.0))


def test_inputs_are_squares_and_outputs_are_named_rates_angles_forces() -> None:
    inputs, outputs = quadrotor_io(turning())
    np.testing.assert_array_equal(inputs, 160_000.0)
    assert outputs.shape == (5, len(OUTPUT_NAMES)) == (5, len(OUTPUT_UNITS)) == (5, len(FEEDTHROUGH))
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
    pelican = Vehicle.shipped("pelican")
    train, validate = (quadrotor_io(fly(pelican, seconds=60.0, seed=seed).window) for seed in (1, 2))
    sigma = np.repeat([0.02, 0.005, 0.2], 3)
    for method in METHODS:
        model = fit_subspace(method, *train, 12, 15, 10, feedthrough=FEEDTHROUGH)
        prediction = predict(model, *validate, 50, sigma=sigma)
        measured = validate[1][prediction.starts[:, None] + np.arange(50)]
        error, spread = (prediction.outputs - measured) / sigma, (measured - np.mean(validate[1], axis=0)) / sigma
        # Rates and angles follow to a few percent of their movement, though nothing of a vehicle was told.
        assert np.all(np.mean(error**2, axis=(0, 1))[:6] < 0.1 * np.mean(spread**2, axis=(0, 1))[:6])
        assert np.mean(error**2) < 10.0
