"""The flown vehicle stepped from outside flies as `fly` does, from the same commands."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadid.errors import ParameterError
from quadid.flight import SteppedFlight, TruthParameters, fly
from quadid.vehicle import Vehicle

PELICAN = Vehicle.shipped("pelican")


@pytest.mark.parametrize(
    "effects",
    [{}, {"motor_lag": {"tau": 0.04}, "command_delay": {"delay": 0.0135}, "rotor_drag": {"k_x": 0.3, "k_y": 0.2}}],
    ids=["nominal", "late"],
)
def test_the_commands_of_a_flight_give_that_flight(effects: dict[str, dict[str, float]]) -> None:
    flown = fly(PELICAN, seconds=3.0, seed=4, effects=effects, noise_scale=0.0)
    truth, again = flown.truth, SteppedFlight(PELICAN, effects=effects)
    first = 50  # what acts there is the command of the row before
    again._y[0:3], again._y[3:6], again._y[15:18] = (v[first] for v in (truth.position, truth.velocity, truth.rates))
    again._y[6:15] = Rotation.from_quat(truth.quaternion[first], scalar_first=True).as_matrix().ravel()
    again.rotor_speed[:] = truth.rotor_speed[first]
    rows = flown.window.rotor_speed
    again._rotors.level[:] = rows[first - 1]
    for k in range(first, 100):
        again.step(rows[k], 0.02)
    np.testing.assert_allclose(again.velocity, truth.velocity[100], atol=1e-9)
    np.testing.assert_allclose(again.rate, truth.rates[100], atol=1e-9)
    np.testing.assert_allclose(again.rotor_speed, truth.rotor_speed[100], atol=1e-9)


def test_a_hover_stays_and_a_wrong_command_is_refused() -> None:
    flight = SteppedFlight(PELICAN, TruthParameters())
    hover = flight.rotor_speed.copy()
    for _ in range(50):
        flight.step(hover, 0.01)
    np.testing.assert_allclose(flight.velocity, 0.0, atol=1e-9)
    assert flight.time == pytest.approx(0.5)
    assert flight.position[2] == pytest.approx(-30.0)
    np.testing.assert_allclose(flight.quaternion, [1.0, 0.0, 0.0, 0.0], atol=1e-12)
    with pytest.raises(ParameterError, match="4 finite rotor speeds"):
        flight.step(np.ones(3), 0.01)
