"""Air at each hub: energy, symmetry, the damping that geometry gives, and frames."""

import numpy as np
import pytest

from quadid.flight.airframe import Air, hub_forces
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from tests.flight.test_airframe import setup_of, slope, state
from tests.model.simulate import held, simulate
from tests.model.simulate import state as model_state

AIR = {"rotor_drag.k_x": 0.3, "rotor_drag.k_y": 0.3, "axial_inflow.k_z": 0.5}
DT, STEPS = 0.005, 40


def rates_after(
    vehicle: Vehicle, effects: dict[str, float], rate: tuple[float, float, float], dt: float = DT
) -> FloatArray:
    """Rates after `STEPS` steps at hover speeds, the vehicle turning about itself in still air."""
    values = {n: p.initial for n, p in vehicle.parameters.items()} | {"J_r": 0.0} | effects
    rows = np.full((STEPS + 1, len(vehicle.rotors)), vehicle.hover_speed())
    flown = simulate(vehicle, values, held(rows, dt), model_state(rate=rate))
    return np.asarray(flown.rate[-1])


def higher(vehicle: Vehicle, height: float) -> Vehicle:
    """The same vehicle with its hubs `height` above the CG."""
    rotors = [r.model_copy(update={"position": (*r.position[:2], -height)}) for r in vehicle.rotors]
    return vehicle.model_copy(update={"rotors": tuple(rotors)})


@pytest.mark.parametrize("name", ["pelican", "hexacopter"])
def test_damping_is_what_the_hubs_give(name: str) -> None:
    """l_p = k_z (m / N) sum y^2 / J_xx and n_r = k (m / N) sum (x^2 + y^2) / J_zz, as any textbook has it."""
    vehicle = Vehicle.shipped(name)
    x, y, _ = vehicle.rotor_positions.T
    each, p = vehicle.mass / len(vehicle.rotors), vehicle.parameters
    l_p = 0.5 * each * np.sum(y**2) / p["J_xx"].initial
    n_r = 0.3 * each * np.sum(x**2 + y**2) / p["J_zz"].initial
    rolling = rates_after(vehicle, AIR, (0.1, 0.0, 0.0))[0]
    yawing = rates_after(vehicle, AIR, (0.0, 0.0, 0.1))[2]
    assert rolling == pytest.approx(0.1 * np.exp(-l_p * DT * STEPS), rel=5e-3)
    assert yawing == pytest.approx(0.1 * np.exp(-n_r * DT * STEPS), rel=5e-3)
    assert rolling < 0.095


def test_hubs_above_the_centre_of_gravity_damp_roll_by_their_drag() -> None:
    vehicle = higher(Vehicle.shipped("pelican"), 0.05)
    drag = {"rotor_drag.k_x": 0.3, "rotor_drag.k_y": 0.3}
    l_p = 0.3 * vehicle.mass * 0.05**2 / vehicle.parameters["J_xx"].initial
    dt = 1e-4  # so short that the tilt which comes of the roll brings no sideways speed to speak of
    after = rates_after(vehicle, drag, (0.1, 0.0, 0.0), dt)[0]
    assert 1.0 - after / 0.1 == pytest.approx(l_p * dt * STEPS, rel=0.01)


def test_air_takes_energy_and_never_gives_any() -> None:
    rng = np.random.default_rng(1)
    setup = setup_of(effects={"rotor_drag": {"k_x": 0.3, "k_y": 0.2}, "axial_inflow": {"k_z": 0.5}})
    for _ in range(200):
        v, nu = rng.normal(0.0, 3.0, 3), rng.normal(0.0, 3.0, 3)
        force = hub_forces(rng.uniform(100.0, 700.0, 4), tuple(v), tuple(nu), 0, setup.body, setup.air)
        assert np.dot(force[:3], v) + np.dot(force[3:], nu) <= 0.0


def test_in_a_wind_that_carries_it_along_a_vehicle_feels_no_air() -> None:
    from scipy.spatial.transform import Rotation

    effects = {"rotor_drag": {"k_x": 0.3, "k_y": 0.2}, "axial_inflow": {"k_z": 0.5}}
    with_wind = setup_of(effects={**effects, "wind": {"north": 3.0, "east": -2.0}})
    omega = np.array([350.0, 360.0, 370.0, 380.0])
    turned, still = Rotation.from_rotvec([0.2, -0.1, 0.7]), np.zeros(3)
    carried = slope(with_wind, state(turned, np.array([3.0, -2.0, 0.0]), still), omega)
    calm = slope(setup_of(effects=effects), state(turned, still, still), omega)
    np.testing.assert_allclose(carried[3:], calm[3:], atol=1e-12)


def test_a_hover_that_a_thrust_curve_slows_keeps_its_drag() -> None:
    """omega_h is where the curve carries the weight, so that k stays the drag of a hovering vehicle."""
    slow = setup_of(effects={"rotor_drag": {"k_x": 0.3, "k_y": 0.3}, "thrust_curve": {"dead_speed": -100.0}})
    hover = slow.air.hover_sum / 4.0
    assert isinstance(slow.air, Air)
    force = hub_forces(np.full(4, hover), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0, slow.body, slow.air)
    assert force[0] == pytest.approx(-0.3 * slow.body.mass)
    assert hover == pytest.approx(np.sqrt(slow.body.mass * GRAVITY / (4.0 * slow.body.b)) - 100.0)
