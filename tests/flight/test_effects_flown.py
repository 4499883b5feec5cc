"""Every catalogue effect as flown: neutral changes nothing, sizes as the contract says, signs as expected."""

import numpy as np
import pytest
from scipy.signal import butter, lsim
from scipy.spatial.transform import Rotation, Slerp

from quadid.effects import EFFECTS
from quadid.errors import ParameterError
from quadid.flight import Flight, check_effects, draw_effect, fly
from quadid.flight.setup import SIZES, Effects
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from tests.flight.test_airframe import PELICAN, setup_of, slope, state

HOVER = setup_of().truth.hover_speed(4)
LEVEL = Rotation.identity()


def same(a: Flight, b: Flight) -> bool:
    """True when two logs agree bit for bit."""
    logged = ("gyro", "accel", "attitude", "velocity", "rotor_speed")
    return all(np.array_equal(getattr(a.window, n), getattr(b.window, n)) for n in logged)


def acceleration(effects: Effects, velocity: FloatArray | None = None, rates: FloatArray | None = None) -> FloatArray:
    """Specific force (0:3) and angular acceleration (3:6) of a level Pelican at hover speeds, effect on minus off."""
    zero = np.zeros(3)
    y = state(LEVEL, zero if velocity is None else velocity, zero if rates is None else rates)
    on, off = (slope(setup_of(effects=e), y, np.full(4, HOVER)) for e in (effects, {}))
    return np.concatenate([(on - off)[3:6], (on - off)[15:18]])


@pytest.fixture(scope="module")
def nominal() -> Flight:
    return fly(PELICAN, seconds=10.0, seed=5, extras=("velocity",))


@pytest.fixture(scope="module")
def quiet() -> Flight:
    return fly(PELICAN, seconds=10.0, seed=5, noise_scale=0.0)


@pytest.mark.parametrize("name", list(EFFECTS))
def test_neutral_changes_nothing_and_a_realistic_size_does(name: str, nominal: Flight) -> None:
    neutral = {p.name: p.neutral for p in EFFECTS[name].parameters}
    logged = ("velocity",)
    assert same(fly(PELICAN, seconds=10.0, seed=5, effects={name: neutral}, altitude=30.0, extras=logged), nominal)
    drawn = draw_effect(name, 1, seconds=10.0)
    assert name in drawn
    assert not same(fly(PELICAN, seconds=10.0, seed=5, effects=drawn, altitude=None, extras=logged), nominal)


def test_every_effect_of_the_catalogue_can_be_drawn() -> None:
    assert set(SIZES) == set(EFFECTS)
    for name in SIZES:
        assert {p.name for p in EFFECTS[name].parameters if not p.optional} == set(draw_effect(name, 0)[name])
        assert draw_effect(name, 4) == draw_effect(name, 4) != draw_effect(name, 5)
        for vehicle in map(Vehicle.shipped, ("pelican", "hexacopter", "crazyflie_brushless")):
            check_effects(draw_effect(name, 2, 1.0, vehicle), len(vehicle.rotors))
    small, large = (draw_effect("motor_lag", 3, scale)["motor_lag"]["tau"] for scale in (0.1, 1.0))
    assert small == pytest.approx(0.1 * large)


def test_wrong_effects_are_named() -> None:
    with pytest.raises(ParameterError, match="motor_lag"):
        check_effects({"motorlag": {"tau": 0.1}}, 4)
    with pytest.raises(ParameterError, match="tau"):
        check_effects({"motor_lag": {"taw": 0.1}}, 4)
    with pytest.raises(ParameterError, match="1 to 4"):
        check_effects({"weak_rotor": {"rotor": 5.0, "loss": 0.1}}, 4)
    with pytest.raises(ParameterError, match="weak_rotor.loss_2 = 0.9; allowed: -0.6 to 0.6"):
        check_effects({"weak_rotor": {"loss_2": 0.9}}, 4)
    with pytest.raises(ParameterError, match="0 to 0.3"):
        check_effects({"motor_lag": {"tau": 3.0}}, 4)


def test_weak_rotor_one_of_the_pelican_is_the_rear_one() -> None:
    """The tail drops (nose up), and the vehicle turns to the right, since rotor 1 pushed it to the left."""
    p = setup_of().truth
    got = acceleration({"weak_rotor": {"rotor": 1.0, "loss": 0.1}})
    lost = 0.1 * p.b * HOVER**2
    np.testing.assert_allclose(got[2], lost / p.mass, rtol=1e-12)
    np.testing.assert_allclose(got[3:], [0.0, 0.21 * lost / p.J_yy, 0.1 * p.d * HOVER**2 / p.J_zz], atol=1e-9)


def test_cg_ahead_of_the_centre_drops_the_nose() -> None:
    p = setup_of().truth
    got = acceleration({"cg_offset": {"x": 0.01, "y": 0.005}})
    weight = p.mass * GRAVITY
    np.testing.assert_allclose(got[3:], [0.005 * weight / p.J_xx, -0.01 * weight / p.J_yy, 0.0], atol=1e-9)


