"""Speed of the simulation: the kernel in nanoseconds per particle-step, against NumPy and the processor's peak; a step.

One particle-step is one parameter vector simulated over one sample at 50 Hz: rotors, Runge-Kutta step, sensors,
residual.  Times are the best of many short runs, in rounds over all cases, since other programs only ever add to them.
The NumPy step does the nominal model's step alone, vectorised over particles, and is checked against the kernel first.
"""

import functools
import importlib.util
import os
import time
from collections.abc import Callable, Collection, Mapping
from itertools import product
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.model import layout as ix
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout, Segments
from quadid.model.simd import LANES, aligned, lane_kernel, whole
from quadid.model.step import RandomInputs, Simulator
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

SECONDS, RATE, LENGTH, CHANNELS = 40, 50, 50, 9
PEAK_ROUNDS, PEAK_CHAINS, PEAK_DEPTH = 2000, 12, 16
NOMINAL_OPERATIONS = 190 + 35
"""Additions, multiplications and fused pairs per particle in the compiled nominal step and comparison."""


class Case(NamedTuple):
    """Something to be timed: `run` does `steps` particle-steps (or operations)."""

    steps: int
    run: Callable[[], object]


def recorded(vehicle: Vehicle) -> Window:
    """A window of lively rotor speeds and noise for measurements: the kernel's speed does not depend on values."""
    rng = np.random.default_rng(1)
    n = SECONDS * RATE
    rotor_speed = vehicle.hover_speed() * (1.0 + 0.02 * rng.standard_normal((n, len(vehicle.rotors))))
    gyro, accel = 0.1 * rng.standard_normal((2, n, 3))
    return Window(0.0, 1.0 / RATE, rotor_speed, gyro, np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), accel)


def particles(vehicle: Vehicle, m: int) -> FloatArray:
    """Parameter vectors scattered about the vehicle file's, shape (m, size)."""
    rng = np.random.default_rng(2)
    thetas = np.tile(Layout(vehicle).initial(vehicle), (m, 1))
    thetas[:, :6] *= np.exp(0.1 * rng.standard_normal((m, 6)))
    return thetas


def free(thetas: FloatArray, *entries: tuple[int, float]) -> FloatArray:
    """Parameter vectors with each of these effects at its own value in every one."""
    rng = np.random.default_rng(3)
    out = thetas.copy()
    for index, size in entries:
        out[:, index] = size * rng.uniform(0.5, 1.5, len(out))
    return out


def every_effect(vehicle: Vehicle, thetas: FloatArray) -> FloatArray:
    """Parameter vectors with all effects of the catalogue."""
    entries = Layout(vehicle).entries.values()
    return free(thetas, *((e.index, e.typical) for e in entries if e.index > ix.JR and not e.name.endswith(".time")))


def model_cases(vehicle: Vehicle, thetas: FloatArray, score: bool) -> tuple[Case, Case]:
    """Residuals (`roll` into memory in use) or the swarm's cost (`costs`), on one core and on all."""
    rollout = Rollout(recorded(vehicle), vehicle)
    segments = Segments.cut(len(rollout), LENGTH)
    x0 = rollout.initial_states(segments)
    steps = len(segments.starts) * (LENGTH + 1)
    weights = np.ones((len(rollout), CHANNELS))
    shape = (len(segments.starts), LENGTH * CHANNELS, 6)
    basis = np.linalg.qr(np.random.default_rng(4).standard_normal(shape))[0]

    def case(vectors: FloatArray) -> Case:
        if score:
            return Case(steps * len(vectors), lambda: rollout.costs(segments, vectors, x0, weights, basis))
        out = rollout.roll(segments, vectors, x0)
        return Case(steps * len(vectors), lambda: rollout.roll(segments, vectors, x0, out=out))

    return case(thetas[:LANES]), case(thetas)  # a single block of lanes stays on the calling thread


# --- the same nominal step in NumPy


