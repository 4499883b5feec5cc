"""Simulator of the identified vehicle: stepped, one vehicle or a batch of them, or flown along rotor speeds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numba as nb
import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple
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
    remember_attitude,
    sensor_constants,
    step_filter,
    step_tilt_error,
    tilt_attitude,
)
from quadid.model.simd import LANES, cached, inlined, jit, lane_kernel
from quadid.types import FloatArray, IntArray
from quadid.vehicle import RandomForces, Vehicle

# isort: off
from quadid.model.simd import (
    A_G, C_SHIFT, E_QW, F1_X, F2_X, G_BEND, G_DF, G_F, G_F0, G_FM, G_W, G_W0, HALF, L_NOW, N_QW, N_ROWS, N_STATE, ROTOR,
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
SENSED, SENSORS = S_QW, 10
WORK = (N_ROWS + N_SIGNALS) * LANES
"""Numbers in the work array: rows, then the signals of terms beyond the catalogue."""
TURNS = 6
"""Random numbers of a lane and step: specific force 3, angular acceleration 3."""


@nb.njit(**inlined)
def _uniform(x):  # type: ignore[no-untyped-def]
    """Number between 0 and 1, both left out, of 64 bits: splitmix64's finaliser, doi:10.1145/2660193.2660195."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x = x ^ (x >> np.uint64(31))
    return np.uint64((x >> np.uint64(12)) | np.uint64(0x3FF0000000000000)).view(np.float64) - (1.0 - 2.0**-53)


@nb.njit(**inlined)
def _logarithm(x):  # type: ignore[no-untyped-def]
    """Natural logarithm without a branch or a call: x = 2^e m, ln m = 2 artanh((m - 1) / (m + 1))."""
    bits = np.float64(x).view(np.int64)
    e = (bits - np.int64(0x3FE6A09E667F3BCD)) >> np.int64(52)  # m from the root of 1/2 to that of 2
    m = np.int64(bits - (e << np.int64(52))).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    tail = z * (1 / 11 + z * (1 / 13 + z * (1 / 15 + z * (1 / 17 + z * (1 / 19 + z / 21)))))
    return float(e) * math.log(2.0) + 2.0 * s * (1.0 + z * (1 / 3 + z * (1 / 5 + z * (1 / 7 + z * (1 / 9 + tail)))))


@nb.njit(**inlined)
def _circle(x):  # type: ignore[no-untyped-def]
    """Cosine and sine of 2 pi x for x from -1/2 to 1/2: Taylor's series of a quarter of the angle, doubled twice."""
    a = 0.5 * math.pi * x
    z = a * a
    s = z / 20 * (1.0 - z / 42 * (1.0 - z / 72 * (1.0 - z / 110 * (1.0 - z / 156 * (1.0 - z / 210)))))
    s = a * (1.0 - z / 6 * (1.0 - s))
    c = z / 30 * (1.0 - z / 56 * (1.0 - z / 90 * (1.0 - z / 132 * (1.0 - z / 182 * (1.0 - z / 240)))))
    c = 1.0 - z / 2 * (1.0 - z / 12 * (1.0 - c))
    c, s = 1.0 - 2.0 * s * s, 2.0 * s * c
    return 1.0 - 2.0 * s * s, 2.0 * s * c


