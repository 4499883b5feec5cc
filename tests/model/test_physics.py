"""Physics of the model: conservation, balances, symmetries, exact solutions, order of convergence."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Rotor, Vehicle
from tests.model.flights import lively_input, values_of
from tests.model.independent import Input
from tests.model.simulate import Trajectory, finer, held, simulate, state

PELICAN = Vehicle.shipped("pelican")
HOVER = PELICAN.hover_speed()
FULL = {"rotor_drag.k_x": 1e-30}
"""Makes the kernel use its full right-hand side and leaves the motion alone."""


def with_effects(**extra: float) -> dict[str, float]:
    return values_of(PELICAN, {name.replace("__", "."): value for name, value in extra.items()})


def inertia(values: dict[str, float]) -> FloatArray:
    J = np.diag([values["J_xx"], values["J_yy"], values["J_zz"]])
    for (i, j), name in {(0, 1): "J_xy", (0, 2): "J_xz", (1, 2): "J_yz"}.items():
        J[i, j] = J[j, i] = -values.get(f"product_of_inertia.{name}", 0.0)
    return J


def matrices(run: Trajectory) -> FloatArray:
    return np.asarray(Rotation.from_quat(run.quaternion[:, [1, 2, 3, 0]]).as_matrix())


def rotational_energy(run: Trajectory, values: dict[str, float]) -> FloatArray:
    return np.asarray(0.5 * np.einsum("ni,ij,nj->n", run.rate, inertia(values), run.rate))


# --- conservation


@pytest.mark.parametrize("extra", [{}, FULL])
def test_gyroscopic_torque_does_no_work(extra: dict[str, float]) -> None:
    """Thrust balanced in pairs, no drag torque, spins unbalanced: only tau = J_r Omega_r (q, -p, 0) is left."""
    values = values_of(PELICAN, {"d": 1e-30, "J_r": 3e-4, **extra})
    rows = np.tile(np.where(PELICAN.spins > 0.0, 1.2, 0.8) * HOVER, (200, 1))
    energies = []
    for parts in (2, 4):
        run = simulate(PELICAN, values, finer(held(rows), parts), state(rate=(1.5, -1.0, 0.8)))
        energy = rotational_energy(run, values)
        energies.append(np.abs(energy / energy[0] - 1.0).max())
        assert np.ptp(run.rate[:, 0]) > 2.0, "the torque acts: roll and pitch rate swap"
    assert energies[1] < 1e-5
    assert energies[0] > 12.0 * energies[1], "what is lost is the integration error, falling with the fourth power"


@pytest.mark.parametrize("products", [{}, {"product_of_inertia.J_xy": 1e-3, "product_of_inertia.J_yz": -2e-3}])
def test_torque_free_body_keeps_energy_and_angular_momentum(products: dict[str, float]) -> None:
    values = values_of(PELICAN, {**FULL, **products})
    run = simulate(PELICAN, values, held(np.full((300, 4), HOVER), 0.005), state(rate=(2.0, -1.0, 3.0)))
    energy = rotational_energy(run, values)
    momentum = np.einsum("nij,jk,nk->ni", matrices(run), inertia(values), run.rate)
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-7
    assert np.abs(momentum - momentum[0]).max() < 1e-7 * np.linalg.norm(momentum[0])


def test_axisymmetric_body_precesses_at_the_textbook_rate() -> None:
    """Euler's free top, J_xx = J_yy: (p, q) turns at (J_zz - J_xx) / J_xx r (Goldstein, Classical Mechanics, 5.6)."""
    values = values_of(PELICAN, {"J_xx": 8e-3, "J_yy": 8e-3, "J_zz": 1.4e-2})
    run = simulate(PELICAN, values, held(np.full((200, 4), HOVER), 0.01), state(rate=(1.0, 0.0, 3.0)))
    t = 0.01 * (1.0 + np.arange(len(run.rate)))
    turn = (1.4e-2 - 8e-3) / 8e-3 * 3.0 * t
    expected = np.column_stack([np.cos(turn), np.sin(turn), np.full(len(t), 3.0)])
    assert np.abs(run.rate - expected).max() < 1e-7


def test_quaternion_stays_of_unit_length() -> None:
    for extra in ({}, FULL):
        run = simulate(
            PELICAN, values_of(PELICAN, extra), held(np.full((1000, 4), HOVER)), state(rate=(9.0, -7.0, 8.0))
        )
        assert abs(np.linalg.norm(run.end[:4]) - 1.0) < 1e-9


# --- balances


