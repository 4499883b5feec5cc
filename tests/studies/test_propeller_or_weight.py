"""Weights are weighed from trims: the study of what tells them from cut propellers."""

from __future__ import annotations

import numpy as np
import pytest
from quadid_evaluation.studies.health.flights import Wrong, hover
from quadid_evaluation.studies.health.kinds import mass_effect, weighed
from quadid_evaluation.studies.health.recorded import CRAZYFLIE, Flown, Judged

from quadid.condition import assess, flight_trim


@pytest.mark.parametrize("label", ["W1 glued near M3", "W1 glued near M4", "W1 glued near M3 M4"])
def test_a_weight_at_its_labelled_place_is_weighed(label: str) -> None:
    hubs = [CRAZYFLIE.rotors[int(j[1]) - 1].position[:2] for j in label.split() if j[0] == "M"]
    wrong = Wrong(mass=0.1 * CRAZYFLIE.mass, place=tuple(np.mean(hubs, axis=0)))
    vehicle = CRAZYFLIE.model_copy(update={"command": CRAZYFLIE.command.model_copy(update={"kind": "rotor_speed"})})
    baseline = [flight_trim(hover(vehicle, seed=k, spread=0.002), vehicle) for k in range(1, 6)]
    recording = hover(vehicle, wrong, spread=0.002)
    trim = flight_trim(recording, vehicle)
    health = assess([trim], baseline, vehicle)
    flown = Flown("", "", "", "weight", (0.0, 0.0, 0.0), False, label, trim, recording)
    assert weighed([Judged(flown, health)], health.healthy) == pytest.approx(0.1 / 1.1, abs=0.01)
    assert mass_effect(label)[3] == 1.0
