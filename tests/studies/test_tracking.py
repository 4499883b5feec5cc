"""The controller of the tracking study: gains, frames, and that the truth tracks what a wrong model does not."""

import numpy as np
import pytest
from quadid_evaluation.studies.control import (
    ATTITUDE_WEIGHTS,
    CONTROL,
    CRAFT,
    EDGE,
    PATHS,
    POSITION_WEIGHTS,
    Known,
    desired_frame,
    gains,
    reference,
    track,
    unmixer,
)

from quadid.flight import draw_truth
from quadid.flight.airframe import PUSHES, Oddity
from quadid.flight.setup import prepare
from quadid.parameters import NOMINAL_NAMES


def test_gains_of_a_double_integrator_are_the_textbook_ones() -> None:
    """K = (sqrt q1, sqrt(q2 + 2 sqrt q1)) for x'' = u with weights (q1, q2) and 1."""
    np.testing.assert_allclose(gains((16.0, 3.0)), [4.0, np.sqrt(3.0 + 8.0)], rtol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_a_desired_frame_is_a_rotation_with_its_thrust_along_the_force(yaw: float) -> None:
    force = np.array([1.0, -2.0, -9.0])
    frame = desired_frame(force, yaw)
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    np.testing.assert_allclose(-frame[:, 2], force / np.linalg.norm(force))
    level = desired_frame(np.array([0.0, 0.0, -9.8]), yaw)
    np.testing.assert_allclose(level[:, 0], [np.cos(yaw), np.sin(yaw), 0.0], atol=1e-12)


def missed(path: str, scale: float) -> float:
    """Largest error [m] after two seconds with b and inertias believed `scale` times the truth, no noise."""
    truth = draw_truth(CRAFT, 1)
    setup = prepare(CRAFT, truth, {}, 10.0, 0.0, (0.0, 0.0), np.zeros((6, 4)))
    t = np.asarray(np.arange(-EDGE, 2500 + EDGE) * CONTROL, dtype=np.float64)
    way = reference(*PATHS[path](t))
    v = truth.as_dict()
    b, d, *j, j_r = (v[n] for n in NOMINAL_NAMES)
    known = Known(CRAFT.mass, scale * b, d, np.array(j), j_r, 0.0, np.zeros(2))
    noise = np.zeros((len(way.yaw), 12))
    went, _ = track(
        way,
        known,
        gains(POSITION_WEIGHTS),
        gains(ATTITUDE_WEIGHTS),
        unmixer(known),
        noise,
        np.zeros((len(way.yaw), PUSHES)),
        0.0,
        900.0,
        setup.efficiency,
        setup.body,
        setup.air,
        Oddity(),
    )
    return float(np.linalg.norm(went[500:] - way.position[500:], axis=1).max())


@pytest.mark.parametrize("path", PATHS)
def test_the_truth_tracks_and_a_wrong_thrust_does_not(path: str) -> None:
    right, wrong = missed(path, 1.0), missed(path, 1.3)
    assert right < 0.08
    assert wrong > 2.0 * right