@nb.njit(**jit)
def _random_inputs(seed: int, first: int, step: int, walk: FloatArray, inputs: FloatArray) -> None:
    """Advances the random inputs of all lanes, first-order Gauss-Markov processes, by a step.

    The numbers follow from seed, vehicle and step alone (a counter, not a stream), so that a step can be repeated.

    Args:
        seed: of all numbers.
        first: place of the first lane's vehicle in the batch.
        step: number of the step.
        walk: exp(-dt / T) of each input, and the standard deviation of what a step adds, (2, TURNS).
        inputs: advanced, (TURNS, LANES).
    """
    lane_kernel()
    golden = np.uint64(0x9E3779B97F4A7C15)
    for i in range(0, TURNS, 2):
        at = np.uint64(seed) + golden * np.uint64((TURNS * step + i + 1) << 24)
        for lane in range(LANES):
            own = at + golden * np.uint64(first + lane + 1)
            radius = math.sqrt(-2.0 * _logarithm(_uniform(own)))  # Box & Muller 1958
            cos, sin = _circle(_uniform(own ^ np.uint64(1 << 63)) - 0.5)
            inputs[i, lane] = walk[0, i] * inputs[i, lane] + walk[1, i] * radius * cos
            inputs[i + 1, lane] = walk[0, i + 1] * inputs[i + 1, lane] + walk[1, i + 1] * radius * sin


