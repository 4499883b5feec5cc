"""The peers are used fairly: each finds the truth of a flight that holds nothing but its own model."""

from __future__ import annotations

import numpy as np
import pytest
from quadid_evaluation.studies.peers import online, simulated

from quadid.flight import SensorNoise, fly
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle

PELICAN = Vehicle.shipped("pelican")


@pytest.mark.parametrize("program", ["mujoco.sysid", "output error"])
def test_the_truth_of_a_flight_without_noise_is_found(program: str) -> None:
    truth = simulated.body(1)
    numbers = truth.as_dict()
    window = fly(PELICAN, truth, 8.0, 1, noise=SensorNoise().scaled(1e-6)).window
    found, _ = simulated.PROGRAMS[program](window, simulated.guessed(numbers, 1))
    error = found.values - np.log([numbers[n] for n in NOMINAL_NAMES])
    assert np.all(np.abs(error[:5]) < 0.01), "b, d and the inertias"
    assert abs(error[5]) < 0.05, "J_r"


def test_kalman_filters_come_to_the_truth_and_follow_a_change_of_mass() -> None:
    truth = {n: p.initial for n, p in PELICAN.parameters.items()}
    flight = fly(PELICAN, seconds=20.0, seed=1, effects={"mass_change": {"time": 12.0, "fraction": 0.15}})
    vehicle = simulated.guessed(truth, 1)
    start = np.concatenate([np.zeros(3), np.log([vehicle.parameters[n].initial for n in online.NAMES])])
    true = np.log([flight.truth.parameters.as_dict()[n] for n in online.NAMES])
    for run in online.FILTERS.values():
        path = np.array(list(run(flight.window, vehicle, start)))
        assert np.all(np.abs(path[580] - true) < (0.01, 0.03, 0.01, 0.01, 0.03))
        assert path[-1, 0] < true[0] - 0.1, "a heavier vehicle looks like weaker rotors"
