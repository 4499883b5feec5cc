"""Whole flights: determinism, clocks, individuals, bounds; the vehicle stepped from outside; machine code on disk."""

import hashlib
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadid.attitude_controller
import quadid.flight
import quadid.rotation
from quadid.data.window import CHANNELS
from quadid.effects import EFFECTS
from quadid.errors import ParameterError
from quadid.flight import (
    OUTSIDE,
    Flight,
    FlightError,
    SteppedFlight,
    TruthParameters,
    default_gains,
    draw_effect,
    draw_outside,
    draw_truth,
    fly,
)
from quadid.flight.airframe import derivative
from quadid.flight.fly import march
from quadid.flight.outside import ARRANGE, DISTORT
from quadid.flight.setup import SIZES
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import GRAVITY, Vehicle

# --- Whole flights: determinism, clocks, individuals, and 500 s within bounds whatever is hidden in the vehicle


VEHICLES = ["pelican", "pelican_x", "hexacopter", "hummingbird", "crazyflie_brushless"]
PELICAN = Vehicle.shipped("pelican")


def check_bounds(flight: Flight) -> None:
    """Fails unless the flight stayed where a pilot would keep it."""
    truth = flight.truth
    down = 1.0 - 2.0 * (truth.quaternion[:, 1] ** 2 + truth.quaternion[:, 2] ** 2)
    assert down.min() > np.cos(1.1)
    assert np.abs(truth.velocity).max() < 15.0
    assert np.abs(truth.position[:, :2]).max() < 100.0
    assert truth.position[:, 2].max() < 0.0
    assert np.isfinite(flight.window.rotor_speed).all()


def test_seed_decides_every_bit() -> None:
    one, two, other = (fly(PELICAN, seconds=5.0, seed=s) for s in (3, 3, 4))
    for name in CHANNELS:
        a, b = getattr(one.window, name, None), getattr(two.window, name, None)
        assert (a is None) == (b is None)
        assert a is None or b is None or np.array_equal(a, b)
    assert not np.array_equal(one.window.rotor_speed, other.window.rotor_speed)


def test_a_longer_flight_starts_the_same() -> None:
    short, long = fly(PELICAN, seconds=5.0, seed=3), fly(PELICAN, seconds=8.0, seed=3)
    np.testing.assert_array_equal(long.window.rotor_speed[:250], short.window.rotor_speed)
    assert short.window.gyro is not None
    assert long.window.gyro is not None
    np.testing.assert_array_equal(long.window.gyro[:250], short.window.gyro)


@pytest.mark.parametrize("rate", [50.0, 100.0, 200.0, 250.0, 500.0])
def test_log_rates(rate: float) -> None:
    flight = fly(PELICAN, seconds=3.0, seed=1, log_rate=rate)
    assert len(flight.window) == 3 * rate
    assert flight.window.dt == pytest.approx(1.0 / rate, rel=1e-12)
    assert flight.recording.grid == flight.window.dt
    assert flight.recording.format == "simulated"
    np.testing.assert_allclose(flight.recording.channels["gyro"].t, flight.window.t)


def test_impossible_orders_are_refused() -> None:
    with pytest.raises(ParameterError, match="Hz"):
        fly(PELICAN, seconds=3.0, log_rate=7.0, command_rate=13.0)
    with pytest.raises(ParameterError, match="two log rows"):
        fly(PELICAN, seconds=0.0)
    with pytest.raises(ParameterError, match="spread"):
        draw_truth(PELICAN, 1, spread=1.5)
    with pytest.raises(ParameterError, match="positive"):
        TruthParameters(b=-1.0)
    weak = {**default_gains(PELICAN), "roll_rate_p": -0.1}
    with pytest.raises(FlightError, match="crashed"):
        fly(PELICAN, seconds=10.0, gains=weak)


