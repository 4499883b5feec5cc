"""The rollout against an independent writing of the paper's Eqs. 1-10 and of every effect, integrated by DOP853."""

import numpy as np
import pytest

from quadid.data.window import Sampling
from quadid.model.rollout import Rollout, Segments
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.model.flights import fly, lively_input, values_of, vector

DRAG = {"rotor_drag.k_x": 0.3, "rotor_drag.k_y": 0.2}
EFFECTS: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    # name: (what acts anyway, the effect)
    "motor_lag": ({}, {"motor_lag.tau": 0.04}),
    "command_delay": ({}, {"command_delay.delay": 0.027}),
    "command_delay of a lagging motor": ({"motor_lag.tau": 0.03}, {"command_delay.delay": 0.053}),
    "rotor_drag": ({}, DRAG),
    "parasitic_drag": ({}, {"parasitic_drag.c": 0.05}),
    "parasitic_drag beside z": ({"parasitic_drag.c": 0.05}, {"parasitic_drag.beside_z": 0.03}),
    "translational_lift": ({}, {"translational_lift.k": 0.02}),
    "rotor_drag_moment": (DRAG, {"rotor_drag_moment.h_x": 0.03, "rotor_drag_moment.h_y": 0.02}),
    "rate_damping": ({}, {"rate_damping.l_p": 2.0, "rate_damping.m_q": 1.0, "rate_damping.n_r": 0.7}),
    "axial_inflow": ({}, {"axial_inflow.k_z": 0.3}),
    "rotor_drag at the CG": (DRAG, {"rotor_drag.central": 1.0}),
    "axial_inflow nearer to the CG": (
        {"axial_inflow.k_z": 0.5, "axial_inflow.k_climb": 0.1},
        {"axial_inflow.central": 0.6},
    ),
    "axial_inflow in climb": ({"axial_inflow.k_z": 0.3}, {"axial_inflow.k_climb": 0.2}),
    "wind": (DRAG, {"wind.north": 3.0, "wind.east": -2.0}),
    "weak_rotor": ({}, {"weak_rotor.loss_2": 0.02}),
    "cg_offset": ({}, {"cg_offset.x": 0.0008, "cg_offset.y": -0.0005}),
    "cg_offset with axial_inflow": (
        {"axial_inflow.k_z": 0.5, "axial_inflow.k_climb": 0.1},
        {"cg_offset.x": 0.0008, "cg_offset.y": -0.0005},
    ),
    "rotor_telemetry_delay": ({"motor_lag.tau": 0.03}, {"rotor_telemetry_delay.delay": 0.013}),
    "drag torque of a weak rotor": ({"weak_rotor.loss_2": 0.02}, {"weak_rotor.extra_2": 0.1}),
    "thrust_curve with offset": ({"thrust_curve.dead_speed": 20.0}, {"thrust_curve.offset": 0.2}),
    "drag_torque_curve": ({}, {"drag_torque_curve.growth": 0.8}),
    "no_gyroscopic_coupling": ({}, {"no_gyroscopic_coupling.share": 1.0}),
    "payload": (
        {"mass_change.time": 0.2, "mass_change.fraction": 0.1},
        {f"mass_change.{k}": v for k, v in {"J_xx": 0.2, "J_yy": 0.3, "J_zz": 0.1, "x": 0.0008, "y": -0.0005}.items()},
    ),
    "mass_change": ({}, {"mass_change.time": 0.2, "mass_change.fraction": 0.1}),
    "thrust_drop": ({}, {"thrust_drop.time": 0.2, "thrust_drop.fraction": 0.1}),
    "battery_sag": ({}, {"battery_sag.fraction": 0.1}),
    "thrust_curve": ({}, {"thrust_curve.dead_speed": 30.0}),
    "product_of_inertia": (
        {},
        {"product_of_inertia.J_xy": 5e-4, "product_of_inertia.J_xz": 1e-3, "product_of_inertia.J_yz": -6e-4},
    ),
    "rotor_spin_up": ({"motor_lag.tau": 0.04}, {"rotor_spin_up.J": 5e-5}),
    "imu_lever_arm": ({}, {"imu_lever_arm.x": 0.05, "imu_lever_arm.y": -0.03, "imu_lever_arm.z": 0.04}),
    "ground_effect": ({}, {"ground_effect.radius_scale": 2.0}),
}
EVERYTHING = {name: value for anyway, effect in EFFECTS.values() for name, value in (anyway | effect).items()}
PLACES: list[tuple[str, Sampling]] = [("pelican", "held"), ("hexacopter", "instant")]


