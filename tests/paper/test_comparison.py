"""The account of a comparison: which run stands for a method, what counts as a failure, what is refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from quadid_evaluation.optimisers.minimise import Result, Stop
from quadid_evaluation.paper import comparison
from quadid_evaluation.paper.black_box import fit_black_box, score_black_box
from quadid_evaluation.paper.comparison import METHODS, Scores, Tried, check_methods, lowest_cost, run_optimiser

from quadid.errors import NotIdentifiableError, ParameterError
from quadid.flight import fly
from quadid.identification.noise import NoiseModel
from quadid.identification.score import mse_score
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

PELICAN = Vehicle.shipped("pelican")


class Bowl:
    """Half of |x - 0.3|^2 + 1 in two dimensions."""

    lower, upper, start = np.zeros(2), np.ones(2), np.array([0.9, 0.8])

    def theta(self, point: FloatArray) -> FloatArray:
        return point

    def residual(self, points: FloatArray) -> FloatArray:
        return np.column_stack([points - 0.3, np.ones(len(points))])

    def cost(self, points: FloatArray) -> FloatArray:
        return np.asarray(0.5 * np.sum(self.residual(points) ** 2, axis=1))


def trial(cost: float, seed: int = 1) -> comparison.Trial:
    return comparison.Trial(seed, Result(np.zeros(2), cost, 10, 0.1, Stop.CONVERGED))


def test_the_run_of_median_cost_stands_for_a_method_and_failures_are_counted_against_the_best_of_all() -> None:
    method = Tried("pso", (trial(3.0, 1), trial(1.0, 2), trial(1.005, 3), trial(math.inf, 4)))
    assert method.typical.found.cost == 1.005
    assert method.failures(1.0) == 2
    assert lowest_cost([method, Tried("cma_es", (trial(0.5),))]) == 0.5


def test_random_methods_run_once_a_seed_others_once() -> None:
    assert [t.seed for t in run_optimiser("pso", Bowl(), (3, 4, 5), 200).trials] == [3, 4, 5]
    alone = run_optimiser("least_squares", Bowl(), (3, 4, 5), 200)
    assert len(alone.trials) == 1
    np.testing.assert_allclose(alone.typical.found.x, 0.3, atol=1e-6)
    assert alone.typical.found.cost == pytest.approx(0.5)


def test_methods_keep_the_order_of_the_table_and_unknown_ones_are_refused() -> None:
    assert check_methods(["moesp", "initial", "pso", "pso"]) == ("initial", "pso", "moesp")
    assert check_methods(METHODS) == METHODS
    with pytest.raises(ParameterError, match="did you mean 'l_shade'"):
        check_methods(["lshade"])


def test_entries_are_json() -> None:
    method = Tried("pso", (trial(1.0),))
    entry = comparison.optimiser_entry(method, 1.0, Scores(1.0, (1.1,)), None, {"b": 2e-5})
    assert json.loads(json.dumps(entry))["mse"] == {"train": 1.0, "validate": [1.1]}
    assert comparison.failed_entry("cva", "no attitude")["failures"] == 1


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