def test_product_of_inertia_has_the_negative_in_the_tensor() -> None:
    tensor = setup_of(effects={"product_of_inertia": {"J_xy": 1e-3, "J_yz": 5e-4}}).body.inertia[0]
    assert tensor[0, 1] == tensor[1, 0] == -1e-3
    assert tensor[1, 2] == -5e-4
    with pytest.raises(ParameterError, match="indefinite"):
        setup_of(effects={"product_of_inertia": {"J_xy": 9e-3, "J_xz": 9e-3, "J_yz": 9e-3}})


def accel_z(flight: Flight) -> tuple[FloatArray, FloatArray]:
    """Specific force along z, and what nominal thrust would give at the mean of both commands around the row."""
    w, p = flight.window, flight.truth.parameters
    assert w.accel is not None
    pull = -p.b * (w.rotor_speed**2).sum(axis=1) / p.mass
    return w.accel[1:, 2], 0.5 * (pull[1:] + pull[:-1])


@pytest.mark.parametrize(
    ("name", "after"), [("mass_change", 1.0 / 1.2), ("thrust_drop", 0.8)], ids=["mass_change", "thrust_drop"]
)
def test_changes_happen_at_their_time(name: str, after: float) -> None:
    flight = fly(PELICAN, seconds=10.0, seed=5, noise_scale=0.0, effects={name: {"time": 5.0, "fraction": 0.2}})
    measured, nominal = accel_z(flight)
    ratio = measured / nominal
    np.testing.assert_allclose(ratio[: 5 * 50 - 2], 1.0, rtol=1e-9)
    np.testing.assert_allclose(ratio[5 * 50 + 1 :], after, rtol=1e-9)


def test_battery_sags_from_first_to_last_sample() -> None:
    flight = fly(PELICAN, seconds=10.0, seed=5, noise_scale=0.0, effects={"battery_sag": {"fraction": 0.1}})
    measured, nominal = accel_z(flight)
    t = flight.window.t[1:]
    np.testing.assert_allclose(measured / nominal, 1.0 - 0.1 * t / t[-1], atol=3e-4)


def test_command_delay_may_be_any_fraction_of_a_sample() -> None:
    delay, flight = (
        0.0263,
        fly(PELICAN, seconds=10.0, seed=5, noise_scale=0.0, effects={"command_delay": {"delay": 0.0263}}),
    )
    w, p = flight.window, flight.truth.parameters
    assert w.accel is not None
    pull = -p.b * (w.rotor_speed**2).sum(axis=1) / p.mass
    # the centred sample covers [t - 10, t + 10] ms: commands k - 2 until t - 20 + 26.3 ms, then k - 1
    share = (0.02 - 0.01 + delay - 0.02) / 0.02
    k = np.arange(2, len(pull))
    np.testing.assert_allclose(w.accel[k, 2], share * pull[k - 2] + (1 - share) * pull[k - 1], rtol=1e-9)


def test_motor_lag_is_first_order() -> None:
    flight = fly(PELICAN, seconds=10.0, seed=5, noise_scale=0.0, effects={"motor_lag": {"tau": 0.04}})
    real, wanted = flight.truth.rotor_speed, flight.window.rotor_speed
    np.testing.assert_allclose(real[1:], wanted[:-1] + (real[:-1] - wanted[:-1]) * np.exp(-0.02 / 0.04), rtol=1e-10)


def test_imu_lag_is_a_second_order_butterworth() -> None:
    flight = fly(PELICAN, seconds=6.0, seed=5, noise_scale=0.0, log_rate=500.0, effects={"imu_lag": {"cutoff": 6.0}})
    b, a = butter(2, 2 * np.pi * 6.0, analog=True)
    gyro, truth = flight.window.gyro, flight.truth
    assert gyro is not None
    _, late, _ = lsim((b, a), truth.rates[:, 0], truth.t)
    np.testing.assert_allclose(gyro[1000:, 0], late[1000:], atol=2e-4)
    assert np.std(gyro[1000:, 0] - truth.rates[1000:, 0]) > 0.05


def test_attitude_delay() -> None:
    flight = fly(
        PELICAN, seconds=6.0, seed=5, noise_scale=0.0, log_rate=500.0, effects={"attitude_delay": {"delay": 0.037}}
    )
    truth, q = flight.truth, flight.window.attitude
    assert q is not None
    path = Slerp(truth.t, Rotation.from_quat(truth.quaternion[:, [1, 2, 3, 0]]))
    late = path(truth.t[100:] - 0.037)
    error = (late.inv() * Rotation.from_quat(q[100:, [1, 2, 3, 0]])).magnitude()
    assert error.max() < 1e-5


