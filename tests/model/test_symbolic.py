"""The equations for those who differentiate are the kernel's: rates of every state over random states and effects."""

import math
from typing import Any

import numpy as np
import pytest

import quadid
from quadid import symbolic
from quadid.effects import EFFECTS
from quadid.errors import ParameterError
from quadid.model.step import Simulator
from quadid.model.terms import LEFT_OUT, TERMS, Frame, Plain
from quadid.types import FloatArray
from quadid.vehicle import ResidualTerm, Vehicle

SPAN = 40.0
LAG = {"motor_lag": {"tau": 0.04}}
EFFECT: dict[str, dict[str, dict[str, float]]] = {
    "motor_lag": {"motor_lag": {"tau": 0.04, "tau_down": 0.06}},
    "supply_voltage": {"supply_voltage": {"exponent": 0.8}},
    "rotor_drag": {"rotor_drag": {"k_x": 0.3, "k_y": 0.2, "central": 0.3}},
    "parasitic_drag": {"parasitic_drag": {"c": 0.03, "c_z": 0.05}},
    "translational_lift": {"translational_lift": {"k": 0.02}},
    "rotor_drag_moment": {"rotor_drag": {"k_x": 0.3, "k_y": 0.2}, "rotor_drag_moment": {"h_x": 0.02, "h_y": 0.03}},
    "rate_damping": {"rate_damping": {"l_p": 0.5, "m_q": 0.7, "n_r": 0.2}},
    "axial_inflow": {"axial_inflow": {"k_z": 0.4, "k_climb": 0.03, "central": 0.2}},
    "wind": {"wind": {"north": 3.0, "east": -2.0}, "rotor_drag": {"k_x": 0.3, "k_y": 0.2}},
    "weak_rotor": {"weak_rotor": {"rotor": 2, "loss": 0.1, "drag_loss": 0.05}},
    "cg_offset": {"cg_offset": {"x": 0.01, "y": -0.02}},
    "mass_change": {"mass_change": {"time": 5.0, "fraction": 0.2, "J_xx": 0.1, "J_yy": 0.2, "J_zz": 0.1, "x": 0.01}},
    "thrust_drop": {"thrust_drop": {"time": 5.0, "fraction": 0.1}},
    "battery_sag": {"battery_sag": {"fraction": 0.2}},
    "thrust_curve": {"thrust_curve": {"dead_speed": 30.0, "offset": 0.1}},
    "drag_torque_curve": {"drag_torque_curve": {"growth": 0.7}},
    "no_gyroscopic_coupling": {"no_gyroscopic_coupling": {"share": 0.4}},
    "product_of_inertia": {"product_of_inertia": {"J_xy": 1e-3, "J_xz": -5e-4, "J_yz": 8e-4}},
    "rotor_spin_up": {"rotor_spin_up": {"J": 3e-5}, **LAG},
    "ground_effect": {"ground_effect": {"radius_scale": 1.5}},
}
"""An example of each effect that acts on body or rotors."""
ALL: dict[str, dict[str, float]] = {k: v for effects in EFFECT.values() for k, v in effects.items()}
CASES = {"nominal": {}, **EFFECT, "all": ALL}
RESIDUAL = (
    ResidualTerm(acts_on="force_y", product=("v_y", "V"), value=-0.02),
    ResidualTerm(acts_on="moment_x", product=("p", "T", "g_z"), value=1e-4),
    ResidualTerm(acts_on="moment_z", product=("r", "W"), value=-1e-6),
)


def craft(effects: dict[str, dict[str, float]], name: str = "pelican", **more: Any) -> Vehicle:
    vehicle = Vehicle.shipped(name)
    places = [(*r.position[:2], -0.01 * i) for i, r in enumerate(vehicle.rotors)]
    lifted = tuple(r.model_copy(update={"position": at}) for r, at in zip(vehicle.rotors, places, strict=True))
    return vehicle.model_copy(update={"effects": effects, "rotors": lifted, **more})