def numpy_step(x: FloatArray, theta: FloatArray, moments: FloatArray, mass: float, dt: float) -> FloatArray:
    """One Runge-Kutta step of attitude and rate, Eqs. 1 and 9, all particles at once.

    Args:
        x: quaternion and rate, shape (7, particles); advanced in place.
        theta: b, d, J_xx, J_yy, J_zz, J_r, shape (6, particles).
        moments: sums over rotors of omega^2, x omega^2, y omega^2, spin omega^2, spin omega.
        mass: mass [kg].
        dt: step [s].

    Returns:
        Specific force along z [m/s^2], shape (particles,).
    """
    b, d, jx, jy, jz, jr = theta
    roll, pitch, yaw, spin = -b * moments[2], b * moments[1], d * moments[3], jr * moments[4]

    def slope(y: FloatArray) -> FloatArray:
        w, i, j, k, p, q, r = y
        return np.stack(
            [
                -0.5 * (i * p + j * q + k * r),
                0.5 * (w * p + j * r - k * q),
                0.5 * (w * q + k * p - i * r),
                0.5 * (w * r + i * q - j * p),
                ((jy - jz) * q * r + roll + spin * q) / jx,
                ((jz - jx) * p * r + pitch - spin * p) / jy,
                ((jx - jy) * p * q + yaw) / jz,
            ]
        )

    k1 = slope(x)
    k2 = slope(x + 0.5 * dt * k1)
    k3 = slope(x + 0.5 * dt * k2)
    k4 = slope(x + dt * k3)
    x += dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    x[:4] *= 1.5 - 0.5 * np.sum(x[:4] ** 2, axis=0)
    return np.asarray(-b * moments[0] / mass)


def numpy_case(vehicle: Vehicle, thetas: FloatArray) -> Case:
    """The NumPy step, once it has been checked against the kernel."""
    window, theta = recorded(vehicle), np.ascontiguousarray(thetas[:, :6].T)
    speeds, (x, y, _) = window.rotor_speed, vehicle.rotor_positions.T
    square, spins = speeds**2, vehicle.spins
    moments = np.column_stack([square.sum(axis=1), square @ x, square @ y, square @ spins, speeds @ spins])
    rollout, segments = Rollout(window, vehicle), Segments(LENGTH, 1, np.array([1]))
    start = rollout.initial_states(segments)

    def stepped(steps: int) -> FloatArray:
        states = np.tile(start[0, :7, None], (1, len(thetas)))
        for k in range(steps):
            numpy_step(states, theta, moments[k], vehicle.mass, window.dt)
        return states

    ends = rollout.roll(segments, thetas, start)[1]
    ends = np.moveaxis(ends, -1, 1).reshape(-1, *ends.shape[1:3])[: len(thetas), 0, :7]
    worst = float(np.abs(ends - stepped(LENGTH + 1).T).max())
    if worst > 1e-9:
        raise AssertionError(f"NumPy and the kernel differ by {worst:g}")
    return Case(20 * len(thetas), lambda: stepped(20))


# --- the processor's peak


def peak_case() -> Case:
    """Fused multiply-adds of float64 on one core: independent chains that stay in registers."""
    scope: dict[str, object] = {"lane_kernel": lane_kernel}
    lines = [
        "def peak(rounds, a, x):",
        "    lane_kernel()",
        "    for _ in range(rounds):",
        "        for lane in range(8):",
    ]
    lines += [f"            c{j} = x[{8 * j} + lane]" for j in range(PEAK_CHAINS)]
    lines += [f"            c{j} = c{j} * a + 0.5" for _ in range(PEAK_DEPTH) for j in range(PEAK_CHAINS)]
    lines += [f"            x[{8 * j} + lane] = c{j}" for j in range(PEAK_CHAINS)]
    exec("\n".join(lines), scope)  # written out, because there are no loops over registers
    peak = nb.njit(**whole)(scope["peak"])
    x = aligned((8 * PEAK_CHAINS,))
    x[:] = 0.0
    return Case(PEAK_ROUNDS * PEAK_CHAINS * PEAK_DEPTH * 8, lambda: peak(PEAK_ROUNDS, 0.5, x))


# --- The tables


SLICE, TURNS = 0.01, 10
"""Time a case runs in one turn [s], and turns in a round.

The best run of a turn counts; told are the best and quartiles over turns.  On one core that is processor time, so that
other programs only take cache and memory from a run; on both it is time by the clock, which they add to.
"""