def residual(name: str, sampling: Sampling, flown: dict[str, float], model: dict[str, float]) -> FloatArray:
    """Largest residual in each of gyro, attitude, force, velocity, position of a 0.4 s flight at 50 Hz."""
    vehicle = Vehicle.shipped(name)
    flight = fly(vehicle, values_of(vehicle, flown), lively_input(vehicle, 0.4, 0.02, sampling=sampling))
    window = flight.window()
    segments = Segments(len(window) - 3, 1, np.array([2]))
    theta = vector(vehicle, values_of(vehicle, model))
    out, _ = Rollout(window, vehicle).roll(segments, theta[None], flight.states(segments.starts - 1))
    return np.asarray(np.abs(out[0, 0, :, :, 0]).max(axis=0).reshape(5, 3).max(axis=1))


@pytest.mark.parametrize(("name", "sampling"), [(n, s) for n in ("pelican", "hexacopter") for s in ("held", "instant")])
def test_nominal_model(name: str, sampling: Sampling) -> None:
    assert np.all(residual(name, sampling, {}, {}) < [2e-6, 1e-6, 1e-7, 2e-6, 1e-6])


@pytest.mark.parametrize(("name", "sampling"), PLACES)
@pytest.mark.parametrize("effect", EFFECTS)
def test_effect(effect: str, name: str, sampling: Sampling) -> None:
    anyway, values = EFFECTS[effect]
    with_it = residual(name, sampling, anyway | values, anyway | values)
    assert np.all(with_it < 2e-5), "model and independent writing agree to the integration error"
    without = residual(name, sampling, anyway | values, anyway)
    assert np.any(without > 50.0 * np.maximum(with_it, 1e-5)), "and would not without the effect"


@pytest.mark.parametrize(("name", "sampling", "share"), [("pelican", "held", 1e-4), ("hexacopter", "instant", 0.05)])
def test_rotors_that_slow_down_later_than_they_speed_up(name: str, sampling: Sampling, share: float) -> None:
    """Exact for held input; a linear one may turn within a piece of a step, whose lag is that of its start: 4 %."""
    lag, slower = {"motor_lag.tau": 0.03}, {"motor_lag.tau": 0.03, "motor_lag.slower": 0.02}
    assert np.all(residual(name, sampling, slower, slower) < share * residual(name, sampling, slower, lag))


@pytest.mark.parametrize(("name", "sampling"), PLACES)
def test_all_effects_at_once(name: str, sampling: Sampling) -> None:
    assert np.all(residual(name, sampling, EVERYTHING, EVERYTHING) < 5e-5)


@pytest.mark.parametrize("effect", ["mass_change", "thrust_drop"])
def test_a_change_within_a_step_takes_its_share_of_the_step(effect: str) -> None:
    values = {f"{effect}.time": 0.2037, f"{effect}.fraction": 0.1}
    assert np.all(residual("pelican", "held", values, values) < [1e-5, 1e-5, 1e-6, 5e-4, 1e-4])


def test_random_parameters() -> None:
    """The paper's six, drawn anew: nothing of the agreement hangs on one airframe's numbers."""
    rng = np.random.default_rng(5)
    for _ in range(3):
        vehicle = Vehicle.shipped("pelican")
        values = {k: v * float(np.exp(rng.normal(0.0, 0.25))) for k, v in values_of(vehicle).items()}
        values["b"] = vehicle.parameters["b"].initial * float(rng.uniform(0.95, 1.05))
        values["J_r"] *= 20.0  # makes the gyroscopic torque weigh
        assert np.all(residual("pelican", "instant", values, values) < 5e-5)
