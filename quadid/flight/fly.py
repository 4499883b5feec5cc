"""Flight of the vehicle, as a whole or step by step, and the log of it with the truth beside."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quadid.attitude_controller import pack_gains, stabilise
from quadid.data.window import Channel, Recording, Window
from quadid.errors import ParameterError, QuadidError
from quadid.flight.airframe import PUSHES, STATES, Air, Body, Drive, Oddity, kernel
from quadid.flight.loop import (
    BEGUN,
    EPSILON,
    NO_TIME,
    Events,
    OnBoard,
    Plan,
    Progress,
    SensorNoise,
    Track,
    Turning,
    attitude_at,
    coloured,
    fly_on,
    log_steps,
    pull_attitude,
    quaternion_of,
    read_accel,
    read_gyro,
    shake,
    supply,
    turned,
    turning_at,
)
from quadid.flight.outside import LogRows, Scene, apply_outside, check_outside, distort_log, random_forces
from quadid.flight.pilot import (
    PILOT_STEP,
    Pilot,
    Segment,
    band_noise,
    default_gains,
    fly_by_hand,
    scripted,
    stick_profile,
)
from quadid.flight.setup import Effects, Setup, TruthParameters, prepare
from quadid.rotation import continuous_sign, exponential, product
from quadid.types import FloatArray
from quadid.vehicle import RandomForces, Vehicle, mixer_matrix

# --- The march through a flight: one numerical kernel, kept whole because it is the order of events


FLEW, CRASHED = 0, 1


@kernel
def copy_into(values: FloatArray, out: FloatArray) -> None:
    """Copies numbers one by one: assigning a slice would compile a message about shapes for seconds."""
    for i in range(values.shape[0]):
        out[i] = values[i]


@kernel
def march(
    plan: Plan, body: Body, air: Air, odd: Oddity, drive: Drive, events: Events, on_board: OnBoard, pilot: Pilot,
    gains: FloatArray, mixer: FloatArray, sticks: FloatArray, gyro_noise: FloatArray, tilt_noise: FloatArray,
    arrival: FloatArray, pushes: FloatArray, efficiency: FloatArray, y: FloatArray, rotors: Turning, track: Track,
) -> tuple[int, float]:  # fmt: skip
    """Flies the closed loop.

    Args:
        gains: of the stabiliser, see `pack_gains`.
        mixer: of the stabiliser, see `mixer_matrix`.
        sticks: shape (pilot instants, 4).
        gyro_noise: shape (control instants, 3) [rad/s].
        tilt_noise: AHRS error as body rotation vector, shape (control instants, 3) [rad].
        arrival: when each command reaches the rotors [s], non-decreasing, shape (control instants,).
        pushes: disturbance, see `airframe.derivative`: shape (1, 9) for a constant one, or one row a step.
        efficiency: factors on thrust and drag torque, shape (rotors, 2).
        y: state at the start, shape (33,); in place.
        rotors: at the start; in place.
        track: written.

    Returns:
        `FLEW` or `CRASHED` (hit the ground, overturned or diverged), and the time of the end [s].
    """
    dt, hover = plan.dt, air.hover_sum / rotors.speed.shape[0]
    integral, trim = np.zeros(3), np.zeros(3)
    reference, measured = np.zeros(4), np.zeros(3)
    error = np.zeros(9)
    error[0] = error[4] = error[8] = 1.0
    truth, ahrs, seen = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    force, shaken, trembling = np.zeros(3), np.zeros(3), np.zeros(6)
    shaking = on_board.gyro_shake > 0.0 or on_board.accel_shake > 0.0
    progress, issued, row = Progress(0, NO_TIME, 0, False), 0, 0

    for n in range(plan.steps):
        now = plan.start + n * dt
        # --- sensors, just before the command of this instant acts
        for i in range(3):
            for j in range(3):
                truth[i, j] = y[6 + 3 * i + j]
        for axis in range(3):
            track.gyro[n, axis] = y[15 + axis] + on_board.gyro_shake * trembling[axis]
            track.accel[n, axis] = y[18 + axis] + shaken[axis]
        if on_board.pull != 0.0:
            for i in range(3):
                for j in range(3):
                    ahrs[i, j] = (
                        error[3 * i] * truth[0, j] + error[3 * i + 1] * truth[1, j] + error[3 * i + 2] * truth[2, j]
                    )
            if n > 0:
                for i in range(3):
                    force[i] = on_board.accel_bias[i]
                    for j in range(3):
                        raw = (track.accel[n, j] - track.accel[n - 1, j]) / dt
                        force[i] += on_board.accel_matrix[i, j] * raw
                pull_attitude(error, ahrs, force, on_board.pull * dt)
        else:
            for i in range(3):
                for j in range(3):
                    ahrs[i, j] = truth[i, j]
        quaternion_of(ahrs, track.attitude[n])

        # --- pilot and stabiliser
        if n % plan.pilot_every == 0:
            stick = sticks[min(n // plan.pilot_every, sticks.shape[0] - 1)]
            fly_by_hand(pilot, y[0:3], y[3:6], truth, stick, trim, reference)
            tilted = truth[2, 2] < 0.1 or y[2] > 0.0 or not np.isfinite(y[15] + y[2] + y[3])
            if tilted:
                return CRASHED, now
        if row < plan.rows and n == plan.first_log + row * plan.log_every:
            copy_into(y, track.state[row])
            copy_into(reference, track.reference[row])
            copy_into(rotors.speed, track.rotor[row])
            row += 1
        if n % plan.control_every == 0:
            c = n // plan.control_every
            turned(ahrs, tilt_noise[c], seen)
            for i in range(3):
                measured[i] = on_board.gyro_bias[i] + gyro_noise[c, i]
                for j in range(3):
                    measured[i] += on_board.gyro_matrix[i, j] * track.gyro[n, j]
            stabilise(gains, mixer, reference, seen, measured, plan.control_every * dt, integral, track.command[c])
            issued = c + 1

        # --- the step
        push = pushes[min(n, pushes.shape[0] - 1)]
        progress = fly_on(
            now, now + dt, issued, progress, track.command, arrival, efficiency, push, body, air, odd, drive, events,
            y, rotors,
        )  # fmt: skip
        if shaking:
            shake(rotors.phase, rotors.speed, on_board.shake_mode, hover, trembling)
            for axis in range(3):
                shaken[axis] += dt * on_board.accel_shake * trembling[3 + axis]
    return FLEW, plan.start + plan.steps * dt


# --- Flight of the vehicle, and the log of it with the truth beside


FULL_BATTERY = 12.4
"""Voltage at the first sample [V]; thrust goes with its square."""
EXTRAS = ("velocity", "position", "battery")
"""Optional channels."""


@dataclass(frozen=True)
class Truth:
    """True states at the log instants, just before the command of that instant acts; for tests only.

    Attributes:
        t: times [s], shape (n,).
        quaternion: body to world, shape (n, 4).
        rates: body rates [rad/s], shape (n, 3).
        velocity: of the CG, world NED [m/s], shape (n, 3).
        position: of the CG, world NED [m], shape (n, 3).
        rotor_speed: real rotor speeds [rad/s], shape (n, rotors).
        parameters: what an identification should find.
        outside: effects outside the catalogue that were flown.
    """

    t: FloatArray
    quaternion: FloatArray
    rates: FloatArray
    velocity: FloatArray
    position: FloatArray
    rotor_speed: FloatArray
    parameters: TruthParameters
    effects: Mapping[str, Mapping[str, float]]
    outside: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Flight:
    """One flight.

    Attributes:
        window: as it would be logged, one grid, no gaps.
        recording: the same as channels of a log.
        truth: true states; nothing that identifies may look at it.
        references: roll, pitch, yaw [rad], throttle 0..1 at the log instants, shape (n, 4).
        gains: of the stabiliser, by name.
    """

    window: Window
    recording: Recording
    truth: Truth
    references: FloatArray
    gains: Mapping[str, float]
    vehicle: Vehicle


@dataclass(frozen=True)
class Flown:
    """A finished flight, not yet logged.

    Attributes:
        gyro_noise: white noise of the gyro at the control instants [rad/s], shape (controls, 3).
        tilt_noise: error of the attitude there, body rotation vector [rad], shape (controls, 3).
    """

    plan: Plan
    setup: Setup
    outside: Effects
    track: Track
    sensor: SensorNoise
    streams: Mapping[str, np.random.Generator]
    gyro_noise: FloatArray
    tilt_noise: FloatArray
    seed: int

    @property
    def name(self) -> str:
        """Name for people."""
        return f"{self.setup.vehicle.name}-seed{self.seed}"

    def noise(self, name: str, sigma: float, columns: int) -> FloatArray:
        """White noise of one channel, shape (rows, columns)."""
        return np.asarray(sigma * self.streams[name].standard_normal((self.plan.rows, columns)))


def logged_rotors(track: Track, plan: Plan, sampling: str, late: float) -> FloatArray:
    """Rotor columns of the log [rad/s], shape (rows, n).

    Held: the command that acts from this row to the next (its mean where it changes faster).  Instant: the input of
    the rotors at the row, which has just reached the command before.  Either as it was `late` seconds before.
    """
    share, step = plan.log_every // plan.control_every, plan.control_every * plan.dt
    first, rows = plan.first_log // plan.control_every - late / step, np.arange(plan.rows + 1, dtype=np.float64)
    if sampling == "instant":
        return _between(track.command, first - 1 + share * rows[:-1])
    summed = np.concatenate([np.zeros((1, track.command.shape[1])), np.cumsum(track.command, axis=0)])
    return np.asarray(np.diff(_between(summed, first + share * rows), axis=0) / share)


def _between(rows: FloatArray, at: FloatArray) -> FloatArray:
    """Rows at fractional places, linear in between, shape (len(at), columns)."""
    low = np.clip(np.floor(at + 1e-9).astype(np.int64), 0, len(rows) - 1)
    part = np.clip(at - low, 0.0, 1.0)[:, None] * (np.abs(at - np.rint(at)) > 1e-9)[:, None]
    return np.asarray((1.0 - part) * rows[low] + part * rows[np.minimum(low + 1, len(rows) - 1)])


def write_window(flown: Flown, extras: Sequence[str]) -> Window:
    """Logs the flight: sensors with all their errors, commands, references, and the optional channels asked for."""
    if unknown := [name for name in extras if name not in EXTRAS]:
        raise ParameterError(f"unknown optional channel '{unknown[0]}'", ", ".join(EXTRAS))
    plan, setup, track = flown.plan, flown.setup, flown.track
    rotor = logged_rotors(track, plan, setup.vehicle.command.sampling, setup.reading_delay)
    # Gyro, accelerometer and attitude at the rows, then what the logging distorts.
    steps = log_steps(plan)
    at = steps.astype(np.int64) // plan.control_every
    lagged = attitude_at(track, steps - setup.attitude_delay / plan.dt)
    hover = setup.air.hover_sum / rotor.shape[1]
    gyro = read_gyro(track, plan, setup.on_board, setup.imu_cutoff, steps)
    accel = read_accel(track, plan, setup.on_board, setup.imu_cutoff, steps)
    attitude = product(lagged, exponential(flown.tilt_noise[at]))
    rows = LogRows(
        gyro + flown.gyro_noise[at],
        accel + flown.noise("accel", flown.sensor.accel, 3),
        continuous_sign(attitude),
        steps,
        track,
        plan,
        setup.on_board,
        np.mean((rotor / hover) ** 2, axis=1),
    )
    distort_log(rows, flown.outside, flown.seed)
    # Velocity, position, and the battery, which falls over the flight and dips with the rotors' power.
    events, t = setup.events, plan.dt * plan.log_every * np.arange(plan.rows)
    part = np.arange(plan.rows) / (plan.rows - 1)
    volts = FULL_BATTERY * np.sqrt(np.maximum(0.1, 1.0 - events.sag_fraction * part))
    if events.supply_exponent != 0.0:
        speeds = zip(t, track.rotor, strict=True)
        volts = FULL_BATTERY * np.array([supply(float(x), w, setup.body.hover_speed, events) for x, w in speeds])
    velocity, position = track.state[:, 3:6] * setup.velocity_gain, track.state[:, 0:3]
    clean = {"velocity": velocity, "position": position, "battery": volts[:, None]}
    optional = {
        name: clean[name] + flown.noise(name, getattr(flown.sensor, name), clean[name].shape[1]) for name in extras
    }
    return Window(
        0.0,
        plan.log_every * plan.dt,
        rotor,
        rows.gyro,
        rows.attitude,
        rows.accel,
        optional.get("velocity"),
        optional.get("position"),
        optional.get("battery"),
        track.reference,
        setup.vehicle.command.sampling,
        name=flown.name,
    )


def true_states(flown: Flown) -> Truth:
    """Takes the truth out of a flight."""
    plan, state = flown.plan, flown.track.state
    quaternion = np.empty((plan.rows, 4))
    for k in range(plan.rows):
        quaternion_of(np.ascontiguousarray(state[k, 6:15].reshape(3, 3)), quaternion[k])
    return Truth(
        t=plan.dt * plan.log_every * np.arange(plan.rows, dtype=np.float64),
        quaternion=continuous_sign(quaternion),
        rates=state[:, 15:18].copy(),
        velocity=state[:, 3:6].copy(),
        position=state[:, 0:3].copy(),
        rotor_speed=flown.track.rotor,
        parameters=flown.setup.truth,
        effects=flown.setup.effects,
        outside={name: dict(values) for name, values in flown.outside.items()},
    )


def as_recording(window: Window, vehicle: Vehicle) -> Recording:
    """Splits a window into the channels of a log; rotor columns in the vehicle's own unit."""
    channels: dict[str, Channel] = {}
    for name in ("gyro", "accel", "attitude", "attitude_reference", *EXTRAS):
        values = getattr(window, name)
        if values is not None:
            channels[name] = Channel(name, window.t, values, "simulated")
    command, column = vehicle.command, window.rotor_speed
    if command.kind == "rotor_speed":
        channels["rotor_speed"] = Channel("rotor_speed", window.t, column, "simulated")
    else:
        column = command.from_rotor_speed(column)
        channels["motor_command"] = Channel("motor_command", window.t, column, "simulated")
    return Recording(window.name, "simulated", channels, grid=window.dt)


