"""Steps of the simulation: the same as the rollout, for one vehicle or many, from a state that holds everything."""

import math
import pickle
from typing import Any

import numpy as np
import pytest

import quadid
from quadid.errors import ParameterError, WindowError
from quadid.model import layout as ix
from quadid.model.layout import Layout
from quadid.model.step import RandomInputs, Simulator, State
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.model.independent import Input
from tests.model.simulate import simulate, state

PELICAN = Vehicle.shipped("pelican")
EFFECTS: list[dict[str, dict[str, float]]] = [
    {},
    {"motor_lag": {"tau": 0.05}},
    {"motor_lag": {"tau": 0.03, "tau_down": 0.06}, "parasitic_drag": {"c": 0.03}},
    {"command_delay": {"delay": 0.033}, "rotor_drag": {"k_x": 0.3, "k_y": 0.2}, "wind": {"north": 2.0, "east": -1.0}},
    {"cg_offset": {"x": 0.005, "y": -0.002}, "gyro_bias": {"x": 0.01, "y": 0.0, "z": -0.02}},
    {"weak_rotor": {"rotor": 2, "loss": 0.1}, "thrust_curve": {"dead_speed": 30.0}, "rate_damping": {"l_p": 0.5}},
    {"mass_change": {"time": 0.5, "fraction": 0.2, "J_xx": 0.1}, "thrust_drop": {"time": 0.8, "fraction": 0.05}},
]


def craft(effects: dict[str, dict[str, float]]) -> Vehicle:
    return PELICAN.model_copy(update={"effects": effects})


def speeds(vehicle: Vehicle, n: int = 60) -> FloatArray:
    return np.asarray(vehicle.hover_speed() * (1.0 + 0.02 * np.random.default_rng(1).standard_normal((n, 4))))


