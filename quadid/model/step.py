"""Simulator of the identified vehicle: stepped, one vehicle or a batch of them, or flown along rotor speeds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import ParameterError, WindowError
from quadid.model import layout as ix
from quadid.model.body_kernel import N_SIGNALS, residual_coefficients, residual_forces, residual_signals, step_in_air
from quadid.model.kernel import Flight, Needs, body_constants, flight_factors, load_payload, needs_of
from quadid.model.layout import Layout, residual_terms
from quadid.model.rollout import hub_geometry
from quadid.model.rotor_kernel import input_constants, rotor_constants, turn_rotor
from quadid.model.sensor_kernel import (
    delay_attitude,
    distort_imu,
    sensor_constants,
    step_filter,
    step_tilt_error,
    tilt_attitude,
)
from quadid.model.simd import LANES, cached, jit
from quadid.types import BoolArray, FloatArray, IntArray
from quadid.vehicle import RandomForces, Vehicle

# isort: off
from quadid.model.work_array import (
    A_G, C_SHIFT, E_QW, F1_X, F2_X, G_BEND, G_DF, G_F, G_F0, G_FM, G_W, G_W0, HALF, N_QW, N_ROWS, N_STATE, ROTOR,
    R_NEXT, R_NOW, R_PAST, R_SPEED, S_BENDX, S_FX, S_P, S_QW, T_A1, X_D, X_E, X_N, X_P, X_Q, X_QW, X_QX, X_QY, X_QZ,
    X_R, X_VD, X_VE, X_VN,
)  # fmt: skip
# isort: on

# --- Steps of the simulation for a batch of vehicles, each with a state and a command of its own
#
# Rotors, body and sensors are those of `quadid.model.rollout_kernel`.  Sensors are read at the end of a step, from what
# has happened by then: the accelerometer is the mean over the step that ends there, and the filters work on that.


STATE = X_QW
"""First row that belongs to the state; those before are constants and sums of one step."""
SENSED = S_QW
TURNS = 6
"""Random numbers of a lane and step: specific force 3, angular acceleration 3."""


@nb.njit(**jit)
def _scrambled(x: np.uint64) -> np.uint64:
    """Scrambles 64 bits: splitmix64's finaliser (Steele, Lea & Flood 2014, doi:10.1145/2660193.2660195)."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@nb.njit(**jit)
