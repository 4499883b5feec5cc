"""Physics of the flown airframe: balances, symmetries, convergence, and a second set of equations by SciPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quadid.flight import Flight, TruthParameters, draw_truth, fly
from quadid.flight.airframe import STATES, Oddity, advance, derivative, orthonormalise, rotor_wrench
from quadid.flight.setup import Effects, Setup, prepare
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from tests.flight.second_opinion import SecondOpinion

# --- Physics of the flown airframe: power balance, work of the gyroscopic torque, frame invariance, convergence order


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


# --- The flown truth against a second set of equations integrated by SciPy's DOP853 at tight tolerance


EVERYTHING = {
    "motor_lag": {"tau": 0.031, "tau_down": 0.044},
    "command_delay": {"delay": 0.0137},
    "rotor_drag": {"k_x": 0.3, "k_y": 0.2, "central": 0.4},
    "parasitic_drag": {"c": 0.03, "c_z": 0.05},
    "translational_lift": {"k": 0.01},
    "rotor_drag_moment": {"h_x": 0.03, "h_y": -0.02},
    "rate_damping": {"l_p": 0.8, "m_q": 1.3, "n_r": 0.4},
    "axial_inflow": {"k_z": 0.3, "k_climb": 0.03, "central": 0.7},
    "wind": {"north": 2.0, "east": -1.5},
    "weak_rotor": {"rotor": 2.0, "loss": 0.08, "drag_loss": -0.05},
    "cg_offset": {"x": 0.006, "y": -0.004},
    "mass_change": {"time": 3.4567, "fraction": 0.15, "J_xx": 0.2, "J_yy": 0.1, "J_zz": 0.05, "x": 0.003, "y": -0.002},
    "drag_torque_curve": {"growth": 0.7},
    "no_gyroscopic_coupling": {"share": 0.6},
    "thrust_drop": {"time": 3.7321, "fraction": 0.06},
    "battery_sag": {"fraction": 0.1},
    "thrust_curve": {"dead_speed": 30.0, "offset": 0.1},
    "product_of_inertia": {"J_xy": 1e-3, "J_xz": -8e-4, "J_yz": 6e-4},
    "rotor_spin_up": {"J": 5e-5},
    "imu_lever_arm": {"x": 0.05, "y": -0.03, "z": 0.02},
}


def noise_free(name: str, effects: dict[str, dict[str, float]], seconds: float = 8.0, seed: int = 3) -> Flight:
    """A flight without noise of an individual of the type."""
    vehicle = Vehicle.shipped(name)
    return fly(vehicle, draw_truth(vehicle, seed), seconds, seed, effects=effects, noise_scale=0.0)


def check_states(flight: Flight, first: int, last: int) -> None:
    """Compares the truth at row `last` with DOP853 from row `first`."""
    opinion = SecondOpinion(flight)
    dt, truth = flight.window.dt, flight.truth
    state = opinion.fly(opinion.start(first), first * dt, last * dt)
    np.testing.assert_allclose(truth.position[last], state[0:3], rtol=0, atol=2e-8)
    np.testing.assert_allclose(truth.velocity[last], state[3:6], rtol=0, atol=2e-8)
    np.testing.assert_allclose(truth.rates[last], state[10:13], rtol=0, atol=2e-8)
    q = np.array([state[9], *state[6:9]])
    assert abs(abs(q @ truth.quaternion[last]) / np.linalg.norm(q) - 1.0) < 1e-14


@pytest.mark.parametrize("name", ["pelican", "pelican_x", "hexacopter", "hummingbird"])
def test_nominal_truth(name: str) -> None:
    check_states(noise_free(name, {}), 100, 130)


def test_everything_at_once() -> None:
    flight = noise_free("pelican", EVERYTHING)
    check_states(flight, 40, 60)
    check_states(flight, 165, 195)  # across both changes


def test_rotor_spin_up_of_jumping_rotors() -> None:
    check_states(noise_free("pelican", {"rotor_spin_up": {"J": 7e-5}, "product_of_inertia": {"J_xz": 1e-3}}), 50, 100)


def test_ground_effect() -> None:
    check_states(noise_free("pelican", {"ground_effect": {"radius_scale": 2.0}}), 50, 100)


@pytest.mark.parametrize("effects", [{}, EVERYTHING, {"rotor_spin_up": {"J": 7e-5}, "imu_lever_arm": {"y": 0.06}}])
def test_acceleration_is_the_mean_over_one_sample_centred_on_t(effects: dict[str, dict[str, float]]) -> None:
    flight = noise_free("pelican", effects)
    opinion, dt = SecondOpinion(flight), flight.window.dt
    assert flight.window.accel is not None
    for row in (60, 61, 200):
        begin = opinion.fly(opinion.start(row - 1), (row - 1) * dt, (row - 0.5) * dt)
        begin[-3:] = 0.0
        end = opinion.fly(begin, (row - 0.5) * dt, (row + 0.5) * dt)
        np.testing.assert_allclose(flight.window.accel[row], end[-3:] / dt, rtol=0, atol=1e-7)


def test_held_command_of_row_k_acts_from_t_k() -> None:
    """Thrust of the log's own row explains the specific force between rows, half each at a row."""
    flight = noise_free("pelican", {})
    w, p = flight.window, TruthParameters.of(flight.vehicle)
    p = flight.truth.parameters
    assert w.accel is not None
    pull = -p.b * (w.rotor_speed**2).sum(axis=1) / p.mass
    np.testing.assert_allclose(w.accel[1:, 2], 0.5 * (pull[1:] + pull[:-1]), rtol=1e-9)


def test_instant_readings_are_linear_in_between() -> None:
    """The Crazyflie's log holds readings: rotor speed runs straight from one to the next."""
    flight = noise_free("crazyflie_brushless", {})
    w, p = flight.window, flight.truth.parameters
    assert w.sampling == "instant"
    assert w.accel is not None
    np.testing.assert_allclose(w.rotor_speed, flight.truth.rotor_speed, rtol=1e-12)
    s = np.linspace(-0.5, 0.5, 2001)[:, None, None]
    before, here, after = w.rotor_speed[:-2], w.rotor_speed[1:-1], w.rotor_speed[2:]
    path = np.where(s < 0, here + (here - before) * s, here + (after - here) * s)
    thrust = np.trapezoid((path**2).sum(axis=2), s[:, 0, 0], axis=0)
    np.testing.assert_allclose(w.accel[1:-1, 2], -p.b * thrust / p.mass, rtol=1e-6)


def test_command_faster_than_the_log() -> None:
    """With commands at 1 kHz the log holds their mean over the sample."""
    vehicle = Vehicle.shipped("pelican")
    fast = fly(vehicle, seconds=4.0, seed=1, noise_scale=0.0, command_rate=1000.0)
    fine = fly(vehicle, seconds=4.0, seed=1, noise_scale=0.0, command_rate=1000.0, log_rate=500.0)
    np.testing.assert_allclose(
        fast.window.rotor_speed, fine.window.rotor_speed.reshape(200, 10, 4).mean(axis=1), rtol=1e-6
    )