@nb.njit(**jit)
def _push(dt: float, inputs: FloatArray, s: FloatArray) -> None:
    """Lets random specific force and angular acceleration (TURNS, LANES) act over a step that has just been made."""
    lane_kernel()
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
def _read_sensors(steps: int, dt: float, need: Needs, s: FloatArray, ring: FloatArray) -> None:
    """Writes what the sensors read at the end of a step: rows S_QW to S_FZ.

    Args:
        steps: made before; with none, filters begin settled.
        dt: step [s].
        need: which parts of the model any lane needs.
        s: rows.
        ring: attitude and rate at the ends of the last steps, rows (7, LANES) one after another, all there twice.
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
            if steps == 0:
                s[G_F + i], s[G_DF + i], s[G_F0 + i] = s[S_FX + i], 0.0, s[S_FX + i]
            s[G_BEND + i], s[G_FM + i] = s[S_BENDX + i], 0.5 * (s[G_F0 + i] + s[S_FX + i])
        step_filter(dt, s)
        for i in range(3 * LANES):
            s[G_W0 + i], s[G_F0 + i] = s[S_P + i], s[S_FX + i]
            s[S_P + i], s[S_FX + i] = s[G_W + i], s[G_F + i]
    if need.att_delay:
        past = ring.reshape(-1, 7, LANES)
        late = len(past) // 2
        at = steps % late
        remember_attitude(at, s, past)
        remember_attitude(at + late, s, past)
        delay_attitude(at + late, dt, past, s)
    if need.ahrs:
        tilt_attitude(s)
    if need.imu_static:
        distort_imu(s)


@nb.njit(**jit)
def _copy(source: FloatArray, target: FloatArray) -> None:
    """Copies numbers one after another."""
    lane_kernel()
    for i in range(len(target)):
        target[i] = source[i]


@nb.njit(**jit)
def _take(source: FloatArray, stretches: IntArray, target: FloatArray) -> None:
    """Copies numbers, one after another, to stretches of the work array: first, end, first, end ..."""
    at = 0
    for k in range(0, len(stretches), 2):
        first, end = stretches[k], stretches[k + 1]
        _copy(source[at : at + end - first], target[first:end])
        at += end - first


@nb.njit(**jit)
def _keep(source: FloatArray, stretches: IntArray, target: FloatArray) -> None:
    """Copies stretches of the work array, as in `_take`, one after another."""
    at = 0
    for k in range(0, len(stretches), 2):
        first, end = stretches[k], stretches[k + 1]
        _copy(source[first:end], target[at : at + end - first])
        at += end - first


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


as_tuple: Any = to_fixed_tuple
"""Numbers of an array as a tuple of so many; its annotations are those of the compiler's side."""
COUNTS, NEEDS = 9, len(Needs._fields)
PLAN = COUNTS + -(-NEEDS // 8)
"""Numbers at the begin of a plan: rotors, size of a parameter vector, terms beyond the catalogue, stretches of own
constants, of the state, numbers of these, commands that are remembered, 1 with random inputs, their seed; then, a byte
each, what is needed.  Behind them stretches (first, end) of the constants that differ between blocks and of the state,
sensors last; terms, four numbers each."""


@nb.njit(**jit)
def _send(
    commands: FloatArray, first: int, newest: int, r: int, sent: FloatArray, rot: FloatArray, s: FloatArray
) -> None:
    """Remembers the commands to a rotor, and writes those that reach it now and next.

    Args:
        commands: (vehicles, rotors).
        first: place of the first lane's vehicle.
        newest: place of these commands in `sent`.
        r: the rotor.
        sent: last commands, a ring that stands there twice, (2 delayed, rotors, LANES).
        rot: rows of the rotors.
        s: rows.
    """
    for lane in range(LANES):
        now = commands[min(first + lane, len(commands) - 1), r]
        sent[newest, r, lane] = sent[newest - len(sent) // 2, r, lane] = now
    for lane in range(LANES):
        at = newest - int(s[C_SHIFT + lane])
        rot[r, R_PAST + lane], rot[r, R_NOW + lane] = sent[at - 1, r, lane], sent[at, r, lane]
        rot[r, R_NEXT + lane] = sent[at, r, lane]


@cached
def step_blocks(
    commands: FloatArray, plan: IntArray, numbers: FloatArray, time: float, span: float, dt: float, step: int,
    s: FloatArray, state: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Makes one step a row of commands with every vehicle of a batch.

    What stays the same comes in two arrays, because each one that is handed over takes a fiftieth of a step.

    Args:
        commands: rotor speeds [rad/s], held over each step, (steps, vehicles, rotors).
        plan: see `PLAN`.
        numbers: geometry (rotors, 4), see `rotor_kernel.Drive`; of random inputs exp(-dt / T) and the standard
            deviation of what a step adds, (2, TURNS); parameter vectors (blocks, LANES, size); coefficients of terms
            beyond the catalogue (blocks, terms, LANES); constants of each block that the others do not share.
        time: at the start of the first step [s].
        span: time over which a battery sags [s].
        dt: step [s].
        step: number of steps made before.
        s: work array (WORK), all but its common constants overwritten.
        state: motion and filters, rotors, last commands, past attitudes, random inputs (blocks, width), advanced;
            see `quadid.model.step.State`.
        out: after each step (steps, vehicles, N_STATE + 10), written: motion, sensors; no rows: not wanted.
    """
    count, blocks = commands.shape[1], len(state)
    rotors, size, most, owned, keeping, at_rotors, delayed, walks, seed = as_tuple(plan[:COUNTS], COUNTS)
    need = Needs(*as_tuple(plan[COUNTS:PLAN].view(np.bool_)[:NEEDS], NEEDS))
    plain = not (need.delayed or need.uneven)
    # Where each part begins: views of it are made where they are used, since making one takes a fiftieth of a step.
    at_kept = PLAN + 2 * owned
    at_terms = at_kept + 2 * keeping
    at_walk = 4 * rotors
    at_theta = at_walk + 2 * TURNS * walks
    at_coefficients = at_theta + blocks * LANES * size
    at_constants = at_coefficients + blocks * most * LANES
    own_size = (len(numbers) - at_constants) // blocks
    at_sent = at_rotors + rotors * ROTOR
    at_inputs = at_sent + 2 * delayed * rotors * LANES
    at_past = at_inputs + TURNS * LANES
    geometry = numbers[:at_walk].reshape(rotors, 4)
    for block in range(blocks):
        now, at = state[block], at_constants + block * own_size
        rot = now[at_rotors:at_sent].reshape(rotors, ROTOR)
        _take(numbers[at : at + own_size], plan[PLAN:at_kept], s)
        _take(now, plan[at_kept : at_terms - 2], s)
        first, last = block * LANES, count - 1
        for k in range(len(commands)):
            for r in range(rotors):
                if plain:
                    for lane in range(LANES):
                        s[T_A1 + lane] = commands[k, min(first + lane, last), r]
                else:
                    sent = now[at_sent:at_inputs].reshape(2 * delayed, rotors, LANES)
                    _send(commands[k], first, (step + k) % delayed + delayed, r, sent, rot, s)
                turn_rotor(plain, r, True, False, geometry, dt, need, rot, s)
            begin = time + k * dt
            if need.factors:
                flight_factors(begin, 0.0, span, dt, s)
            if need.payload:
                at = at_theta + block * LANES * size
                load_payload(begin, dt, numbers[at : at + LANES * size].reshape(LANES, size), s)
            if need.learned:
                at, signals = at_coefficients + block * most * LANES, s[N_ROWS * LANES :].reshape(N_SIGNALS, LANES)
                terms = plan[at_terms : at_terms + 4 * most].reshape(most, 4)
                residual_signals(s, signals)
                coefficients = numbers[at : at + most * LANES].reshape(most, LANES)
                residual_forces(terms, coefficients, signals, step + k == 0, s)
            step_in_air(need, dt, s)
            if walks > 0:
                inputs = now[at_inputs:at_past].reshape(TURNS, LANES)
                _random_inputs(seed, first, step + k, numbers[at_walk:at_theta].reshape(2, TURNS), inputs)
                _push(dt, inputs, s)
            _read_sensors(step + k, dt, need, s, now[at_past:])
            if len(out) > 0:
                for lane in range(min(LANES, count - first)):
                    for i in range(N_STATE):
                        out[k, first + lane, i] = s[X_QW + i * LANES + lane]
                    for i in range(10):
                        out[k, first + lane, N_STATE + i] = s[SENSED + i * LANES + lane]
        _keep(s, plan[at_kept:at_terms], now)


@cache
def compiled_steps() -> Any:
    """Machine code of `step_blocks`, contiguous arrays only: numba's look at the types takes a fifth of a step."""
    return step_blocks.compile("void(f8[:,:,::1],i8[::1],f8[::1],f8,f8,f8,i8,f8[::1],f8[:,::1],f8[:,:,::1])")


# --- Simulator of the identified vehicle: stepped, one vehicle or a batch of them, or flown along rotor speeds


# --- The identified vehicle as a simulator to be stepped, one vehicle or a batch of them
#
#     simulator = Simulator(vehicle)
#     state = simulator.start(position=np.array([0.0, 0.0, -2.0]))
#     while flying:
#         state = simulator.step(state, controller(state), 0.005)


LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STILL = np.zeros(3)
_NO_OUT = np.empty((0, 0, 0))
_NO_CONSTANTS = np.empty((0, 0))


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
    _kept: int
    _dt: float
    _work: FloatArray
    _constants: FloatArray

    def copy(self) -> State:
        """Returns a state that changes no more with this one."""
        kept, none = self._memory.copy(), _NO_CONSTANTS
        return State(self.time, self.steps, self.vehicles, kept, self._rotors, self._kept, self._dt, none, none)

    def _read(self, row: int, count: int) -> FloatArray:
        rows = self._memory[:, row * LANES : (row + count) * LANES].reshape(-1, count, LANES)
        return rows.transpose(0, 2, 1).reshape(-1, count)[: self.vehicles]

    @property
    def _sensors(self) -> int:
        """Row of the first sensor reading."""
        return self._kept // LANES - SENSORS

    @property
    def attitude(self) -> FloatArray:
        """True attitude, unit quaternions wxyz, body to world, shape (vehicles, 4)."""
        return self._read(0, 4)

    @property
    def rate(self) -> FloatArray:
        """True rate [rad/s], shape (vehicles, 3)."""
        return self._read(4, 3)

    @property
    def velocity(self) -> FloatArray:
        """True velocity [m/s], shape (vehicles, 3)."""
        return self._read(7, 3)

    @property
    def position(self) -> FloatArray:
        """True position [m], shape (vehicles, 3)."""
        return self._read(10, 3)

    @property
    def motion(self) -> FloatArray:
        """Attitude, rate, velocity, position, rotor speeds: the states of `quadid.symbolic`, shape (vehicles, 13 + N).

        A file without `motor_lag` has no rotor states there: its first 13 columns.
        """
        return np.hstack([self._read(0, N_STATE), self.rotor_speed])

    @property
    def rotor_speed(self) -> FloatArray:
        """True rotor speeds [rad/s], shape (vehicles, rotors)."""
        rot = self._memory[:, self._kept : self._kept + self._rotors * ROTOR].reshape(-1, self._rotors, ROTOR)
        return rot[:, :, R_SPEED : R_SPEED + LANES].transpose(0, 2, 1).reshape(-1, self._rotors)[: self.vehicles]

    @property
    def gyro(self) -> FloatArray:
        """Rate as the gyro reads it [rad/s], shape (vehicles, 3)."""
        return self._read(self._sensors + 4, 3)

    @property
    def accel(self) -> FloatArray:
        """Specific force as the accelerometer reads it [m/s^2], the mean over the last step, shape (vehicles, 3)."""
        return self._read(self._sensors + 7, 3)

    @property
    def reported_attitude(self) -> FloatArray:
        """Attitude as the attitude estimator reports it, quaternions wxyz, shape (vehicles, 4)."""
        return self._read(self._sensors, 4)


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
        filters = ((G_W, 18, self._need.imu_lag), (E_QW, 4, self._need.ahrs), (L_NOW, 6, self._need.learned))
        kept = [(X_QW, N_STATE), *((row, count) for row, count, needed in filters if needed), (SENSED, SENSORS)]
        self._kept = np.array([(row, row + LANES * count) for row, count in kept])
        self._terms = residual_terms(vehicle)
        self._coefficients = np.empty((blocks, len(self._terms), LANES))
        self._seed, self._span = seed, min(span, 1e9)
        self._dt, self._constants = math.nan, _NO_CONSTANTS
        self._each = (self.vehicles, len(self._geometry))
        self._one = (1, *self._each)

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
        rows, speeds = _in_lanes(motion, blocks), _in_lanes(given[4], blocks)
        moving = np.zeros((blocks, N_ROWS * LANES))
        moving[:, X_QW : X_QW + N_STATE * LANES] = rows.reshape(blocks, -1)
        for row in (S_QW, G_W, G_W0):
            part = rows[:, :7] if row == S_QW else rows[:, 4:7]
            moving[:, row : row + part.shape[1] * LANES] = part.reshape(blocks, -1)
        moving[:, E_QW : E_QW + LANES] = 1.0
        rot[:, :, R_SPEED : R_SPEED + LANES] = speeds
        memory = (
            *(moving[:, first:end] for first, end in self._kept),
            rot,
            np.repeat(speeds[:, None], 2 * self._delayed, axis=1),
            _in_lanes(given[5], blocks),
            np.repeat(rows[:, None, :7], 2 * self._late, axis=1),
        )
        kept, none = np.concatenate([m.reshape(blocks, -1) for m in memory], axis=1), _NO_CONSTANTS
        return State(time, 0, n, kept, rotors, self._width[0], dt, none, none)

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
        self._march(state, np.array(command, np.float64, copy=None, order="C", ndmin=3), dt, voltage)

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
        """Makes the steps; the one way into the kernel.  What need not be asked at every step is asked elsewhere."""
        if commands.shape != self._one:
            commands = self._spread(commands, out)
        if state._constants is not self._constants or dt != self._dt:
            self._prepare(state, dt)
        if voltage is not None:
            exponent = self._theta[..., ix.EXPONENT].reshape(-1)[: state.vehicles]
            commands = commands * voltage ** exponent[None, :, None]
        compiled_steps()(
            commands, self._ints, self._numbers, state.time, self._span, dt, state.steps, state._work, state._memory,
            out,
        )  # fmt: skip
        state.time += len(commands) * dt
        state.steps += len(commands)

    def _spread(self, commands: FloatArray, out: FloatArray) -> FloatArray:
        """Commands to every vehicle, shape (steps, vehicles, rotors); several steps only where they are written."""
        if out is _NO_OUT and len(commands) != 1:
            raise WindowError(f"commands of shape {commands.shape}", f"{self._each}", "`run` makes several steps")
        if commands.shape[1:] not in (self._each, (1, self._each[1])):
            raise WindowError(f"commands of shape {commands.shape[1:]}", f"{self._each}")
        return np.ascontiguousarray(np.broadcast_to(commands, (len(commands), *self._each)))

    def _prepare(self, state: State, dt: float) -> None:
        """Makes the constants of a step ready: for a new state or a copy, or after another step or simulator."""
        if dt != state._dt and (self._need.delayed or self._need.att_delay):
            raise WindowError(
                f"dt {dt} s after {state._dt} s",
                "one step size where commands or attitude are delayed",
                "begin with start(dt=...)",
            )
        if dt != self._dt:
            self._settle(dt)
        if (state.vehicles, state._rotors) != self._each:
            found = f"a state of {state.vehicles} vehicles with {state._rotors} rotors"
            raise WindowError(found, f"{self.vehicles} with {self._each[1]}, as the simulator has")
        if (state._kept, state._memory.shape[1]) != self._width:
            raise WindowError("a state of other delays or filters", "one of this simulator's `start`")
        state._dt, state._work, state._constants = dt, self._prepared.copy(), self._constants

    def _settle(self, dt: float) -> FloatArray:
        """Prepares all that depends on the step; returns rows of the rotors with their gains."""
        if not 0.0 < dt < math.inf:
            raise WindowError(f"dt {dt} s", "a positive step")
        blocks = len(self._theta)
        flight = Flight(self.vehicle.mass, self._reach, self._hub, self._plan, 0.0, dt, 0.0, self._span)
        constants, rot = np.empty((blocks, STATE)), np.zeros((blocks, len(self._geometry), ROTOR))
        write_constants(self._theta, flight, self._coefficients, constants, rot)
        differ = (constants != constants[0]).any(axis=0).reshape(-1, LANES).any(axis=1)
        own = LANES * np.flatnonzero(np.diff(differ, prepend=False, append=False)).reshape(-1, 2)
        self._constants = constants[:, np.repeat(differ, LANES)]
        self._prepared = np.concatenate([constants[0], np.zeros(WORK - STATE)])
        self._delayed = math.floor(max(float(self._theta[..., ix.DELAY].max()), 0.0) / dt) + 2
        self._late = math.ceil(max(float(self._theta[..., ix.ATT_DELAY].max()), 0.0) / dt) + 2
        rotors, kept = len(self._geometry), int(np.diff(self._kept).sum())
        each = rotors * (ROTOR // LANES + 2 * self._delayed) + TURNS + 14 * self._late
        self._width = (kept, kept + LANES * each)
        walk = np.empty((0, TURNS))
        if self.random is not None:
            size, time = self.random.each_axis
            keep = np.exp(-dt / time)
            walk = np.array([keep, size * np.sqrt(1.0 - keep**2)])
        seed = self._seed
        needs = np.zeros(8 * (PLAN - COUNTS), np.bool_)
        needs[:NEEDS] = self._need
        counts = (rotors, self._theta.shape[-1], len(self._terms), len(own), len(self._kept), kept, self._delayed)
        stretches = (own.ravel(), self._kept.ravel(), self._terms.ravel())
        self._ints = np.concatenate([[*counts, len(walk) // 2, seed], needs.view(np.int64), *stretches]).astype(
            np.int64
        )
        parts = (self._geometry, walk, self._theta, self._coefficients, self._constants)
        self._numbers = np.concatenate([part.ravel() for part in parts])
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