def shortest(cases: Mapping[str, Case], turns: int, by_clock: Collection[str] = ()) -> dict[str, dict[str, float]]:
    """Nanoseconds per particle-step of each case, all run in turn; of those `by_clock` by the clock."""
    seen: dict[str, list[float]] = {name: [] for name in cases}
    for turn in range(turns + 1):
        for name, case in cases.items():
            clock = time.perf_counter if name in by_clock else time.thread_time
            end, best = time.perf_counter() + SLICE, np.inf
            while time.perf_counter() < end:
                begin = clock()
                case.run()
                best = min(best, clock() - begin)
            if turn:  # the first one warms up
                seen[name].append(1e9 * best / case.steps)
    quartiles = {name: np.percentile(ns, [50, 25, 75, 0]).tolist() for name, ns in seen.items()}
    return {name: dict(zip(("median", "low", "high", "least"), q, strict=True)) for name, q in quartiles.items()}


def kernel_table(rounds: int) -> dict[str, Any]:
    """Measures the model without and with effects, NumPy and the peak, in turn."""
    vehicle = Vehicle.shipped("pelican")
    nominal = particles(vehicle, 8 * LANES)
    lines = {
        "nominal": nominal,
        "motor lag, one a particle": free(nominal, (ix.TAU, 0.02)),
        "rotor drag": free(nominal, (ix.KX, 0.2), (ix.KY, 0.2)),
        "every effect": every_effect(vehicle, nominal),
    }
    cases, told = {"peak": peak_case()}, dict[str, tuple[str, str]]()
    for score, line in product((False, True), lines):
        name = line + (", cost" if score else "")
        told[name] = f"{name}, one core", f"{name}, all cores"
        cases |= zip(told[name], model_cases(vehicle, lines[line], score), strict=True)
    for m in (256, 4096):
        cases[f"NumPy, nominal step alone, {m} particles"] = numpy_case(vehicle, particles(vehicle, m))
    found = shortest(cases, TURNS * rounds, [all_cores for _, all_cores in told.values()])
    least = {name: ns["least"] for name, ns in found.items()}
    first, numpy = least["nominal, one core"], {name: ns for name, ns in found.items() if name.startswith("NumPy")}
    return {
        "lanes": LANES,
        "timings": [{"name": n, "one_core": found[one], "all_cores": found[both]} for n, (one, both) in told.items()],
        "numpy": numpy,
        "fma_per_ns": 1.0 / least["peak"],
        "operations": NOMINAL_OPERATIONS,
        "share_of_peak": NOMINAL_OPERATIONS * least["peak"] / first,
        "gain_over_numpy": min(ns["least"] for ns in numpy.values()) / first,
        "extended_over_nominal": least["rotor drag, one core"] / first,
        "every_over_nominal": least["every effect, one core"] / first,
    }


def effect_table(rounds: int) -> dict[str, Any]:
    """The swarm's cost with each effect of the catalogue alone, of another size in every particle, over the nominal."""
    vehicle = Vehicle.shipped("pelican")
    nominal, entries = particles(vehicle, LANES), Layout(vehicle).entries.values()
    vectors = {"nominal": nominal}
    for effect in EFFECTS:
        own = [e for e in entries if e.name.startswith(f"{effect}.") and not e.name.endswith(".time")]
        vectors[effect] = free(nominal, *((e.index, e.typical) for e in own))
    cases = {name: model_cases(vehicle, thetas, True)[0] for name, thetas in vectors.items()}
    least = {name: ns["least"] for name, ns in shortest(cases, TURNS * rounds).items()}
    ratios = {name: ns / least["nominal"] for name, ns in least.items() if name != "nominal"}
    median = float(np.median(list(ratios.values())))
    return {"ns": least, "ratios": ratios, "median": median, "largest": max(ratios, key=lambda name: ratios[name])}


# --- One step of `quadid.Simulator`


DT, BATCH = 0.002, 4096


def fastest(run: Callable[[], object], calls: int) -> float:
    """Shortest time of one call [s], of runs so short that other programs seldom stand in between."""
    shortest = np.inf
    for _ in range(100):
        begin = time.perf_counter()
        for _ in range(calls):
            run()
        shortest = min(shortest, (time.perf_counter() - begin) / calls)
    return float(shortest)