def random_state(rng: np.random.Generator, vehicle: Vehicle) -> tuple[FloatArray, FloatArray]:
    """A lively motion with its rotor speeds, and a command."""
    q = rng.standard_normal(4)
    n, hover = len(vehicle.rotors), vehicle.hover_speed()
    motion = (q / np.linalg.norm(q), 2.0 * rng.standard_normal(3), 4.0 * rng.standard_normal(3), rng.standard_normal(3))
    x = np.concatenate([*motion, hover * (1.0 + 0.2 * rng.standard_normal(n))])
    x[12] = -0.4 - abs(x[12])
    return x, hover * (1.0 + 0.2 * rng.standard_normal(n))


def kernel_rates(vehicle: Vehicle, x: FloatArray, u: FloatArray, t: float, voltage: float) -> FloatArray:
    """Rates of the kernel: its mean rates over steps of several lengths, carried on to no length."""
    lagging = vehicle.effects.get("motor_lag", {}).get("tau", 0.0) > 0.0
    speed = x[13:] if lagging else u * voltage ** vehicle.effects.get("supply_voltage", {}).get("exponent", 0.0)
    steps, rates = 1e-3 * np.array([1.0, 1.5, 2.0, 2.5, 3.0, 3.5]), []
    for dt in steps:
        simulator = Simulator(vehicle, span=SPAN)
        state = simulator.start(
            attitude=x[:4], rate=x[4:7], velocity=x[7:10], position=x[10:13], rotor_speed=speed, time=t, dt=dt
        )
        simulator.advance(state, u, dt, voltage)
        now = np.concatenate([v[0] for v in (state.attitude, state.rate, state.velocity, state.position)])
        if lagging:
            now = np.concatenate([now, state.rotor_speed[0]])
        rates.append((now - x[: len(now)]) / dt)
    return np.asarray(np.polynomial.polynomial.polyfit(steps / 1e-3, np.array(rates), len(steps) - 1)[0])


