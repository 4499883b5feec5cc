"""The paper's score: what it is made of, where it is lowest, and the stabiliser that it needs."""

from dataclasses import replace

import numpy as np
import pytest
from quadid_evaluation.paper.objective import PaperBox, PaperProblem, measured_outputs, paper_score

from quadid.errors import NotIdentifiableError
from quadid.identification.controller_gains import Autopilot, find_autopilot
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Stabiliser
from tests.identify.flights import PELICAN, flown, values_of

FLIGHT = flown(31)
LAYOUT = Layout(PELICAN)
TRUTH = np.concatenate([values_of(FLIGHT.truth.parameters), LAYOUT.neutral()[len(NOMINAL_NAMES) :]])


def given() -> Autopilot:
    return Autopilot(FLIGHT.gains, None, "given", ())


def test_the_score_is_the_mean_of_nine_squared_errors_in_the_papers_units() -> None:
    score = paper_score([FLIGHT.window], PELICAN, TRUTH, given())
    assert score is not None
    error = score.simulated - score.measured
    error[:, :3] = np.remainder(error[:, :3] + 180.0, 360.0) - 180.0
    assert score.mse == pytest.approx(np.mean(error**2), rel=1e-9)
    assert score.measured.shape == (len(FLIGHT.window), 9)
    assert FLIGHT.window.gyro is not None
    np.testing.assert_allclose(score.measured[:, 3:6], np.degrees(FLIGHT.window.gyro))


def test_the_truth_scores_lower_than_the_guess_and_than_its_neighbours() -> None:
    problem = PaperProblem([FLIGHT.window], PELICAN, given())
    guess = LAYOUT.initial(PELICAN)
    costs = problem.mse(np.array([TRUTH, guess]))
    assert costs[0] < 0.3 * costs[1]
    for name in ("b", "J_xx", "J_yy"):
        off = TRUTH.copy()
        off[LAYOUT.entry(name).index] *= 1.15
        assert problem.mse(off[None])[0] > costs[0]


def test_residual_and_cost_agree_and_missing_samples_do_not_count() -> None:
    w = FLIGHT.window
    assert w.gyro is not None
    gyro = w.gyro.copy()
    gyro[100:200] = np.nan
    problem = PaperBox([replace(w, gyro=gyro)], PELICAN, given())
    points = np.array([problem.start, np.log(values_of(FLIGHT.truth.parameters))])
    residual = problem.residual(points)
    assert np.isfinite(residual).all()
    np.testing.assert_allclose(0.5 * np.sum(residual**2, axis=1), problem.cost(points))
    assert problem.score(problem.theta(points[1])).mse == pytest.approx(problem.cost(points)[1], rel=1e-9)


def test_without_references_there_is_no_score() -> None:
    bare = replace(FLIGHT.window, attitude_reference=None)
    assert paper_score([bare], PELICAN, TRUTH, given()) is None
    assert paper_score([FLIGHT.window], PELICAN, TRUTH, None) is None
    assert find_autopilot([bare], PELICAN) is None
    with pytest.raises(NotIdentifiableError, match="references"):
        PaperProblem([bare], PELICAN, given())


def test_gains_are_found_in_the_log_up_to_what_cancels() -> None:
    found = find_autopilot([FLIGHT.window], PELICAN)
    assert found is not None
    assert found.source == "identified"
    assert min(found.explained) > 0.999
    lift = PELICAN.parameters["b"].initial / FLIGHT.gains["thrust_coefficient"]
    drag = PELICAN.parameters["d"].initial / FLIGHT.gains["drag_coefficient"]
    for axis, scale in (("roll", lift), ("pitch", lift), ("yaw", drag)):
        assert found.gains[f"{axis}_p"] == pytest.approx(FLIGHT.gains[f"{axis}_p"], rel=0.01)
        assert found.gains[f"{axis}_rate_p"] == pytest.approx(scale * FLIGHT.gains[f"{axis}_rate_p"], rel=0.01)
        assert found.gains[f"{axis}_rate_i"] == pytest.approx(scale * FLIGHT.gains[f"{axis}_rate_i"], rel=0.02)
    assert found.gains["max_speed"] == pytest.approx(FLIGHT.gains["max_speed"], rel=1e-3)
    scores = [paper_score([FLIGHT.window], PELICAN, TRUTH, a) for a in (given(), found)]
    assert scores[0] is not None
    assert scores[1] is not None
    assert scores[1].mse == pytest.approx(scores[0].mse, rel=0.02)


def test_gains_of_the_vehicle_file_go_first_and_commands_of_another_law_are_not_believed() -> None:
    known = PELICAN.model_copy(update={"stabiliser": Stabiliser(gains=dict(FLIGHT.gains), rate=200.0)})
    autopilot = find_autopilot([FLIGHT.window], known)
    assert autopilot == Autopilot(dict(FLIGHT.gains), 200.0, "given", ())
    rng = np.random.default_rng(1)
    other = FLIGHT.window.rotor_speed * (1.0 + 0.2 * rng.standard_normal(FLIGHT.window.rotor_speed.shape))
    assert find_autopilot([replace(FLIGHT.window, rotor_speed=other)], PELICAN) is None


def test_yaw_is_compared_the_short_way_round() -> None:
    outputs = measured_outputs(FLIGHT.window)
    assert np.nanmax(np.abs(np.diff(outputs[:, 2]))) < 30.0