# --- The flight


LEAD_IN = 5.0
"""Flown before the first log row [s], so that filters, delays and integrals have settled."""
LOW_FLIGHT = 3.0
"""Below this height the pilot holds the altitude more firmly [m], and on an excited flight rises and sinks."""
HOPS, HOP_SIZE = (0.08, 0.3), 0.095
"""Band [Hz] of that, and its collective per height [fraction of hover thrust, 1/m]: about a fifth of the height."""


class FlightError(QuadidError):
    """The vehicle hit the ground, overturned or diverged."""

    exit_code = 3


def _clock(seconds: float, log_rate: float, command_rate: float) -> Plan:
    rows = round(seconds * log_rate)
    if rows < 2:
        raise ParameterError(f"a flight of {seconds:g} s at {log_rate:g} Hz", "at least two log rows")
    dt, period = 1e-3, 1.0 / log_rate
    for _ in range(6):
        log_every = round(period / dt)
        control_every, pilot_every = round(1.0 / command_rate / dt), round(PILOT_STEP / dt)
        exact = np.allclose([log_every * dt * log_rate, control_every * dt * command_rate], 1.0, rtol=1e-9)
        if exact and log_every % 2 == 0 and control_every > 0 and log_every % control_every == 0:
            break
        dt *= 0.5
    else:
        raise ParameterError(
            f"log rate {log_rate:g} Hz with command rate {command_rate:g} Hz",
            "rates that divide 1000 Hz or a few times that, and a command rate that is a multiple of the log rate",
        )
    common = int(np.lcm(log_every, pilot_every))
    lead = int(np.ceil(LEAD_IN / (dt * common))) * common
    steps = lead + rows * log_every + log_every
    return Plan(steps, dt, -lead * dt, control_every, pilot_every, log_every, lead, rows)