@pytest.mark.parametrize("effects", EFFECTS, ids=lambda e: "+".join(e) or "nominal")
def test_steps_are_those_of_the_rollout(effects: dict[str, dict[str, float]]) -> None:
    vehicle = craft(effects)
    rows = speeds(vehicle)
    rolled = simulate(craft({}), effects_of(vehicle), Input(rows, 0.02, 0.0, "held"), state())
    simulator = Simulator(vehicle)
    now = simulator.start(rotor_speed=rows[0], dt=0.02)
    for row, quaternion, rate, velocity, position in zip(
        rows, rolled.quaternion, rolled.rate, rolled.velocity, rolled.position, strict=False
    ):
        now = simulator.step(now, row, 0.02)
        sign = np.sign(now.reported_attitude[0, 0])
        np.testing.assert_allclose(sign * now.reported_attitude[0], quaternion, atol=1e-9)
        np.testing.assert_allclose(now.gyro[0], rate, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(now.velocity[0], velocity, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(now.position[0], position, rtol=1e-9, atol=1e-12)


def effects_of(vehicle: Vehicle) -> dict[str, float]:
    """Entries of the parameter vector of a file that are not neutral."""
    layout = Layout(vehicle)
    theta, neutral = layout.initial(vehicle), layout.neutral()
    return {n: float(theta[e.index]) for n, e in layout.entries.items() if theta[e.index] != neutral[e.index]}


@pytest.mark.parametrize("effects", [*EFFECTS, {"imu_lag": {"cutoff": 8.0}, "attitude_delay": {"delay": 0.03}}])
def test_a_loop_of_steps_is_a_run_and_old_states_stay(effects: dict[str, dict[str, float]]) -> None:
    vehicle = craft(effects)
    rows = speeds(vehicle)
    simulator = Simulator(vehicle)
    begin = simulator.start(rotor_speed=rows[0], dt=0.02)
    kept = begin.copy()
    now = begin
    for row in rows:
        now = simulator.step(now, row, 0.02)
    whole = simulator.run(kept, rows, 0.02)[-1, 0]
    seen = np.concatenate([now.attitude, now.rate, now.velocity, now.position, now.reported_attitude, now.gyro], axis=1)
    np.testing.assert_allclose(seen[0], whole[:20], rtol=1e-12, atol=1e-15)  # times are summed, or multiplied
    np.testing.assert_array_equal(begin.position, 0.0)
    assert now.steps == len(rows)
    assert now.time == pytest.approx(1.2)


def test_the_motor_lag_is_not_lost_between_steps() -> None:
    """A stepwise call once began each step with rotors at the command: 0.318 instead of 0.058 rad/s after two."""
    vehicle = craft({"motor_lag": {"tau": 0.05}})
    hover = np.full(4, vehicle.hover_speed())
    push = hover + np.array([0.0, -20.0, 0.0, 20.0])
    simulator = Simulator(vehicle)
    slow = simulator.start(dt=0.02)
    for _ in range(2):
        slow = simulator.step(slow, push, 0.02)
    direct = Simulator(craft({}))
    fast = direct.start(dt=0.02)
    for _ in range(2):
        fast = direct.step(fast, push, 0.02)
    assert 0.0 < slow.rate[0, 0] < 0.4 * fast.rate[0, 0]
    expected = hover + (push - hover) * (1.0 - np.exp(-0.04 / 0.05))
    np.testing.assert_allclose(slow.rotor_speed[0], expected, rtol=1e-9)


LAGGING: dict[str, dict[str, float]] = {"motor_lag": {"tau": 0.03}, "rotor_drag": {"k_x": 0.3, "k_y": 0.2}}


@pytest.mark.parametrize(("count", "every"), [(1, False), (16, False), (21, False), (21, True)])
def test_a_batch_flies_as_each_vehicle_alone(count: int, every: bool) -> None:
    """Each with numbers of its own; with `every`, of all effects: other delays, payloads and filters in each lane."""
    vehicle = craft({} if every else LAGGING)
    rng = np.random.default_rng(2)
    thetas = np.tile(Layout(vehicle).initial(vehicle), (count, 1))
    thetas[:, :6] *= np.exp(0.1 * rng.standard_normal((count, 6)))
    for entry in Layout(vehicle).entries.values() if every else ():
        if entry.index > ix.JR and "battery_sag" not in entry.name:
            size = 0.15 if entry.name.endswith(".time") else entry.typical
            thetas[:, entry.index] = size * rng.uniform(0.5, 1.5, count)
    rows = vehicle.hover_speed() * (1.0 + 0.02 * rng.standard_normal((30, count, 4)))
    batch = Simulator(vehicle, thetas)
    together = batch.run(batch.start(rotor_speed=rows[0], dt=0.01), rows, 0.01)
    for i in range(count):
        alone = Simulator(vehicle, thetas[i])
        one = alone.run(alone.start(rotor_speed=rows[0, i], dt=0.01), rows[:, i], 0.01)
        np.testing.assert_allclose(together[:, i], one[:, 0], rtol=1e-11 if every else 1e-12, atol=1e-13)


def normals(seed: int, vehicle: int, step: int) -> list[float]:
    """The six normal numbers of a vehicle's step, in Python's own numbers."""
    golden, size, out = 0x9E3779B97F4A7C15, 1 << 64, []

    def uniform(x: int) -> float:
        x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % size
        x = (x ^ (x >> 27)) * 0x94D049BB133111EB % size
        return ((x ^ (x >> 31)) >> 12) / 2.0**52 + 2.0**-53

    for pair in range(3):
        counter = ((6 * step + 2 * pair + 1) << 24) + vehicle + 1
        at = (seed + golden * counter) % size
        radius, angle = math.sqrt(-2.0 * math.log(uniform(at))), 2.0 * math.pi * (uniform(at ^ (1 << 63)) - 0.5)
        out += [radius * math.cos(angle), radius * math.sin(angle)]
    return out


def drawn(state: State, vehicle: int) -> FloatArray:
    """Random inputs of a vehicle, read from the change of its rate and velocity in a step at level."""
    still = Simulator(PELICAN, np.tile(Layout(PELICAN).initial(PELICAN), (400, 1)))
    begun = still.start(dt=0.01)
    still.advance(begun, np.full(4, PELICAN.hover_speed()), 0.01)
    change = np.concatenate([state.velocity - begun.velocity, state.rate - begun.rate], axis=1)
    return np.asarray(change[vehicle] / 0.01)


def test_random_inputs_repeat_and_have_their_size() -> None:
    random = RandomInputs(force=(0.5, 0.5, 0.2), force_time=0.4, turn=(3.0, 2.0, 1.0), turn_time=0.1)
    thetas = np.tile(Layout(PELICAN).initial(PELICAN), (400, 1))
    rows = np.full((200, 4), PELICAN.hover_speed())
    runs = []
    for seed in (1, 1, 2):
        simulator = Simulator(PELICAN, thetas, random=random, seed=seed)
        runs.append(simulator.run(simulator.start(dt=0.01), np.repeat(rows[:, None], 400, axis=1), 0.01))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    # Variance of an integrated Gauss-Markov process that begins at zero, t much longer than T.
    t, big = 2.0, 0.1
    grown = 2.0 * big * (t - 1.5 * big)
    np.testing.assert_allclose(runs[0][-1, :, 4:7].std(axis=0), np.array([3.0, 2.0, 1.0]) * np.sqrt(grown), rtol=0.12)
    # The numbers are those of a counter, through splitmix64 and Box and Muller.
    many = Simulator(PELICAN, thetas, random=random, seed=7)
    begun = many.start(dt=0.01)
    many.advance(begun, rows[0], 0.01)
    for vehicle in (0, 17, 399):
        expected = np.array(random.each_axis[0]) * np.sqrt(1.0 - np.exp(-0.02 / random.each_axis[1]))
        np.testing.assert_allclose(drawn(begun, vehicle), expected * normals(7, vehicle, 0), rtol=1e-12)
    again = Simulator(PELICAN, thetas, random=random, seed=1)
    state = again.start(dt=0.01)
    branch = again.step(state, rows[0], 0.01)
    np.testing.assert_array_equal(branch.rate, again.step(state, rows[0], 0.01).rate)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda s, x: s.step(x, np.zeros(3), 0.01), "commands of shape"),
        (lambda s, x: s.step(x, np.zeros((2, 4)), 0.01), "commands of shape"),
        (lambda s, x: s.step(x, np.zeros((3, 1, 4)), 0.01), "commands of shape"),
        (lambda s, x: s.step(x, np.zeros(4), 0.0), "dt 0.0 s"),
        (lambda s, x: s.start(attitude=np.zeros(3)), "shapes"),
        (lambda s, x: s.start(dt=float("nan")), "dt nan s"),
    ],
)
def test_what_does_not_fit_is_refused(call: Any, said: str) -> None:
    simulator = Simulator(PELICAN)
    with pytest.raises(WindowError, match=said):
        call(simulator, simulator.start(dt=0.01))