def own_steps() -> dict[str, float]:
    """Time of a step of `quadid.Simulator` [s]."""
    pelican = Vehicle.shipped("pelican")
    hover, one = np.full(4, pelican.hover_speed()), Simulator(pelican)
    state, rows = one.start(dt=DT), np.tile(hover, (1000, 1))
    times: dict[str, float] = {
        "one vehicle, in place": fastest(lambda: one.advance(state, hover, DT), 100),
        "one vehicle, a new state": fastest(lambda: one.step(state, hover, DT), 100),
        "one vehicle, 1000 steps a run": fastest(lambda: one.run(state, rows, DT), 1) / 1000,
    }
    nominal, commands = particles(pelican, BATCH), np.tile(hover, (BATCH, 1))
    random = RandomInputs((0.1, 0.1, 0.1), 1.0, (1.0, 1.0, 1.0), 0.5)
    for name, thetas, extra in (
        ("nominal", nominal, None),
        ("every effect, random inputs", every_effect(pelican, nominal), random),
    ):
        batch = Simulator(pelican, thetas, random=extra, span=60.0)
        flying = batch.start(dt=DT)
        each = fastest(functools.partial(batch.advance, flying, commands, DT), 1) / BATCH
        times[f"{BATCH} vehicles, {name}, each"] = each
    return times


def rotorpy_steps() -> dict[str, float]:
    """Time of one step of RotorPy's Hummingbird [s]."""
    from rotorpy.vehicles.hummingbird_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    craft = Multirotor(quad_params)
    state, control = craft.initial_state, {"cmd_motor_speeds": np.full(4, 350.0)}
    return {"RotorPy, one vehicle": fastest(lambda: craft.step(state, control, DT), 1)}


def crazyflow_steps() -> dict[str, float]:
    """Time of a step of crazyflow [s], one vehicle, and each of a batch; float32, Runge-Kutta of fourth order."""
    from crazyflow.control import Control
    from crazyflow.dynamics import Dynamics
    from crazyflow.sim import Sim
    from crazyflow.sim.integration import Integrator

    times, how = {}, {"dynamics": Dynamics.first_principles, "control": Control.rotor_vel, "integrator": Integrator.rk4}
    for n, name in ((1, "one vehicle"), (BATCH, f"{BATCH} vehicles, each")):
        sim = Sim(n, 1, freq=500, **how)
        sim.rotor_vel_control(np.full((n, 1, 4), 15000.0))

        def step(sim: Any = sim) -> None:
            sim.step()
            sim.data.states.pos.block_until_ready()

        step()
        times[f"crazyflow, {name}"] = fastest(step, 1) / n
    return times


def pybullet_steps() -> dict[str, float]:
    """Time of a step of gym-pybullet-drones [s], by the engine and by its own equations."""
    from gym_pybullet_drones.envs.CtrlAviary import CtrlAviary
    from gym_pybullet_drones.utils.enums import Physics

    times = {}
    for physics in (Physics.PYB, Physics.DYN):
        flown = CtrlAviary(physics=physics, pyb_freq=500, ctrl_freq=500, gui=False)
        flown.reset()
        action = np.full((1, 4), flown.HOVER_RPM)
        times[f"gym-pybullet-drones, one vehicle, {physics.value}"] = fastest(functools.partial(flown.step, action), 10)
        flown.close()
    return times


STEPS = {
    "quadid": own_steps,
    "rotorpy": rotorpy_steps,
    "crazyflow": crazyflow_steps,
    "gym_pybullet_drones": pybullet_steps,
}


def step_table() -> dict[str, Any]:
    """Seconds of a step of one vehicle and of batches on one core, beside those of other simulators that are there."""
    cores, times = os.sched_getaffinity(0), dict[str, float]()
    absent = [name for name in STEPS if importlib.util.find_spec(name) is None]
    os.sched_setaffinity(0, {max(cores)})
    try:
        for name, steps in STEPS.items():
            times |= {} if name in absent else steps()
    finally:
        os.sched_setaffinity(0, cores)
    return {"times": times, "absent": absent}