def test_bias_scale_and_misalignment_of_the_imu() -> None:
    effects = {
        "gyro_bias": {"x": 0.02, "y": -0.01, "z": 0.03},
        "gyro_scale": {"x": 0.03, "y": -0.02, "z": 0.05},
        "imu_misalignment": {"x": 0.03, "y": -0.05, "z": 0.04},
        "accel_bias": {"x": 0.2, "y": -0.3, "z": 0.1},
    }
    flight = fly(PELICAN, seconds=10.0, seed=5, noise_scale=0.0, effects=effects)
    turn = Rotation.from_rotvec([0.03, -0.05, 0.04])
    w = flight.window
    assert w.gyro is not None
    assert w.accel is not None
    expected = turn.apply(flight.truth.rates) * [1.03, 0.98, 1.05] + [0.02, -0.01, 0.03]
    np.testing.assert_allclose(w.gyro, expected, atol=1e-12)
    _, nominal = accel_z(flight)
    force = turn.apply(np.column_stack([0 * nominal, 0 * nominal, nominal])) + [0.2, -0.3, 0.1]
    np.testing.assert_allclose(w.accel[1:], force, atol=1e-9)


def test_scale_of_the_logged_velocity() -> None:
    effects = {"velocity_scale": {"horizontal": 0.1, "vertical": -0.05}}
    flight = fly(PELICAN, seconds=10.0, seed=5, noise_scale=0.0, effects=effects, extras=("velocity", "position"))
    assert flight.window.velocity is not None
    np.testing.assert_allclose(flight.window.velocity, flight.truth.velocity * [1.1, 1.1, 0.95], atol=1e-12)
    np.testing.assert_array_equal(flight.window.position, flight.truth.position)


def test_misaligned_imu_at_rest_sees_gravity_turned() -> None:
    """Rotation body to sensor about x: gravity's reaction (0, 0, -g) shows as +y for a positive angle."""
    flight = fly(PELICAN, None, 5.0, 1, "hover", noise_scale=0.0, effects={"imu_misalignment": {"x": 0.05}})
    assert flight.window.accel is not None
    assert flight.window.accel[:, 1].mean() == pytest.approx(GRAVITY * np.sin(0.05), rel=1e-2)


def test_imu_ahead_of_the_centre_feels_the_turn() -> None:
    """a = nu' x l + nu x (nu x l): at x = l, yaw rate r gives -l r^2 along x and l r' along y."""
    effects = {"imu_lever_arm": {"x": 0.08}}
    flight = fly(PELICAN, seconds=10.0, seed=5, noise_scale=0.0, effects=effects, log_rate=500.0)
    truth, accel = flight.truth, flight.window.accel
    assert accel is not None
    q, r = truth.rates[:, 1], truth.rates[:, 2]
    p = truth.rates[:, 0]
    np.testing.assert_allclose(accel[:, 0], -0.08 * (q**2 + r**2), atol=0.02)
    spin = np.gradient(r, truth.t)
    np.testing.assert_allclose(accel[1:-1, 1], 0.08 * (spin + p * q)[1:-1], atol=0.02)


def test_attitude_filter_is_pulled_by_the_accelerometer() -> None:
    """q_hat: propagated with the true rate, tilt pulled with gain k to where the accelerometer sees down."""
    flight = fly(
        PELICAN, seconds=8.0, seed=5, noise_scale=0.0, log_rate=500.0, effects={"ahrs_acceleration_error": {"k": 0.4}}
    )
    truth, accel, seen = flight.truth, flight.window.accel, flight.window.attitude
    assert accel is not None
    assert seen is not None
    real = Rotation.from_quat(truth.quaternion[:, [1, 2, 3, 0]])
    logged = Rotation.from_quat(seen[:, [1, 2, 3, 0]])
    estimate = logged[0]
    for k in range(1, len(truth.t)):
        down = -accel[k - 1] / np.linalg.norm(accel[k - 1])
        pull = 0.4 * np.cross(down, estimate.inv().apply([0.0, 0.0, 1.0]))
        estimate = estimate * Rotation.from_rotvec(pull * 0.002) * (real[k - 1].inv() * real[k])
    assert (estimate.inv() * logged[-1]).magnitude() < 2e-3
    assert (real.inv() * logged).magnitude().max() > 0.02


def test_near_the_ground_thrust_rises() -> None:
    effects = {"ground_effect": {"radius_scale": 2.0}}
    ratios = []
    for altitude in (0.6, 1.5):
        flight = fly(PELICAN, None, 10.0, 1, "gentle", noise_scale=0.0, effects=effects, altitude=altitude)
        measured, nominal = accel_z(flight)
        height = -flight.truth.position[1:, 2]
        np.testing.assert_allclose(measured / nominal, 1 / (1 - (2.0 * 0.1485 / 4 / height) ** 2), rtol=2e-3)
        ratios.append(float((measured / nominal).mean()))
    assert ratios[0] > ratios[1] > 1.0