@pytest.mark.parametrize("name", CASES)
def test_rates_are_those_of_the_kernel(name: str) -> None:
    vehicle = craft(CASES[name])
    f = symbolic.model(vehicle, span=SPAN).function()
    rng = np.random.default_rng(7)
    for k in range(6):
        x, u = random_state(rng, vehicle)
        t, voltage = (2.0, 8.0)[k % 2], 0.9 if "supply_voltage" in vehicle.effects else 1.0
        wanted = kernel_rates(vehicle, x, u, t, voltage)
        found = np.array(f(x=x[: len(wanted)], u=u, t=t, v=voltage)["dx"]).ravel()
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
        plain = Frame(vehicle, SPAN)
        again = plain.derivative(Plain(), x[: len(wanted)].tolist(), u.tolist(), plain.theta.tolist(), t, voltage)
        np.testing.assert_allclose(again, found, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("name", ["hexacopter", "pelican_x", "crazyflie"])
def test_other_airframes_and_terms_beyond_the_catalogue(name: str) -> None:
    effects = {k: v for k, v in ALL.items() if k not in ("weak_rotor", "product_of_inertia", "rotor_spin_up")}
    vehicle = craft({} if name == "crazyflie" else effects, name, residual=RESIDUAL)
    x, u = random_state(np.random.default_rng(3), vehicle)
    wanted = kernel_rates(vehicle, x, u, 8.0, 1.0)
    found = np.array(symbolic.model(vehicle, span=SPAN).function()(x=x[: len(wanted)], u=u, t=8.0)["dx"]).ravel()
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


def test_every_effect_is_in_the_table_or_said_to_be_left_out() -> None:
    around = {  # what the terms act on: the derivative itself has these
        "motor_lag",
        "supply_voltage",
        "wind",
        "cg_offset",
        "product_of_inertia",
        "no_gyroscopic_coupling",
        "rate_damping",
        "mass_change",
        "thrust_drop",
        "battery_sag",
    }
    there = {name for term in TERMS for name in term.effects} | around
    assert there - {"residual"} | set(LEFT_OUT) == set(EFFECTS)
    assert set(EFFECT) == there - {"residual"}
    assert symbolic.model(craft({"imu_lag": {"cutoff": 30.0}})).left_out == ("imu_lag",)


def test_jacobians_are_differences() -> None:
    vehicle = craft({k: v for k, v in ALL.items() if k != "ground_effect"})
    model = symbolic.model(vehicle, ("J_xx", "rotor_drag.k_x"), span=SPAN)
    f, jacobians = model.function(), model.jacobians()
    x, u = random_state(np.random.default_rng(5), vehicle)
    found = jacobians(x=x, u=u, p=model.values)
    assert np.array(found["P"]).shape == (17, 2)
    for key, name, at in (("A", "x", x), ("B", "u", u), ("P", "p", np.array(model.values))):
        given = {"x": x, "u": u, "p": np.array(model.values)}
        for i in range(len(at)):
            h = 1e-6 * max(abs(at[i]), 1e-3)
            ends = []
            for sign in (1.0, -1.0):
                moved = at.copy()
                moved[i] += sign * h
                ends.append(np.array(f(**{**given, name: moved})["dx"]).ravel())
            slope = (ends[0] - ends[1]) / (2.0 * h)
            np.testing.assert_allclose(np.array(found[key])[:, i], slope, rtol=1e-4, atol=1e-4 * np.abs(slope).max())


def test_a_step_is_one_of_fourth_order() -> None:
    vehicle = craft(LAG)
    x, u = random_state(np.random.default_rng(9), vehicle)
    model, errors = symbolic.model(vehicle), []
    for dt in (0.01, 0.005):
        simulator = Simulator(vehicle)
        state = simulator.start(
            attitude=x[:4], rate=x[4:7], velocity=x[7:10], position=x[10:13], rotor_speed=x[13:], dt=dt / 8
        )
        for _ in range(8):
            simulator.advance(state, u, dt / 8)
        there = np.array(model.step(dt)(x=x, u=u)["next"]).ravel()
        errors.append(np.abs(there[4:10] - np.concatenate([state.rate[0], state.velocity[0]])).max())
    assert errors[0] < 1e-4
    assert math.log2(errors[0] / errors[1]) > 4.0


def test_what_has_no_derivative_is_refused() -> None:
    with pytest.raises(ParameterError, match="rotor_spin_up without motor_lag"):
        symbolic.model(craft({"rotor_spin_up": {"J": 3e-5}}))
    with pytest.raises(ParameterError, match="battery_sag without a length"):
        symbolic.model(craft({"battery_sag": {"fraction": 0.1}}))
    with pytest.raises(ParameterError, match="unknown parameter 'J_xxx'"):
        symbolic.model("pelican", ("J_xxx",))


@pytest.mark.parametrize("name", ["nominal", "all"])
def test_jax_has_the_same_equations_and_slopes(name: str) -> None:
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    vehicle = craft(CASES[name], residual=RESIDUAL)
    model, reference = quadid.jax.model(vehicle, span=SPAN), symbolic.model(vehicle, span=SPAN)
    derivative, f = jax.jit(model.derivative), reference.function()
    x, u = random_state(np.random.default_rng(11), vehicle)
    x = x[: len(model.states)]
    wanted = np.array(f(x=x, u=u, t=8.0)["dx"]).ravel()
    np.testing.assert_allclose(derivative(x, u, None, 8.0), wanted, rtol=1e-11, atol=1e-11 * np.abs(wanted).max())
    slopes = np.asarray(jax.jit(jax.jacobian(model.derivative))(x, u, None, 8.0))
    wanted = np.array(reference.jacobians()(x=x, u=u, t=8.0)["A"])
    np.testing.assert_allclose(slopes, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    thetas = np.array([model.theta, model.theta])
    thetas[1, 2] *= 1.1
    many = np.asarray(jax.vmap(lambda theta: model.step(x, u, 0.01, theta, 8.0))(thetas))
    there = np.array(reference.step(0.01)(x=x, u=u, t=8.0)["next"]).ravel()
    np.testing.assert_allclose(many[0], there, rtol=1e-11, atol=1e-12)
    assert abs(many[0, 4] - many[1, 4]) > 1e-6