def _sticks(profile: str, seed: int, plan: Plan, segments: Sequence[Segment] | None, altitude: float) -> FloatArray:
    lead, total = plan.first_log // plan.pilot_every, plan.steps // plan.pilot_every + 1
    if profile == "scripted":
        if segments is None:
            raise ParameterError("profile 'scripted' without segments", fix="give the manoeuvre's segments")
        sticks = np.zeros((total, 4))
        sticks[lead:] = scripted(segments, seed, total - lead)
    elif profile == "one_axis":
        sticks = np.zeros((total, 4))
        sticks[lead:] = stick_profile(profile, seed, total - lead)
    else:
        sticks = stick_profile(profile, seed, total)
        ramp = np.minimum(1.0, np.arange(total) / max(lead, 1))
        sticks[:, [0, 1, 3]] *= ramp[:, None]
    sticks[:, 3] *= min(1.0, altitude / LOW_FLIGHT)
    if profile == "excited" and altitude < LOW_FLIGHT:
        sticks[:, 3] += band_noise(np.random.default_rng([seed, 0x40B5]), total, *HOPS, HOP_SIZE * altitude)
    return sticks


def _empty_track(plan: Plan, rotors: int) -> Track:
    k, controls = plan.steps, -(-plan.steps // plan.control_every)
    return Track(
        gyro=np.empty((k, 3)),
        accel=np.empty((k, 3)),
        attitude=np.empty((k, 4)),
        command=np.empty((controls, rotors)),
        state=np.empty((plan.rows, STATES)),
        rotor=np.empty((plan.rows, rotors)),
        reference=np.empty((plan.rows, 4)),
    )


def fly(
    vehicle: Vehicle, truth: TruthParameters | None = None, seconds: float = 120.0, seed: int = 0,
    profile: str = "excited", *, effects: Effects | None = None, outside: Effects | None = None,
    noise_scale: float = 1.0, noise: SensorNoise | None = None, log_rate: float = 50.0,
    command_rate: float | None = None, altitude: float | None = None, gains: Mapping[str, float] | None = None,
    segments: Sequence[Segment] | None = None, extras: Sequence[str] = (), random: RandomForces | None = None,
) -> Flight:  # fmt: skip
    """Flies the closed loop at 1 kHz and logs it.

    Args:
        vehicle: geometry, mass, meaning of the rotor columns.
        truth: true parameters; default `TruthParameters.of(vehicle)`.
        seconds: length of the log [s].
        seed: decides sticks, noise and outside effects.
        profile: excited, gentle, hover, one_axis, roll_pitch, or scripted with `segments`.
        effects: hidden catalogue effects, name -> parameter -> value.
        outside: hidden effects outside the catalogue, see `quadid.flight.outside`.
        noise_scale: factor on all sensor noise and vibration; 0 for none.
        noise: sensor noise; default MEMS.
        log_rate: of the log [Hz].
        command_rate: of the rotor command [Hz], a multiple of `log_rate`; default the log rate, so that the logged
            command is exactly what acted.  At 1000 the log holds the command's mean over the sample.
        altitude: mean height above the ground [m]; default 30, or 0.6 with ground_effect.
        gains: of the stabiliser; default the vehicle file's, else `default_gains`.
        segments: the manoeuvre of profile ``scripted``.
        extras: optional channels to log: velocity, position, battery.
        random: forces and moments that act at random beside all of these.

    Raises:
        ParameterError: unknown names, impossible rates or values.
        FlightError: the vehicle crashed.
    """
    truth = TruthParameters.of(vehicle) if truth is None else truth
    effects, outside = effects or {}, outside or {}
    check_outside(outside)
    # 1. Clock, noise, and everything the vehicle is made of.
    plan = _clock(seconds, log_rate, log_rate if command_rate is None else command_rate)
    # Independent generators, so that no effect shifts another's noise
    names = ("gyro", "attitude", "attitude_slow", "accel", "velocity", "position", "battery", "shake")
    children = np.random.SeedSequence([seed, 0xF117]).spawn(len(names))
    streams = {name: np.random.default_rng(child) for name, child in zip(names, children, strict=True)}
    rotors = len(vehicle.rotors)
    sensor = (noise or SensorNoise()).scaled(noise_scale)
    phase = streams["shake"].uniform(0.0, 2.0 * np.pi, (6, rotors))
    mode = np.stack([np.cos(phase), np.sin(phase)], axis=2)
    ramp = plan.control_every * plan.dt if vehicle.command.sampling == "instant" else 0.0
    last = (plan.rows - 1) * plan.log_every * plan.dt
    setup = prepare(vehicle, truth, effects, last, ramp, (sensor.gyro_shake, sensor.accel_shake), mode)
    if gains is None:
        gains = default_gains(vehicle) if vehicle.stabiliser is None else vehicle.stabiliser.gains
    # 2. The sticks.
    height = altitude if altitude is not None else (0.6 if setup.air.ground_radius != 0.0 else 30.0)
    sticks = _sticks(profile, seed, plan, segments, height)
    # 3. Errors of gyro and attitude, delays of commands, what is outside the catalogue.
    controls, step = -(-plan.steps // plan.control_every), plan.control_every * plan.dt
    gyro_noise = sensor.gyro * streams["gyro"].standard_normal((controls, 3))
    white = sensor.attitude * streams["attitude"].standard_normal((controls, 3))
    tilt = white + coloured(streams["attitude_slow"], controls, sensor.attitude_slow, sensor.attitude_time, step)
    arrival = plan.start + step * np.arange(controls, dtype=np.float64) + setup.delay
    scene = Scene(setup, plan, arrival, np.zeros((1, PUSHES)))
    apply_outside(scene, outside, seed)
    if random is not None:
        random_forces(scene, random, np.random.default_rng([seed, 0x4F0C]))
    # 4. The flight, from level rest in hover; near the ground the pilot holds the altitude more firmly.
    trim = setup.truth.hover_speed(rotors) + setup.body.dead_speed
    pilot = Pilot(height, (trim / gains["max_speed"]) ** 2)
    if height < LOW_FLIGHT:
        pilot = pilot._replace(climb_hold=4.0, climb_brake=3.5, trim=1.0)
    track = _empty_track(plan, rotors)
    y = np.zeros(STATES)
    y[2], y[6], y[10], y[14] = -height, 1.0, 1.0, 1.0
    outcome, end = march(
        plan, setup.body, setup.air, setup.odd, setup.drive, setup.events, setup.on_board, pilot, pack_gains(gains),
        mixer_matrix(vehicle, gains), sticks, gyro_noise, tilt, scene.arrival, scene.pushes, setup.efficiency, y,
        turning_at(np.full(rotors, trim), setup.efficiency), track,
    )  # fmt: skip
    if outcome == CRASHED:
        raise FlightError(f"the vehicle crashed at {end:.1f} s", fix="smaller effects, or gains that fit the vehicle")
    # 5. The log of it, and the truth beside.
    flown = Flown(plan, setup, outside, track, sensor, streams, gyro_noise, tilt, seed)
    window = write_window(flown, extras)
    assert window.attitude_reference is not None
    recording, references = as_recording(window, vehicle), window.attitude_reference
    return Flight(window, recording, true_states(flown), references, dict(gains), vehicle)


# --- The flown vehicle stepped from outside: any controller closes the loop around the truth


LONGEST_STEP = 1e-3
"""As `fly` integrates [s]."""


class SteppedFlight:
    """One vehicle in the air, with the equations of `fly` and a command from whoever calls.

    Sensors are the caller's: effects that act in sensors alone change nothing here.

    Attributes:
        time: [s].
        rotor_speed: [rad/s], shape (rotors,).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        truth: TruthParameters | None = None,
        *,
        effects: Effects | None = None,
        height: float = 30.0,
        span: float = 60.0,
    ) -> None:
        """Begins level, at rest, in hover.

        Args:
            truth: true parameters; default `TruthParameters.of(vehicle)`.
            effects: hidden effects of the catalogue, name -> parameter -> value.
            height: above the ground [m].
            span: over which a battery sags [s].
        """
        base = TruthParameters.of(vehicle) if truth is None else truth
        still = np.zeros((6, len(vehicle.rotors), 2))
        self._setup = prepare(vehicle, base, effects or {}, span, 0.0, (0.0, 0.0), still)
        self._y = np.zeros(STATES)
        self._y[2], self._y[6], self._y[10], self._y[14] = -height, 1.0, 1.0, 1.0
        speed = base.hover_speed(len(vehicle.rotors)) + self._setup.body.dead_speed
        self.rotor_speed: FloatArray = np.full(len(vehicle.rotors), speed)
        self.time = 0.0
        self._rotors, self._progress = turning_at(self.rotor_speed, self._setup.efficiency), BEGUN
        self._arrival, self._commands = np.zeros(0), np.zeros((0, len(vehicle.rotors)))

    @property
    def position(self) -> FloatArray:
        """Of the CG, NED [m], shape (3,)."""
        return self._y[0:3].copy()

    @property
    def velocity(self) -> FloatArray:
        """Of the CG, NED [m/s], shape (3,)."""
        return self._y[3:6].copy()

    @property
    def rotation(self) -> FloatArray:
        """Body to world, shape (3, 3)."""
        return self._y[6:15].reshape(3, 3).copy()

    @property
    def quaternion(self) -> FloatArray:
        """Body to world, wxyz, shape (4,)."""
        out = np.empty(4)
        quaternion_of(self.rotation, out)
        return out

    @property
    def rate(self) -> FloatArray:
        """In body axes [rad/s], shape (3,)."""
        return self._y[15:18].copy()

    def step(self, command: FloatArray, dt: float) -> None:
        """Gives a command, which reaches the rotors after their delay, and flies on for `dt` [s].

        Args:
            command: rotor speeds [rad/s], shape (rotors,), held until the next.

        Raises:
            ParameterError: a command of another shape or not finite, or a step that is not positive.
        """
        given = np.asarray(command, dtype=np.float64)
        if given.shape != self.rotor_speed.shape or not np.isfinite(given).all() or not dt > 0.0:
            raise ParameterError(
                f"command {given} for {dt} s", f"{len(self.rotor_speed)} finite rotor speeds, a positive time"
            )
        self._arrival = np.append(self._arrival, self.time + self._setup.delay)
        self._commands = np.concatenate([self._commands, given[None]])
        end, s = self.time + dt, self._setup
        while end - self.time > EPSILON:
            stop = min(end, self.time + LONGEST_STEP)
            progress = fly_on(
                self.time, stop, len(self._arrival), self._progress, self._commands, self._arrival, s.efficiency,
                np.zeros(PUSHES), s.body, s.air, Oddity(), s.drive, s.events, self._y, self._rotors,
            )  # fmt: skip
            # Commands that act already are forgotten.
            self._arrival, self._commands = self._arrival[progress.head :], self._commands[progress.head :]
            self._progress, self.time = progress._replace(head=0), stop