@pytest.mark.parametrize("extra", [{}, FULL])
def test_rotational_energy_changes_by_the_work_of_the_torque(extra: dict[str, float]) -> None:
    """Eqs. 3-6 written out for the plus frame; the gyroscopic torque is there and must not count."""
    values = values_of(PELICAN, {"J_r": 1e-3, **extra})
    given = lively_input(PELICAN, 0.6, 0.02)
    run = simulate(PELICAN, values, finer(given, 4), state(rate=(0.5, -0.4, 0.3)))
    w2 = finer(given, 4).rows[1 : 1 + len(run.rate)] ** 2
    arm, b, d = 0.21, values["b"], values["d"]
    roll, pitch = arm * b * (w2[:, 3] - w2[:, 1]), arm * b * (w2[:, 2] - w2[:, 0])
    torque = np.column_stack([roll, pitch, d * (-w2[:, 0] + w2[:, 1] - w2[:, 2] + w2[:, 3])])
    energy = rotational_energy(run, values)
    # The input is constant over the four rows 4 i to 4 i + 3: Simpson's rule over rows 4 i, 4 i + 2, 4 i + 4.
    at = np.arange(3, len(energy) - 4, 4)
    rate = run.rate[at] + 4.0 * run.rate[at + 2] + run.rate[at + 4]
    work = np.sum(torque[at] * rate, axis=1) * 0.02 / 6.0
    assert np.abs(energy[at + 4] - energy[at] - work).max() < 1e-7
    assert np.abs(work).max() > 1e-3


def test_free_fall() -> None:
    values = values_of(PELICAN, {"b": 1e-30, "d": 1e-30})
    run = simulate(
        PELICAN, values, held(np.full((60, 4), HOVER)), state(rate=(1.0, 2.0, -0.5), velocity=(3.0, -2.0, -5.0))
    )
    t = 0.02 * (1.0 + np.arange(len(run.rate)))
    assert np.abs(run.force).max() < 1e-12, "an accelerometer in free fall reads nothing"
    assert np.allclose(run.velocity[:, 2], -5.0 + GRAVITY * t, rtol=0.0, atol=1e-11)
    assert np.allclose(
        run.position, np.outer(t, [3.0, -2.0, -5.0]) + 0.5 * GRAVITY * np.outer(t**2, [0, 0, 1]), atol=1e-11
    )


def test_hover_is_an_equilibrium() -> None:
    run = simulate(PELICAN, values_of(PELICAN), held(np.full((100, 4), HOVER)), state())
    assert np.abs(run.force - [0.0, 0.0, -GRAVITY]).max() < 1e-11
    assert np.abs(run.velocity).max() < 1e-11
    assert np.abs(run.rate).max() < 1e-12


def test_specific_force_is_what_changes_velocity() -> None:
    """v' = R f + g: mean force over a step, turned at its middle, against the difference of velocities."""
    values = values_of(PELICAN, {"rotor_drag.k_x": 0.4, "rotor_drag.k_y": 0.2, "parasitic_drag.c": 0.05})
    run = simulate(PELICAN, values, lively_input(PELICAN, 1.0, 0.002), state(velocity=(4.0, -3.0, 1.0)))
    felt = np.einsum("nij,nj->ni", matrices(run), run.force)[1:-1]
    change = (run.velocity[2:] - run.velocity[:-2]) / 0.004
    assert np.abs(change - felt - [0.0, 0.0, GRAVITY])[2:].max() < 5e-3


@pytest.mark.parametrize("name", ["rotor_drag.k_x", "rotor_drag.k_y", "parasitic_drag.c", "axial_inflow.k_z"])
def test_drag_takes_energy_from_motion_through_the_air(name: str) -> None:
    start = state((0.9, 0.2, -0.1, 0.3), velocity=(3.0, -2.0, 2.0))
    given = held(np.full((2, 4), HOVER), 1e-3)
    free, slowed = (simulate(PELICAN, values_of(PELICAN, {**FULL, name: k}), given, start) for k in (0.0, 0.3))
    assert np.sum((slowed.end[7:10] - free.end[7:10]) * start[7:10]) < -1e-4


def test_no_drag_when_moving_with_the_wind() -> None:
    values = with_effects(
        rotor_drag__k_x=0.5,
        rotor_drag__k_y=0.5,
        parasitic_drag__c=0.1,
        axial_inflow__k_z=0.5,
        wind__north=4.0,
        wind__east=-3.0,
    )
    run = simulate(PELICAN, values, held(np.full((50, 4), HOVER)), state(velocity=(4.0, -3.0, 0.0)))
    assert np.abs(run.force - [0.0, 0.0, -GRAVITY]).max() < 1e-10


def test_terminal_velocity() -> None:
    """Falling without thrust, gravity and m c v^2 balance: v = sqrt(g / c)."""
    values = values_of(PELICAN, {"b": 1e-30, "d": 1e-30, "parasitic_drag.c": 0.1})
    run = simulate(PELICAN, values, held(np.full((500, 4), HOVER)), state())
    assert abs(run.velocity[-1, 2] - np.sqrt(GRAVITY / 0.1)) < 1e-5


# --- symmetries

