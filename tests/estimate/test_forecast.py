"""Bands of predictions hold the share of outcomes that they promise, from logged rotor speeds and in closed loop."""

from functools import lru_cache

import numpy as np
import pytest

from quadid.errors import NotIdentifiableError
from quadid.flight import Flight, fly
from quadid.identification.controller_gains import Autopilot
from quadid.identification.predict import BANDS, PHASES, Forecast, Shares
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import ParameterPrior, RandomForces, RandomInput, Vehicle

PELICAN = Vehicle.shipped("pelican")
RANDOM = RandomForces(
    horizontal=RandomInput(sigma=0.5, time=0.5),
    vertical=RandomInput(sigma=0.2, time=0.3),
    roll_pitch=RandomInput(sigma=1.5, time=0.2),
    yaw=RandomInput(sigma=0.3, time=0.5),
)
SEEDS = (1, 2, 3)
QUANTITIES = ("velocity", "rotation", "rate")


@lru_cache
def flown(seed: int, effects: bool = False) -> Flight:
    hidden = {"rotor_drag": {"k_x": 0.4, "k_y": 0.4}} if effects else {}
    return fly(PELICAN, seconds=45.0, seed=seed, random=RANDOM, effects=hidden, extras=("velocity",))


@lru_cache
def forecast(seed: int, random: RandomForces | None, effects: bool = False) -> Forecast:
    flight = flown(seed, effects)
    truth = flight.truth.parameters.as_dict()
    values = {n: ParameterPrior(initial=truth[n]) for n in NOMINAL_NAMES}
    file = PELICAN.model_copy(update={"parameters": values, "effects": dict(flight.truth.effects)})
    return Forecast([flight.window], file, Layout(file).initial(file), random)


def together(found: list[Shares], h: int, quantity: str) -> np.ndarray:
    return np.asarray(sum(one[h][quantity] for one in found))


def check(counts: np.ndarray, alike: int, errors: float = 4.0) -> None:
    """Every share within `errors` binomial standard errors of its band, one in `alike` outcomes being independent."""
    for inside, band in zip(counts[:-1], BANDS, strict=True):
        p, n = 0.01 * float(band), counts[-1] / alike
        assert abs(inside / counts[-1] - p) < errors * np.sqrt(p * (1.0 - p) / n), (band, inside / counts[-1])


@pytest.mark.parametrize("random", [RANDOM, None], ids=["of the file", "found"])
def test_bands_hold_their_share_under_random_forces(random: RandomForces | None) -> None:
    found = [forecast(seed, random).covered([1, 5]) for seed in SEEDS]
    for h in (1, 5):
        for quantity in QUANTITIES:
            counts = together(found, h, quantity)
            assert counts[-1] > 1000
            check(counts, PHASES)


def test_with_effects_in_the_file_too() -> None:
    found = [forecast(seed, RANDOM, True).covered([5]) for seed in SEEDS]
    for quantity in QUANTITIES:
        check(together(found, 5, quantity), PHASES)


def test_a_file_that_knows_of_no_random_forces_promises_too_much() -> None:
    none = {name: RandomInput(sigma=0.0, time=0.5) for name in RandomForces.model_fields}
    counts = forecast(1, RandomForces(**none)).covered([5])[5]["rate"]
    assert counts[2] / counts[-1] < 0.8


def test_half_a_second_ahead_with_the_autopilot_in_the_loop() -> None:
    found = []
    for seed in SEEDS:
        autopilot = Autopilot(flown(seed).gains, None, "given", ())
        found.append(forecast(seed, RANDOM).covered_in_loop([5, 25], autopilot, seed))
    for h in (5, 25):
        for quantity in QUANTITIES:
            check(together(found, h, quantity), 3 if h == 25 else 1, 3.5)


def test_too_short_a_flight_is_refused() -> None:
    flight = flown(1)
    with pytest.raises(NotIdentifiableError, match="3 s with gyro"):
        Forecast([flight.window.slice(0, 125)], PELICAN, Layout(PELICAN).initial(PELICAN), None)
