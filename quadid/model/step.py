"""Simulator of the identified vehicle: stepped, one vehicle or a batch of them, or flown along rotor speeds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from quadid.errors import ParameterError, WindowError
from quadid.model import layout as ix
from quadid.model.kernel import Flight, Needs, needs_of
from quadid.model.layout import Layout, residual_terms
from quadid.model.rollout import hub_geometry
from quadid.model.simd import LANES
from quadid.model.step_kernel import STATE, TURNS, step_blocks, write_constants
from quadid.model.work_array import (
    E_QW,
    G_W,
    G_W0,
    N_ROWS,
    N_STATE,
    R_SPEED,
    ROTOR,
    S_FX,
    S_P,
    S_QW,
    X_N,
    X_P,
    X_QW,
    X_VN,
)
from quadid.types import FloatArray
from quadid.vehicle import RandomForces, Vehicle

# --- The identified vehicle as a simulator to be stepped, one vehicle or a batch of them
#
#     simulator = Simulator(vehicle)
#     state = simulator.start(position=np.array([0.0, 0.0, -2.0]))
#     while flying:
#         state = simulator.step(state, controller(state), 0.005)


LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STILL = np.zeros(3)
_NO_OUT, _NO_WALK = np.empty((0, 0, 0)), np.empty((0, TURNS))
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

    def copy(self) -> State:
        """Returns a state that changes no more with this one."""
        return State(self.time, self.steps, self.vehicles, self._memory.copy(), self._rotors, self._dt)

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
        self, vehicle: Vehicle, theta: FloatArray | None = None, *, random: RandomInputs | RandomForces | None = None,
        seed: int = 0, span: float = math.inf,
    ) -> None:  # fmt: skip
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
        self._dt, self._constants, self._walk, self._delayed = 0.0, np.empty((0, STATE)), _NO_WALK, 2

    def start(
        self, *, attitude: FloatArray = LEVEL, rate: FloatArray = STILL, velocity: FloatArray = STILL,
        position: FloatArray = STILL, rotor_speed: FloatArray | float | None = None, time: float = 0.0,
        inputs: FloatArray | float = 0.0, dt: float = 0.005,
    ) -> State:  # fmt: skip
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
            moving[:, STATE:], rot, np.repeat(speeds[:, None], self._delayed, axis=1),
            _in_lanes(given[5], blocks), np.repeat(rows[:, None, :7], late, axis=1),
        )  # fmt: skip
        return State(time, 0, n, np.concatenate([m.reshape(blocks, -1) for m in memory], axis=1), rotors, dt)

    def step(self, state: State, command: FloatArray, dt: float, voltage: float | None = None) -> State:
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

    def advance(self, state: State, command: FloatArray, dt: float, voltage: float | None = None) -> None:
        """Makes one step in place; arguments as for `step`."""
        given = np.asarray(command, dtype=np.float64)
        self._march(state, given[None, None] if given.ndim == 1 else given[None], dt, voltage)

    def run(self, state: State, commands: FloatArray, dt: float) -> FloatArray:
        """Makes a step a row of commands, in place.

        Args:
            state: advanced.
            commands: rotor speeds [rad/s], shape (steps, rotors) or (steps, vehicles, rotors).
            dt: step [s].

        Returns:
            After each step and of each vehicle: quaternion, rate, velocity, position; then reported attitude, gyro,
            accelerometer; shape (steps, vehicles, 23).
        """
        given = np.asarray(commands, dtype=np.float64)
        given = given[:, None] if given.ndim == 2 else given
        out = np.empty((len(given), self.vehicles, N_STATE + 10))
        self._march(state, given, dt, None, out)
        return out

    def _march(
        self, state: State, commands: FloatArray, dt: float, voltage: float | None, out: FloatArray = _NO_OUT
    ) -> None:
        """Makes the steps; the one way into the kernel."""
        if commands.shape[1:] != (state.vehicles, len(self._geometry)):
            if commands.shape[1:] != (1, len(self._geometry)):
                raise WindowError(f"commands of shape {commands.shape[1:]}", f"{(state.vehicles, len(self._geometry))}")
            commands = np.repeat(commands, state.vehicles, axis=1)
        if dt != state._dt:
            if self._need.delayed or self._need.att_delay:
                raise WindowError(
                    f"dt {dt} s after {state._dt} s", "one step size where commands or attitude are delayed",
                    "begin with start(dt=...)",
                )  # fmt: skip
            state._dt = dt
        if dt != self._dt:
            self._settle(dt)
        if voltage is not None:
            exponent = self._theta[..., ix.EXPONENT].reshape(-1)[: state.vehicles]
            commands = commands * voltage ** exponent[None, :, None]
        step_blocks(
            commands, self._geometry, self._theta, self._terms, self._coefficients, self._needs, self._constants,
            self._walk, state.time, self._span, dt, self._seed, state.steps, self._delayed, state._memory, out,
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
    vehicle: Vehicle, rotor_speed: FloatArray, dt: float, *, attitude: FloatArray = LEVEL, rate: FloatArray = STILL,
    velocity: FloatArray = STILL, position: FloatArray = STILL, theta: FloatArray | None = None,
) -> Trajectory:  # fmt: skip
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