SYMMETRIC = {
    "rotor_drag.k_x": 0.3,
    "rotor_drag.k_y": 0.2,
    "rotor_drag_moment.h_x": 0.03,
    "rotor_drag_moment.h_y": 0.02,
    "parasitic_drag.c": 0.04,
    "rate_damping.l_p": 1.0,
    "rate_damping.m_q": 0.5,
    "axial_inflow.k_z": 0.2,
    "motor_lag.tau": 0.03,
    "rotor_spin_up.J": 5e-5,
    "imu_lever_arm.z": 0.05,
}


def test_heading_of_the_world_axes_does_not_matter() -> None:
    given, turn = lively_input(PELICAN, 0.6, 0.02), Rotation.from_euler("Z", 1.1)
    start = state((0.95, 0.1, -0.2, 0.1), (0.3, -0.2, 0.4), (2.0, 1.0, -0.5))
    turned = start.copy()
    turned[:4] = (turn * Rotation.from_quat(start[[1, 2, 3, 0]])).as_quat()[[3, 0, 1, 2]]
    turned[7:10] = turn.apply(start[7:10])
    wind = turn.apply([3.0, -1.0, 0.0])
    one = simulate(PELICAN, values_of(PELICAN, {**SYMMETRIC, "wind.north": 3.0, "wind.east": -1.0}), given, start)
    two = simulate(
        PELICAN, values_of(PELICAN, {**SYMMETRIC, "wind.north": wind[0], "wind.east": wind[1]}), given, turned
    )
    assert np.abs(one.rate - two.rate).max() < 1e-12
    assert np.abs(one.force - two.force).max() < 1e-11
    assert np.abs(turn.apply(one.velocity) - two.velocity).max() < 1e-12


def test_names_of_the_rotors_do_not_matter() -> None:
    order = [2, 0, 3, 1]
    given = lively_input(PELICAN, 0.6, 0.02)
    shuffled = PELICAN.model_copy(update={"rotors": tuple(PELICAN.rotors[i] for i in order)})
    start = state((0.95, 0.1, -0.2, 0.1), (0.3, -0.2, 0.4), (2.0, 1.0, -0.5))
    one = simulate(PELICAN, values_of(PELICAN, {**SYMMETRIC, "weak_rotor.loss_1": 0.02}), given, start)
    two = simulate(
        shuffled,
        values_of(PELICAN, {**SYMMETRIC, "weak_rotor.loss_2": 0.02}),
        Input(given.rows[:, order], given.dt),
        start,
    )
    assert np.abs(one.end - two.end).max() < 1e-12


@pytest.mark.parametrize("extra", [{}, SYMMETRIC])
def test_mirror_image_flies_the_mirrored_flight(extra: dict[str, float]) -> None:
    """Left and right exchanged: y, v, q_x, q_z, p, r and spins change sign; nothing else does."""
    given = lively_input(PELICAN, 0.6, 0.02)
    other = PELICAN.model_copy(
        update={
            "rotors": tuple(
                Rotor(position=(r.position[0], -r.position[1], r.position[2]), spin=-r.spin) for r in PELICAN.rotors
            )
        }
    )
    start = state((0.95, 0.1, -0.2, 0.1), (0.3, -0.2, 0.4), (2.0, 1.0, -0.5))
    sign = np.array([1, -1, 1, -1, -1, 1, -1, 1, -1, 1, 1, -1, 1.0])
    one = simulate(PELICAN, values_of(PELICAN, extra), given, start)
    two = simulate(other, values_of(PELICAN, extra), given, sign * start)
    assert np.abs(sign * one.end - two.end).max() < 1e-12


# --- order


def errors(values: dict[str, float], given: Input, start: FloatArray, parts: tuple[int, ...]) -> FloatArray:
    """Error of the final state on grids `parts` times as fine, against one far finer."""
    best = simulate(PELICAN, values, finer(given, 32), start).end
    ends = [simulate(PELICAN, values, finer(given, n), start).end for n in parts]
    return np.array([np.abs(end - best).max() for end in ends])


@pytest.mark.parametrize(
    ("extra", "order"),
    [
        ({}, 3.7),
        (FULL, 3.7),
        (SYMMETRIC, 3.7),
        ({"motor_lag.tau": 0.08}, 3.7),
        ({"ground_effect.radius_scale": 1.5}, 1.7),
    ],
)
def test_order_of_convergence(extra: dict[str, float], order: float) -> None:
    """Fourth order for held inputs, lagging rotors too; second for ground effect, whose height is held over a step."""
    given = lively_input(PELICAN, 0.8, 0.04)
    start = state(rate=(3.0, -4.0, 2.0), velocity=(2.0, 0.0, 0.0), position=(0.0, 0.0, -2.0))
    found = errors(values_of(PELICAN, extra), given, start, (1, 2, 4))
    slopes = np.log2(found[:-1] / found[1:])
    assert np.all(slopes > order), f"errors {found}, orders {slopes}"
