"""Physics of the flown airframe: power balance, work of the gyroscopic torque, frame invariance, convergence order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quadid.flight import TruthParameters, fly
from quadid.flight.airframe import STATES, Oddity, derivative, orthonormalise, rotor_wrench
from quadid.flight.rotors import advance
from quadid.flight.setup import Effects, Setup, prepare
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

PELICAN = Vehicle.shipped("pelican")


def setup_of(vehicle: Vehicle = PELICAN, effects: Effects | None = None, truth: TruthParameters | None = None) -> Setup:
    """Constants of a vehicle without noise."""
    n = len(vehicle.rotors)
    truth = truth or TruthParameters.of(vehicle)
    return prepare(vehicle, truth, effects or {}, 100.0, 0.0, (0.0, 0.0), np.zeros((6, n, 2)))


def state(rotation: Rotation, velocity: FloatArray, rates: FloatArray, height: float = 50.0) -> FloatArray:
    """State vector of the airframe."""
    y = np.zeros(STATES)
    y[2] = -height
    y[3:6], y[6:15], y[15:18] = velocity, rotation.as_matrix().ravel(), rates
    return y


def slope(setup: Setup, y: FloatArray, omega: FloatArray) -> FloatArray:
    """Derivative of the state at given rotor speeds."""
    wrench, dy = np.zeros(7), np.zeros(STATES)
    rotor_wrench(omega, setup.efficiency, 0, setup.body, wrench)
    derivative(y, omega, wrench, 1.0, 1.0, 0, np.zeros(9), setup.body, setup.air, setup.odd, dy)
    return dy


def step(setup: Setup, y: FloatArray, omega: FloatArray, h: float, steps: int) -> FloatArray:
    """Flies with constant rotor speeds."""
    y, speed = y.copy(), omega.copy()
    level, still, work = omega.copy(), np.zeros(len(omega)), np.zeros((5, STATES))
    for _ in range(steps):
        advance(
            y, speed, level, still, setup.efficiency, np.ones(3), 1.0, 0, np.zeros(9),
            setup.drive, setup.body, setup.air, setup.odd, h, work,
        )  # fmt: skip
    return y


def energy(setup: Setup, y: FloatArray) -> float:
    """Kinetic and potential energy [J]."""
    m, nu, v = setup.body.mass, y[15:18], y[3:6]
    return float(0.5 * m * v @ v + 0.5 * nu @ setup.body.inertia[0] @ nu - m * GRAVITY * y[2])


vectors = st.tuples(*(st.floats(-3.0, 3.0) for _ in range(3))).map(np.array)
speeds = st.tuples(*(st.floats(100.0, 700.0) for _ in range(4))).map(np.array)
PRODUCTS = {"product_of_inertia": {"J_xy": 1e-3, "J_xz": -1.5e-3, "J_yz": 8e-4}}


@settings(max_examples=50)
@given(vectors, vectors, vectors, speeds)
def test_power_balance(turn: FloatArray, velocity: FloatArray, rates: FloatArray, omega: FloatArray) -> None:
    """Energy changes by thrust times speed plus torque times rate, and by nothing else."""
    setup = setup_of(effects=PRODUCTS)
    y = state(Rotation.from_rotvec(turn), velocity, rates)
    dy = slope(setup, y, omega)
    m, inertia = setup.body.mass, setup.body.inertia[0]
    power = m * y[3:6] @ dy[3:6] + y[15:18] @ inertia @ dy[15:18] - m * GRAVITY * dy[2]
    wrench = np.zeros(7)
    rotor_wrench(omega, setup.efficiency, 0, setup.body, wrench)
    pull = Rotation.from_rotvec(turn).apply([0.0, 0.0, -wrench[1]])
    assert power == pytest.approx(pull @ velocity + wrench[2:5] @ rates, rel=1e-9, abs=1e-8)


@settings(max_examples=50)
@given(vectors, speeds)
def test_gyroscopic_torque_does_no_work(rates: FloatArray, omega: FloatArray) -> None:
    with_rotor = setup_of(truth=TruthParameters(J_r=5e-3), effects=PRODUCTS)
    without = setup_of(truth=TruthParameters(J_r=1e-30), effects=PRODUCTS)
    y = state(Rotation.identity(), np.zeros(3), rates)
    change = slope(with_rotor, y, omega)[15:18] - slope(without, y, omega)[15:18]
    torque = with_rotor.body.inertia[0] @ change
    spin = float(PELICAN.spins @ omega)
    np.testing.assert_allclose(torque, 5e-3 * spin * np.array([rates[1], -rates[0], 0.0]), atol=1e-12)
    assert abs(torque @ rates) < 1e-12 * (1.0 + abs(spin) * float(rates @ rates))


def test_energy_is_conserved_in_free_fall() -> None:
    setup = setup_of(effects=PRODUCTS)
    y = state(Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([2.0, -1.0, 0.5]), np.array([2.0, 3.0, -1.0]))
    after = step(setup, y, np.zeros(4), 1e-3, 2000)
    assert energy(setup, after) == pytest.approx(energy(setup, y), rel=1e-11)
    momentum = [Rotation.from_matrix(s[6:15].reshape(3, 3)).apply(setup.body.inertia[0] @ s[15:18]) for s in (y, after)]
    np.testing.assert_allclose(momentum[1], momentum[0], rtol=1e-9)


def test_rotation_stays_a_rotation() -> None:
    setup = setup_of()
    y = state(Rotation.identity(), np.zeros(3), np.array([5.0, -4.0, 3.0]))
    after = step(setup, y, np.full(4, 370.0), 1e-3, 5000)[6:15].reshape(3, 3)
    np.testing.assert_allclose(after.T @ after, np.eye(3), atol=1e-14)
    bent = np.eye(3).ravel() + 1e-4 * np.arange(9.0)
    orthonormalise(bent, 0)
    m = bent.reshape(3, 3)
    np.testing.assert_allclose(m.T @ m, np.eye(3), atol=5e-6)


def test_runge_kutta_is_of_fourth_order() -> None:
    setup = setup_of(effects={**PRODUCTS, "rotor_drag": {"k_x": 0.3, "k_y": 0.3}, "parasitic_drag": {"c": 0.05}})
    y = state(Rotation.from_rotvec([0.1, 0.2, 0.3]), np.array([4.0, -3.0, 1.0]), np.array([1.0, 2.0, -1.5]))
    omega = np.array([380.0, 360.0, 350.0, 375.0])
    runs = [step(setup, y, omega, 0.4 / n, n) for n in (10, 20, 40, 640)]
    errors = [float(np.linalg.norm((run - runs[3])[:18])) for run in runs[:3]]
    orders = np.log2(np.array(errors[:2]) / np.array(errors[1:]))
    assert np.all((orders > 3.6) & (orders < 5.2)), orders


@pytest.mark.parametrize("name", ["pelican", "pelican_x", "hexacopter", "hummingbird", "crazyflie_brushless"])
def test_hover_is_an_equilibrium(name: str) -> None:
    vehicle = Vehicle.shipped(name)
    setup, n = setup_of(vehicle), len(vehicle.rotors)
    hover = TruthParameters.of(vehicle).hover_speed(n)
    dy = slope(setup, state(Rotation.identity(), np.zeros(3), np.zeros(3)), np.full(n, hover))
    np.testing.assert_allclose(dy[3:6], 0.0, atol=1e-12)
    np.testing.assert_allclose(dy[15:18], 0.0, atol=1e-2 if name == "hexacopter" else 1e-10)
    np.testing.assert_allclose(dy[18:21], [0.0, 0.0, -GRAVITY], atol=1e-12)


def test_heading_does_not_matter() -> None:
    """Turning the world about the vertical turns the motion and changes nothing seen on board."""
    setup = setup_of(effects={"rotor_drag": {"k_x": 0.3, "k_y": 0.1}})
    turn = Rotation.from_rotvec([0.0, 0.0, 0.8])
    start, velocity = Rotation.from_rotvec([0.2, -0.1, 0.3]), np.array([2.0, 1.0, 0.5])
    omega, rates = np.array([380.0, 360.0, 350.0, 375.0]), np.array([0.5, -0.3, 0.2])
    one = step(setup, state(start, velocity, rates), omega, 1e-3, 500)
    two = step(setup, state(turn * start, turn.apply(velocity), rates), omega, 1e-3, 500)
    np.testing.assert_allclose(two[15:21], one[15:21], atol=1e-12)
    np.testing.assert_allclose(two[3:6], turn.apply(one[3:6]), atol=1e-11)


def test_numbering_of_rotors_and_frame_does_not_matter() -> None:
    """A quarter turn of the body frame with rotors renamed and J_xx, J_yy swapped is the same vehicle."""
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # new axes seen from the old
    truth, order = TruthParameters(), [2, 0, 3, 1]
    data = PELICAN.model_dump()
    rotors = [data["rotors"][i] for i in order]
    data["rotors"] = [{"position": tuple(quarter.T @ np.array(r["position"])), "spin": r["spin"]} for r in rotors]
    turned = Vehicle.model_validate(data)
    swapped = TruthParameters(J_xx=truth.J_yy, J_yy=truth.J_xx)
    omega, rates = np.array([380.0, 360.0, 350.0, 375.0]), np.array([0.5, -0.3, 0.2])
    start = Rotation.from_rotvec([0.2, -0.1, 0.3])
    one = step(setup_of(), state(start, np.zeros(3), rates), omega, 1e-3, 300)
    other = state(start * Rotation.from_matrix(quarter), np.zeros(3), quarter.T @ rates)
    two = step(setup_of(turned, truth=swapped), other, omega[order], 1e-3, 300)
    np.testing.assert_allclose(two[:6], one[:6], atol=1e-11)
    np.testing.assert_allclose(quarter @ two[15:18], one[15:18], atol=1e-11)


def test_roll_pitch_yaw_signs_of_the_paper() -> None:
    """Eq. (6): tau_phi = l b (w4^2 - w2^2), tau_theta = l b (w3^2 - w1^2), tau_psi = d (-w1^2 + w2^2 - w3^2 + w4^2)."""
    setup, truth = setup_of(), TruthParameters()
    w = np.array([300.0, 320.0, 350.0, 390.0])
    wrench = np.zeros(7)
    rotor_wrench(w, setup.efficiency, 0, setup.body, wrench)
    s = w**2
    expected = [0.21 * truth.b * (s[3] - s[1]), 0.21 * truth.b * (s[2] - s[0]), truth.d * (-s[0] + s[1] - s[2] + s[3])]
    np.testing.assert_allclose(wrench[2:5], expected, rtol=1e-12)
    assert wrench[5] == pytest.approx(-w[0] + w[1] - w[2] + w[3])
    assert wrench[1] == pytest.approx(truth.b * s.sum())


def test_flexible_arm_and_load_rest_in_hover() -> None:
    """Outside dynamics add no force where nothing moves."""
    setup = setup_of()
    setup.odd = Oddity(dynamic=True, load_share=0.1, load_length=1.0, slosh_share=0.1, slosh_speed=6.0)
    omega = np.full(4, TruthParameters().hover_speed(4))
    after = step(setup, state(Rotation.identity(), np.zeros(3), np.zeros(3)), omega, 1e-3, 1000)
    np.testing.assert_allclose(after[3:6], 0.0, atol=1e-9)
    np.testing.assert_allclose(after[15:18], 0.0, atol=1e-9)


def test_a_flight_ends_where_its_velocity_leads() -> None:
    flight = fly(PELICAN, seconds=20.0, seed=2, log_rate=500.0, noise_scale=0.0)
    truth = flight.truth
    moved = np.trapezoid(truth.velocity, truth.t, axis=0)
    np.testing.assert_allclose(truth.position[-1] - truth.position[0], moved, atol=1e-4)