def test_individuals_are_like_their_type() -> None:
    assert TruthParameters.of(PELICAN).as_dict() == {
        "b": 2.33e-5,
        "d": 4.96e-7,
        "J_xx": 1.00e-2,
        "J_yy": 1.36e-2,
        "J_zz": 2.92e-2,
        "J_r": 5.00e-5,
    }
    for name in VEHICLES:
        vehicle = Vehicle.shipped(name)
        base = TruthParameters.of(vehicle).as_dict()
        draws = [draw_truth(vehicle, seed).as_dict() for seed in range(200)]
        for parameter in NOMINAL_NAMES:
            ratio = np.array([d[parameter] for d in draws]) / base[parameter]
            assert 0.85 <= ratio.min() < 0.87
            assert 1.13 < ratio.max() <= 1.15
        assert draw_truth(vehicle, 5) == draw_truth(vehicle, 5) != draw_truth(vehicle, 6)
        assert draw_truth(vehicle, 5).mass == vehicle.mass


@pytest.mark.parametrize("name", VEHICLES)
def test_five_hundred_seconds_stay_in_the_box(name: str) -> None:
    vehicle = Vehicle.shipped(name)
    flight = fly(vehicle, draw_truth(vehicle, 1), 500.0, 1)
    check_bounds(flight)
    assert np.all(flight.truth.velocity.std(axis=0)[:2] < 4.0)
    assert np.all(flight.truth.rates.std(axis=0) > 0.2)


@pytest.mark.parametrize("name", VEHICLES)
def test_the_stabiliser_copes_with_every_effect(name: str) -> None:
    vehicle = Vehicle.shipped(name)
    for index, effect in enumerate(SIZES):
        seed = index + 1
        drawn = draw_effect(effect, seed, 1.0, vehicle, 12.0)
        check_bounds(fly(vehicle, draw_truth(vehicle, seed), 12.0, seed, effects=drawn))


@pytest.mark.parametrize("effect", ["motor_lag", "command_delay", "weak_rotor", "ahrs_acceleration_error", "gyro_bias"])
def test_hard_effects_over_five_hundred_seconds(effect: str) -> None:
    check_bounds(fly(PELICAN, draw_truth(PELICAN, 2), 500.0, 2, effects=draw_effect(effect, 2)))


@pytest.mark.parametrize("name", list(OUTSIDE))
def test_outside_effects(name: str) -> None:
    """Each is drawn within its range, repeatable, flies, and shows in the log."""
    values = draw_outside(name, 2)
    assert values == draw_outside(name, 2) != draw_outside(name, 3)
    assert [act.__name__ for act in (*ARRANGE, *DISTORT)].count(name) == 1
    for key, size in OUTSIDE[name].items():
        assert size.low <= values[key] <= size.high
        scaled = draw_outside(name, 2, scale=0.5)[key]
        assert scaled == pytest.approx(values[key] * (0.5 if size.scales else 1.0))
    plain = fly(PELICAN, seconds=20.0, seed=2)
    odd, again = (fly(PELICAN, seconds=20.0, seed=2, outside={name: values}) for _ in range(2))
    check_bounds(odd)
    columns = ("gyro", "accel", "attitude", "rotor_speed")
    assert all(np.array_equal(getattr(odd.window, c), getattr(again.window, c)) for c in columns)
    assert not all(np.array_equal(getattr(odd.window, c), getattr(plain.window, c)) for c in columns)
    assert odd.truth.outside == {name: values}


def test_outside_effects_are_many_and_none_is_one_of_the_catalogue() -> None:
    assert len(OUTSIDE) >= 10
    assert not set(OUTSIDE) & set(EFFECTS)
    with pytest.raises(ParameterError, match="gusts"):
        draw_outside("gust", 1)
    with pytest.raises(ParameterError, match="push"):
        fly(PELICAN, seconds=2.0, outside={"gusts": {"push": 1.0}})


# --- The flown vehicle stepped from outside flies as `fly` does, from the same commands


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


# --- Machine code on disk is dropped when any source of the room changes, not only the kernel's own file


def test_stamp_of_every_kernel_covers_all_sources() -> None:
    digest = hashlib.sha256(repr(GRAVITY).encode())
    for module in (quadid.attitude_controller, quadid.rotation):
        digest.update(Path(str(module.__file__)).read_bytes())
    for file in sorted(Path(quadid.flight.__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    for kernel in (march, derivative):
        # numba's own names: a numba that renames them must fail here and not fly stale physics
        index = cast(Any, kernel)._cache._cache_file
        assert str(index._source_stamp).endswith(digest.hexdigest())
        assert index._load_index() == {} or index._source_stamp