def _random_inputs(seed: int, vehicle: int, step: int, walk: FloatArray, state: FloatArray) -> None:
    """Advances one vehicle's random inputs, first-order Gauss-Markov processes, by a step.

    The numbers follow from seed, vehicle and step alone (a counter, not a stream), so that a step can be repeated.

    Args:
        seed: of all numbers.
        vehicle: place in the batch.
        step: number of the step.
        walk: exp(-dt / T) of each input, and the standard deviation of what a step adds, (2, TURNS).
        state: the inputs (TURNS,), advanced.
    """
    base = _scrambled(np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15) * np.uint64(vehicle + 1))
    for pair in range(TURNS // 2):
        at = base + np.uint64(0x9E3779B97F4A7C15) * np.uint64(TURNS * step + 2 * pair + 1)
        first = (float(_scrambled(at) >> np.uint64(11)) + 0.5) * 2.0**-53
        second = float(_scrambled(at + np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(11)) * 2.0**-53
        radius, angle = math.sqrt(-2.0 * math.log(first)), 2.0 * math.pi * second  # Box & Muller 1958
        for i in range(2):
            normal = radius * (math.cos(angle) if i == 0 else math.sin(angle))
            at_i = 2 * pair + i
            state[at_i] = walk[0, at_i] * state[at_i] + walk[1, at_i] * normal


@nb.njit(**jit)
def _push(dt: float, inputs: FloatArray, s: FloatArray) -> None:
    """Lets random specific force and angular acceleration (TURNS, LANES) act over a step that has just been made."""
    for lane in range(LANES):
        fx, fy, fz = inputs[0, lane], inputs[1, lane], inputs[2, lane]
        qw, qx, qy, qz = s[X_QW + lane], s[X_QX + lane], s[X_QY + lane], s[X_QZ + lane]
        n = (qw * qw + qx * qx - qy * qy - qz * qz) * fx + 2.0 * ((qx * qy - qw * qz) * fy + (qx * qz + qw * qy) * fz)
        e = (qw * qw - qx * qx + qy * qy - qz * qz) * fy + 2.0 * ((qx * qy + qw * qz) * fx + (qy * qz - qw * qx) * fz)
        d = (qw * qw - qx * qx - qy * qy + qz * qz) * fz + 2.0 * ((qx * qz - qw * qy) * fx + (qy * qz + qw * qx) * fy)
        s[X_VN + lane] += dt * n
        s[X_VE + lane] += dt * e
        s[X_VD + lane] += dt * d
        s[X_N + lane] += 0.5 * dt * dt * n
        s[X_E + lane] += 0.5 * dt * dt * e
        s[X_D + lane] += 0.5 * dt * dt * d
        p, q, r = dt * inputs[3, lane], dt * inputs[4, lane], dt * inputs[5, lane]
        s[X_P + lane] += p
        s[X_Q + lane] += q
        s[X_R + lane] += r
        a, b, c = 0.25 * dt * p, 0.25 * dt * q, 0.25 * dt * r  # half the angle that half the change of rate makes
        s[X_QW + lane] = qw - qx * a - qy * b - qz * c
        s[X_QX + lane] = qx + qw * a + qy * c - qz * b
        s[X_QY + lane] = qy + qw * b + qz * a - qx * c
        s[X_QZ + lane] = qz + qw * c + qx * b - qy * a
        for first in (F1_X, F2_X):
            s[first + lane] += fx
            s[first + LANES + lane] += fy
            s[first + 2 * LANES + lane] += fz


@nb.njit(**jit)
def _read_sensors(first: bool, dt: float, need: Needs, s: FloatArray, past: FloatArray) -> None:
    """Writes what the sensors read at the end of a step: rows S_QW to S_FZ.

    Args:
        first: no step has been made before; filters begin settled.
        dt: step [s].
        need: which parts of the model any lane needs.
        s: rows.
        past: attitude and rate at the ends of the last steps, (rows, 7, LANES), the newest last; moved on.
    """
    if need.ahrs:  # needs the attitude at both ends of the step
        step_tilt_error(s)
        for i in range(4 * LANES):
            s[E_QW + i] = s[N_QW + i]
    for i in range(7 * LANES):
        s[S_QW + i] = s[X_QW + i]
    for i in range(3 * LANES):
        s[S_FX + i] = 0.5 * (s[F1_X + i] + s[F2_X + i])
    if need.imu_lag:
        for i in range(3 * LANES):
            if first:
                s[G_F + i], s[G_DF + i], s[G_F0 + i] = s[S_FX + i], 0.0, s[S_FX + i]
            s[G_BEND + i], s[G_FM + i] = s[S_BENDX + i], 0.5 * (s[G_F0 + i] + s[S_FX + i])
        step_filter(dt, s)
        for i in range(3 * LANES):
            s[G_W0 + i], s[G_F0 + i] = s[S_P + i], s[S_FX + i]
            s[S_P + i], s[S_FX + i] = s[G_W + i], s[G_F + i]
    if need.att_delay:
        newest = len(past) - 1
        for i in range(newest):
            for row in range(7):
                for lane in range(LANES):
                    past[i, row, lane] = past[i + 1, row, lane]
        for row in range(7):
            for lane in range(LANES):
                past[newest, row, lane] = s[X_QW + row * LANES + lane]
        delay_attitude(newest, dt, past, s)
    if need.ahrs:
        tilt_attitude(s)
    if need.imu_static:
        distort_imu(s)


@cached
def write_constants(
    theta: FloatArray, flight: Flight, coefficients: FloatArray, constants: FloatArray, rot: FloatArray
) -> None:
    """Writes the constants of all blocks.

    Args:
        theta: parameter vectors (blocks, LANES, size).
        flight: numbers of the vehicle, and the step.
        coefficients: of the terms beyond the catalogue, (blocks, terms, LANES), written.
        constants: rows (blocks, STATE), written.
        rot: rows of the rotors (blocks, rotors, ROTOR); gains written.
    """
    for block in range(len(theta)):
        s = np.zeros(N_ROWS * LANES)
        for half in range(2):
            for i in range(2 * LANES):
                s[A_G + half * HALF + i] = 1.0
        body_constants(theta[block], flight, rot.shape[1], s)
        input_constants(theta[block], s)
        sensor_constants(theta[block], flight.dt, s)
        rotor_constants(theta[block], flight.dt, rot[block], s)
        residual_coefficients(theta[block], rot.shape[1], coefficients[block])
        constants[block] = s[:STATE]


@cached
def step_blocks(
    commands: FloatArray, geometry: FloatArray, theta: FloatArray, terms: IntArray, coefficients: FloatArray,
    needs: BoolArray, constants: FloatArray, walk: FloatArray, time: float, span: float, dt: float, seed: int,
    step: int, delayed: int, s: FloatArray, state: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Makes one step a row of commands with every vehicle of a batch.

    Args:
        commands: rotor speeds [rad/s], held over each step, (steps, vehicles, rotors).
        geometry: (rotors, 4), see `rotor_kernel.Drive`.
        theta: parameter vectors (blocks, LANES, size).
        terms: beyond the catalogue, (terms, 4).
        coefficients: of those, (blocks, terms, LANES).
        needs: which parts of the model any vehicle needs, in the order of `Needs`.
        constants: rows of each block, (blocks, STATE); one row for all blocks stands in `s` already.
        walk: of the random inputs, exp(-dt / T) and the standard deviation of what a step adds, (2, TURNS); no rows
            where there are none.
        time: at the start of the first step [s].
        span: time over which a battery sags [s].
        dt: step [s].
        seed: of the random inputs.
        step: number of steps made before.
        delayed: commands that are remembered.
        s: work array (N_ROWS * LANES), overwritten.
        state: motion and filters, rotors, last commands, past attitudes, random inputs (blocks, width), advanced;
            see `quadid.model.step.State`.
        out: after each step (steps, vehicles, N_STATE + 10), written: motion, sensors; no rows: not wanted.
    """
    count, rotors = commands.shape[1], commands.shape[2]
    need = Needs(
        needs[0], needs[1], needs[2], needs[3], needs[4], needs[5], needs[6], needs[7], needs[8], needs[9],
        needs[10], needs[11], needs[12], needs[13], needs[14], needs[15], needs[16],
    )  # fmt: skip
    plain = not (need.delayed or need.uneven)
    sensing = need.imu_lag or need.ahrs or need.learned
    moving = N_ROWS * LANES - STATE if sensing else SENSED + 10 * LANES - STATE
    own, signals = np.empty(TURNS), np.empty((N_SIGNALS, LANES))
    newest = delayed - 1
    at_rotors = N_ROWS * LANES - STATE
    at_sent = at_rotors + rotors * ROTOR
    at_inputs = at_sent + delayed * rotors * LANES
    at_past = at_inputs + TURNS * LANES
    for block in range(len(state)):
        now = state[block]
        rot = now[at_rotors:at_sent].reshape(rotors, ROTOR)
        sent = now[at_sent:at_inputs].reshape(delayed, rotors, LANES)
        inputs = now[at_inputs:at_past].reshape(TURNS, LANES)
        past = now[at_past:].reshape(-1, 7, LANES)
        if len(constants) > 1:
            for i in range(STATE):
                s[i] = constants[block, i]
        for i in range(moving):
            s[STATE + i] = now[i]
        first, last = block * LANES, count - 1
        for k in range(len(commands)):
            if not plain:
                for i in range(newest):
                    for r in range(rotors):
                        for lane in range(LANES):
                            sent[i, r, lane] = sent[i + 1, r, lane]
                for r in range(rotors):
                    for lane in range(LANES):
                        sent[newest, r, lane] = commands[k, min(first + lane, last), r]
            for r in range(rotors):
                if plain:
                    for lane in range(LANES):
                        s[T_A1 + lane] = commands[k, min(first + lane, last), r]
                else:
                    for lane in range(LANES):
                        at = newest - int(s[C_SHIFT + lane])
                        rot[r, R_PAST + lane], rot[r, R_NOW + lane] = sent[at - 1, r, lane], sent[at, r, lane]
                        rot[r, R_NEXT + lane] = sent[at, r, lane]
                turn_rotor(plain, r, True, False, geometry, dt, need, rot, s)
            begin = time + k * dt
            if need.factors:
                flight_factors(begin, 0.0, span, dt, s)
            if need.payload:
                load_payload(begin, dt, theta[block], s)
            if need.learned:
                residual_signals(s, signals)
                residual_forces(terms, coefficients[block], signals, step + k == 0, s)
            step_in_air(need, dt, s)
            if len(walk) > 0:
                for lane in range(min(LANES, count - first)):
                    for i in range(TURNS):
                        own[i] = inputs[i, lane]
                    _random_inputs(seed, first + lane, step + k, walk, own)
                    for i in range(TURNS):
                        inputs[i, lane] = own[i]
                _push(dt, inputs, s)
            _read_sensors(step + k == 0, dt, need, s, past)
            if len(out) > 0:
                for lane in range(min(LANES, count - first)):
                    for i in range(N_STATE):
                        out[k, first + lane, i] = s[X_QW + i * LANES + lane]
                    for i in range(10):
                        out[k, first + lane, N_STATE + i] = s[SENSED + i * LANES + lane]
        for i in range(moving):
            now[i] = s[STATE + i]


@cache
def compiled_steps() -> Any:
    """Machine code of `step_blocks`, contiguous arrays only: numba's look at 17 types takes a fifth of a step."""
    row, table, rows = "f8[::1],", "f8[:,::1],", "f8[:,:,::1],"
    arrays = rows + table + rows + "i8[:,::1]," + rows + "b1[::1]," + table + table
    return step_blocks.compile(f"void({arrays}f8,f8,f8,i8,i8,i8,{row}{table}f8[:,:,::1])")


# --- Simulator of the identified vehicle: stepped, one vehicle or a batch of them, or flown along rotor speeds


# --- The identified vehicle as a simulator to be stepped, one vehicle or a batch of them
#
#     simulator = Simulator(vehicle)
#     state = simulator.start(position=np.array([0.0, 0.0, -2.0]))
#     while flying:
#         state = simulator.step(state, controller(state), 0.005)


LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STILL = np.zeros(3)
_NO_OUT, _NO_WALK = np.empty((0, 0, 0)), np.empty((0, TURNS))
_NO_CONSTANTS = np.empty((0, STATE))
_ROTORS_AT = N_ROWS * LANES - STATE
"""First number of the rotors in the memory of a block."""


@dataclass(frozen=True)
class RandomInputs:
    """Random specific force and angular acceleration in body axes, first-order Gauss-Markov processes.

    Attributes:
        force: standard deviations of the specific force [m/s^2], (x, y, z).
        force_time: its correlation time [s].
        turn: standard deviations of the angular acceleration [rad/s^2], (x, y, z).
        turn_time: its correlation time [s].
    """

    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    force_time: float = 1.0
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_time: float = 1.0

    @property
    def each_axis(self) -> FloatArray:
        """Standard deviations and correlation times of force x, y, z and turn x, y, z, shape (2, 6)."""
        return np.array([[*self.force, *self.turn], np.repeat([self.force_time, self.turn_time], 3)])

    def __post_init__(self) -> None:
        for name in ("force", "turn"):
            values, time = getattr(self, name), getattr(self, f"{name}_time")
            if min(values) < 0.0 or not np.isfinite(values).all():
                raise ParameterError(f"random {name} {values}", "three standard deviations, not negative")
            if not 0.0 < time < math.inf:
                raise ParameterError(f"random {name}_time {time} s", "a positive time")


@dataclass(eq=False, slots=True)
class State:
    """Everything that decides how vehicles fly on: motion, rotors, commands on their way, filters, random inputs.

    World NED, body FRD; arrays have a row a vehicle.  `Simulator.step` returns a new one, `Simulator.advance` changes
    one in place.

    Attributes:
        time: [s].
        steps: how many steps led here.
        vehicles: how many there are.
    """

    time: float
    steps: int
    vehicles: int
    _memory: FloatArray
    _rotors: int
    _dt: float
    _work: FloatArray
    _constants: FloatArray

    def copy(self) -> State:
        """Returns a state that changes no more with this one."""
        kept, none = self._memory.copy(), _NO_CONSTANTS
        return State(self.time, self.steps, self.vehicles, kept, self._rotors, self._dt, none, none)

    def _read(self, row: int, count: int) -> FloatArray:
        rows = self._memory[:, row - STATE : row - STATE + count * LANES].reshape(-1, count, LANES)
        return rows.transpose(0, 2, 1).reshape(-1, count)[: self.vehicles]

    @property
    def attitude(self) -> FloatArray:
        """True attitude, unit quaternions wxyz, body to world, shape (vehicles, 4)."""
        return self._read(X_QW, 4)

    @property
    def rate(self) -> FloatArray:
        """True rate [rad/s], shape (vehicles, 3)."""
        return self._read(X_P, 3)

    @property
    def velocity(self) -> FloatArray:
        """True velocity [m/s], shape (vehicles, 3)."""
        return self._read(X_VN, 3)

    @property
    def position(self) -> FloatArray:
        """True position [m], shape (vehicles, 3)."""
        return self._read(X_N, 3)

    @property
    def motion(self) -> FloatArray:
        """Attitude, rate, velocity, position, rotor speeds: the states of `quadid.symbolic`, shape (vehicles, 13 + N).

        A file without `motor_lag` has no rotor states there: its first 13 columns.
        """
        return np.hstack([self._read(X_QW, N_STATE), self.rotor_speed])

    @property
    def rotor_speed(self) -> FloatArray:
        """True rotor speeds [rad/s], shape (vehicles, rotors)."""
        rot = self._memory[:, _ROTORS_AT : _ROTORS_AT + self._rotors * ROTOR].reshape(-1, self._rotors, ROTOR)
        return rot[:, :, R_SPEED : R_SPEED + LANES].transpose(0, 2, 1).reshape(-1, self._rotors)[: self.vehicles]

    @property
    def gyro(self) -> FloatArray:
        """Rate as the gyro reads it [rad/s], shape (vehicles, 3)."""
        return self._read(S_P, 3)

    @property
    def accel(self) -> FloatArray:
        """Specific force as the accelerometer reads it [m/s^2], the mean over the last step, shape (vehicles, 3)."""
        return self._read(S_FX, 3)

    @property
    def reported_attitude(self) -> FloatArray:
        """Attitude as the attitude estimator reports it, quaternions wxyz, shape (vehicles, 4)."""
        return self._read(S_QW, 4)


class Simulator:
    """Simulates a vehicle file, effects included, step by step; the equations are those of the fit.

    Attributes:
        vehicle: the file.
        vehicles: size of the batch.
        random: random inputs that act beside the model.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        theta: FloatArray | None = None,
        *,
        random: RandomInputs | RandomForces | None = None,
        seed: int = 0,
        span: float = math.inf,
    ) -> None:
        """Prepares the simulation.

        Args:
            vehicle: as read from a (fitted, extended) vehicle file.
            theta: full parameter vectors of a batch instead of the file's values, shape (vehicles, size), see
                `quadid.model.layout.Layout`.
            random: random inputs, such as `vehicle.random`; none by default.
            seed: decides them.
            span: length of the flight [s], over which `battery_sag` takes its share.

        Raises:
            ParameterError: vectors that are not finite or of another size, or a sagging battery without a span.
        """
        layout = Layout(vehicle)
        points = layout.initial(vehicle)[None] if theta is None else np.atleast_2d(np.asarray(theta, dtype=np.float64))
        if points.ndim != 2 or points.shape[1] != layout.size or not np.isfinite(points).all():
            raise ParameterError(f"parameter vectors of shape {points.shape}", f"finite, (vehicles, {layout.size})")
        if points[:, ix.SAG].any() and not math.isfinite(span):
            raise ParameterError("battery_sag without a length of the flight", "span in seconds", "pass span=")
        self.vehicle, self.vehicles, self.random = vehicle, len(points), random
        blocks = -(-len(points) // LANES)
        self._theta = np.repeat(points[-1:], blocks * LANES, axis=0)
        self._theta[: len(points)] = points
        self._theta[:, ix.TELEMETRY] = 0.0  # late readings are no part of what rotors do
        self._theta = self._theta.reshape(blocks, LANES, -1)
        self._geometry, self._hub, self._plan, self._reach = hub_geometry(vehicle)
        flat = self._theta.reshape(blocks * LANES, -1)
        self._need: Needs = needs_of(flat, len(vehicle.rotors), 15)
        self._needs = np.array(self._need, dtype=np.bool_)
        self._alike = bool((flat == flat[0]).all())
        self._terms = residual_terms(vehicle)
        self._coefficients = np.empty((blocks, len(self._terms), LANES))
        self._seed, self._span = seed, min(span, 1e9)
        self._dt, self._constants, self._walk, self._delayed = 0.0, _NO_CONSTANTS, _NO_WALK, 2
        self._each = (self.vehicles, len(self._geometry))

    def start(
        self,
        *,
        attitude: ArrayLike = LEVEL,
        rate: ArrayLike = STILL,
        velocity: ArrayLike = STILL,
        position: ArrayLike = STILL,
        rotor_speed: ArrayLike | None = None,
        time: float = 0.0,
        inputs: ArrayLike = 0.0,
        dt: float = 0.005,
    ) -> State:
        """Returns a state to start from; each argument for one vehicle, or with a row a vehicle.

        Args:
            attitude: quaternion wxyz, body to world.
            rate: [rad/s], body.
            velocity: [m/s], NED.
            position: [m], NED.
            rotor_speed: [rad/s]; hover by default.
            time: [s].
            inputs: random specific force [m/s^2] and angular acceleration [rad/s^2] that act already, body, 6 numbers.
            dt: step that is meant to be made [s]; `step` may be given another.

        Raises:
            WindowError: a step that is not positive, or shapes that do not fit.
        """
        n, rotors, blocks = self.vehicles, len(self.vehicle.rotors), len(self._theta)
        speed = self.vehicle.hover_speed() if rotor_speed is None else rotor_speed
        wanted = ((attitude, 4), (rate, 3), (velocity, 3), (position, 3), (speed, rotors), (inputs, TURNS))
        try:
            given = [np.broadcast_to(np.asarray(v, dtype=np.float64), (n, width)) for v, width in wanted]
        except ValueError as error:
            shapes = ", ".join(str(np.shape(v)) for v, _ in wanted)
            raise WindowError(f"shapes {shapes}", f"4, 3, 3, 3, {rotors}, {TURNS}, or with {n} rows") from error
        motion = np.concatenate([given[0] / np.linalg.norm(given[0], axis=1)[:, None], *given[1:4]], axis=1)
        rot = self._settle(dt)
        late = math.ceil(max(float(self._theta[..., ix.ATT_DELAY].max()), 0.0) / dt) + 2
        rows, speeds = _in_lanes(motion, blocks), _in_lanes(given[4], blocks)
        moving = np.zeros((blocks, N_ROWS * LANES))
        moving[:, X_QW : X_QW + N_STATE * LANES] = rows.reshape(blocks, -1)
        for row in (S_QW, G_W, G_W0):
            part = rows[:, :7] if row == S_QW else rows[:, 4:7]
            moving[:, row : row + part.shape[1] * LANES] = part.reshape(blocks, -1)
        moving[:, E_QW : E_QW + LANES] = 1.0
        rot[:, :, R_SPEED : R_SPEED + LANES] = speeds
        memory = (
            moving[:, STATE:],
            rot,
            np.repeat(speeds[:, None], self._delayed, axis=1),
            _in_lanes(given[5], blocks),
            np.repeat(rows[:, None, :7], late, axis=1),
        )
        kept, none = np.concatenate([m.reshape(blocks, -1) for m in memory], axis=1), _NO_CONSTANTS
        return State(time, 0, n, kept, rotors, dt, none, none)

    def step(self, state: State, command: ArrayLike, dt: float, voltage: float | None = None) -> State:
        """Returns the state after one step; `state` stays as it is.

        Args:
            state: from `start` or an earlier step.
            command: rotor speeds [rad/s] that are commanded over the step, shape (rotors,) or (vehicles, rotors).
            dt: step [s]; the integrator is that of the fit, of fourth order.
            voltage: of the supply over its reference, where `supply_voltage` acts; 1 by default.

        Raises:
            WindowError: a shape that does not fit, or a step that is not positive.
        """
        new = state.copy()
        self.advance(new, command, dt, voltage)
        return new

    def advance(self, state: State, command: ArrayLike, dt: float, voltage: float | None = None) -> None:
        """Makes one step in place; arguments as for `step`."""
        given = np.ascontiguousarray(command, dtype=np.float64)
        self._march(state, given[None, None] if given.ndim == 1 else given[None], dt, voltage)

    def run(self, state: State, commands: ArrayLike, dt: float) -> FloatArray:
        """Makes a step a row of commands, in place.

        Args:
            state: advanced.
            commands: rotor speeds [rad/s], shape (steps, rotors) or (steps, vehicles, rotors).
            dt: step [s].

        Returns:
            After each step and of each vehicle: quaternion, rate, velocity, position; then reported attitude, gyro,
            accelerometer; shape (steps, vehicles, 23).
        """
        given = np.ascontiguousarray(commands, dtype=np.float64)
        given = given[:, None] if given.ndim == 2 else given
        out = np.empty((len(given), self.vehicles, N_STATE + 10))
        self._march(state, given, dt, None, out)
        return out

    def _march(
        self, state: State, commands: FloatArray, dt: float, voltage: float | None, out: FloatArray = _NO_OUT
    ) -> None:
        """Makes the steps; the one way into the kernel."""
        if state.vehicles != self.vehicles or state._rotors != self._each[1]:
            found = f"a state of {state.vehicles} vehicles with {state._rotors} rotors"
            raise WindowError(found, f"{self.vehicles} with {self._each[1]}, as the simulator has")
        if commands.shape[1:] != self._each:
            if commands.shape[1:] != (1, self._each[1]):
                raise WindowError(f"commands of shape {commands.shape[1:]}", f"{self._each}")
            commands = np.repeat(commands, self.vehicles, axis=1)
        if dt != state._dt:
            if self._need.delayed or self._need.att_delay:
                raise WindowError(
                    f"dt {dt} s after {state._dt} s",
                    "one step size where commands or attitude are delayed",
                    "begin with start(dt=...)",
                )
            state._dt = dt
        if dt != self._dt:
            self._settle(dt)
        if voltage is not None:
            exponent = self._theta[..., ix.EXPONENT].reshape(-1)[: state.vehicles]
            commands = commands * voltage ** exponent[None, :, None]
        if state._constants is not self._constants:  # a new state or a copy, or another step or simulator than before
            state._work, state._constants = self._prepared.copy(), self._constants
        compiled_steps()(
            commands, self._geometry, self._theta, self._terms, self._coefficients, self._needs, self._constants,
            self._walk, state.time, self._span, dt, self._seed, state.steps, self._delayed, state._work,
            state._memory, out,
        )  # fmt: skip
        state.time += len(commands) * dt
        state.steps += len(commands)

    def _settle(self, dt: float) -> FloatArray:
        """Prepares all that depends on the step; returns rows of the rotors with their gains."""
        if not 0.0 < dt < math.inf:
            raise WindowError(f"dt {dt} s", "a positive step")
        blocks = len(self._theta)
        flight = Flight(self.vehicle.mass, self._reach, self._hub, self._plan, 0.0, dt, 0.0, self._span)
        constants, rot = np.empty((blocks, STATE)), np.zeros((blocks, len(self._geometry), ROTOR))
        write_constants(self._theta, flight, self._coefficients, constants, rot)
        self._constants = constants[:1] if self._alike else constants
        self._prepared = np.concatenate([constants[0], np.zeros(N_ROWS * LANES - STATE)])
        self._delayed = math.floor(max(float(self._theta[..., ix.DELAY].max()), 0.0) / dt) + 2
        if self.random is not None:
            size, time = self.random.each_axis
            keep = np.exp(-dt / time)
            self._walk = np.array([keep, size * np.sqrt(1.0 - keep**2)])
        self._dt = dt
        return rot


def _in_lanes(values: FloatArray, blocks: int) -> FloatArray:
    """Rows (vehicles, width) as (blocks, width, LANES); spare lanes repeat the last vehicle."""
    full = np.repeat(values[-1:], blocks * LANES, axis=0)
    full[: len(values)] = values
    return full.reshape(blocks, LANES, -1).transpose(0, 2, 1)


# --- A flight of the identified vehicle: rotor speeds in, states out; a loop over `Simulator`


@dataclass(frozen=True)
class Trajectory:
    """States after each step; world NED, body FRD.

    Attributes:
        t: times [s], shape (n,); the first is one step after the start.
        attitude: unit quaternions wxyz, body to world, shape (n, 4), scalar part not negative.
        rate: [rad/s], shape (n, 3).
        force: specific force as an accelerometer reads it [m/s^2], mean over the step that ends there, shape (n, 3).
        velocity: [m/s], shape (n, 3).
        position: [m], shape (n, 3).
    """

    t: FloatArray
    attitude: FloatArray
    rate: FloatArray
    force: FloatArray
    velocity: FloatArray
    position: FloatArray


def simulate(
    vehicle: Vehicle,
    rotor_speed: FloatArray,
    dt: float,
    *,
    attitude: FloatArray = LEVEL,
    rate: FloatArray = STILL,
    velocity: FloatArray = STILL,
    position: FloatArray = STILL,
    theta: FloatArray | None = None,
) -> Trajectory:
    """Simulates a vehicle file, effects included, from given rotor speeds.

    Args:
        vehicle: as read from a (fitted, extended) vehicle file.
        rotor_speed: shape (n, rotors) [rad/s]; row k acts from k dt to (k + 1) dt.
        dt: step [s]; the integrator is that of the fit, of fourth order, so 0.02 s is fine.
        attitude: at the start, quaternion wxyz, body to world, shape (4,).
        rate: at the start [rad/s], body, shape (3,).
        velocity: at the start [m/s], NED, shape (3,).
        position: at the start [m], NED, shape (3,).
        theta: full parameter vector instead of the vehicle file's values, shape (size,).

    Raises:
        WindowError: a shape that does not fit the vehicle, or a step that is not positive.
    """
    rows = np.asarray(rotor_speed, dtype=np.float64)
    if rows.ndim != 2 or len(rows) < 1 or rows.shape[1] != len(vehicle.rotors):
        raise WindowError(f"rotor speeds of shape {rows.shape}", f"(n, {len(vehicle.rotors)})")
    simulator = Simulator(vehicle, theta, span=len(rows) * dt)
    state = simulator.start(
        attitude=attitude, rate=rate, velocity=velocity, position=position, rotor_speed=rows[0], dt=dt
    )
    y = simulator.run(state, rows, dt)[:, 0]
    reported = np.where(y[:, 13:14] < 0.0, -y[:, 13:17], y[:, 13:17])
    t = dt * np.arange(1, len(rows) + 1, dtype=np.float64)
    return Trajectory(t, reported, y[:, 17:20], y[:, 20:23], y[:, 7:10], y[:, 10:13])