def test_files_that_need_more_say_so() -> None:
    with pytest.raises(ParameterError, match="battery_sag without a length"):
        Simulator(craft({"battery_sag": {"fraction": 0.1}}))
    with pytest.raises(ParameterError, match="parameter vectors of shape"):
        Simulator(PELICAN, np.zeros((2, 3)))
    with pytest.raises(ParameterError, match="not negative"):
        RandomInputs(force=(-1.0, 0.0, 0.0))
    delayed = Simulator(craft({"command_delay": {"delay": 0.02}}))
    with pytest.raises(WindowError, match="one step size"):
        delayed.step(delayed.start(dt=0.01), np.full(4, 400.0), 0.005)
    assert quadid.Simulator is Simulator


def test_a_state_of_other_vehicles_is_refused_and_commands_need_not_lie_in_a_row() -> None:
    """The kernel would read beyond the parameters of the smaller batch."""
    one = Simulator(PELICAN)
    thetas = np.tile(Layout(PELICAN).initial(PELICAN), (40, 1))
    late = Simulator(craft({"command_delay": {"delay": 0.05}, "attitude_delay": {"delay": 0.03}}))
    for simulator, other in ((one, late), (late, one)):  # remembers more, or less, than the simulator would
        with pytest.raises(WindowError, match="a state of other delays"):
            simulator.step(other.start(dt=0.01), np.full(4, 400.0), 0.01)
    many, hexacopter = Simulator(PELICAN, thetas), Simulator(Vehicle.shipped("hexacopter"))
    for other in (many, hexacopter):
        with pytest.raises(WindowError, match="a state of"):
            one.step(other.start(dt=0.01), np.full(4, 400.0), 0.01)
    rows = np.repeat(speeds(PELICAN, 4), 2, axis=1)
    apart, dense = one.start(dt=0.01), one.start(dt=0.01)
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(one)).run(apart, rows[:, ::2], 0.01), one.run(dense, rows[:, ::2].copy(), 0.01)
    )


def test_a_state_flies_on_with_another_simulator_and_its_copy_likewise() -> None:
    """Work data of a step beside the state belong to one simulator, one step size and one state."""
    light, heavy = Vehicle.shipped("pelican"), Vehicle.shipped("pelican").model_copy(update={"mass": 2.0})
    command = light.hover_speed() * np.array([1.02, 0.99, 1.01, 0.98])
    first, second = Simulator(light), Simulator(heavy)
    state = first.start(dt=0.005)
    for simulator, dt in ((first, 0.005), (second, 0.005), (first, 0.01), (first, 0.005)):
        copied = state.copy()
        simulator.advance(state, command, dt)
        simulator.advance(copied, command, dt)
        np.testing.assert_array_equal(state.motion, copied.motion)
    alone = second.start(dt=0.005)
    fresh = Simulator(heavy)
    for _ in range(3):
        second.advance(alone, command, 0.005)
    again = fresh.start(dt=0.005)
    for _ in range(3):
        again = fresh.step(again, command, 0.005)
    np.testing.assert_array_equal(alone.motion, again.motion)
    assert alone.motion.shape == (1, 17)
