"""Flies the vehicle and returns what a log of it would hold, with the truth beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.errors import ParameterError, QuadidError
from quadid.flight import sensors
from quadid.flight.airframe import STATES
from quadid.flight.loop import Plan, Track, quaternion_of
from quadid.flight.march import CRASHED, march
from quadid.flight.outside import apply_outside, check_outside, distort_log
from quadid.flight.outside_flight import Scene
from quadid.flight.outside_log import LogRows
from quadid.flight.pilot import PILOT_STEP, Pilot
from quadid.flight.profiles import Segment, scripted, stick_profile
from quadid.flight.sensors import SensorNoise
from quadid.flight.setup import Effects, Setup, prepare
from quadid.flight.stabiliser import default_gains, mixer_matrix, pack_gains
from quadid.flight.truth import TruthParameters
from quadid.vehicle import Vehicle
from quadid.window import Channel, Recording, Window

FloatArray = NDArray[np.float64]
LEAD_IN = 5.0
"""Flown before the first log row [s], so that filters, delays and integrals have settled."""
LOW_FLIGHT = 3.0
"""Below this height the pilot holds the altitude more firmly [m]."""


class FlightError(QuadidError):
    """The vehicle hit the ground, overturned or diverged."""

    exit_code = 3


@dataclass(frozen=True)
class Truth:
    """True states at the log instants, just before the command of that instant acts; for tests only.

    Attributes:
        t: times [s], shape (n,).
        quaternion: body to world, shape (n, 4).
        rates: body rates [rad/s], shape (n, 3).
        velocity, position: of the CG, world NED [m/s], [m], shape (n, 3).
        rotor_speed: real rotor speeds [rad/s], shape (n, rotors).
        parameters: what an identification should find.
        effects: catalogue effects that were flown, complete.
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
        vehicle: what was flown.
    """

    window: Window
    recording: Recording
    truth: Truth
    references: FloatArray
    gains: Mapping[str, float]
    vehicle: Vehicle


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
            "periods that are whole fractions of a second's 1/64000, command rate a multiple of the log rate",
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
    else:
        sticks = stick_profile(profile, seed, total)
        ramp = np.minimum(1.0, np.arange(total) / max(lead, 1))
        sticks[:, [0, 1, 3]] *= ramp[:, None]
    sticks[:, 3] *= min(1.0, altitude / LOW_FLIGHT)
    return sticks


def _pilot(setup: Setup, gains: Mapping[str, float], altitude: float) -> tuple[Pilot, float]:
    trim = setup.truth.hover_speed(len(setup.vehicle.rotors)) + setup.body.dead_speed
    throttle = (trim / gains["max_speed"]) ** 2
    if altitude < LOW_FLIGHT:
        return Pilot(altitude, throttle, climb_hold=4.0, climb_brake=3.5, trim=1.0), trim
    return Pilot(altitude, throttle), trim


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


def _start(altitude: float) -> FloatArray:
    y = np.zeros(STATES)
    y[2] = -altitude
    y[6] = y[10] = y[14] = 1.0
    return y


def _logged_rotors(track: Track, plan: Plan, sampling: str) -> FloatArray:
    share = plan.log_every // plan.control_every
    first = plan.first_log // plan.control_every
    if sampling == "instant":
        return track.command[first - 1 + share * np.arange(plan.rows)]
    held = track.command[first : first + share * plan.rows]
    return np.asarray(held.reshape(plan.rows, share, -1).mean(axis=1))


def _truth(track: Track, plan: Plan, setup: Setup, outside: Effects) -> Truth:
    quaternion = np.empty((plan.rows, 4))
    for k in range(plan.rows):
        quaternion_of(np.ascontiguousarray(track.state[k, 6:15].reshape(3, 3)), quaternion[k])
    return Truth(
        t=plan.dt * plan.log_every * np.arange(plan.rows, dtype=np.float64),
        quaternion=sensors.continuous_sign(quaternion),
        rates=track.state[:, 15:18].copy(),
        velocity=track.state[:, 3:6].copy(),
        position=track.state[:, 0:3].copy(),
        rotor_speed=track.rotor,
        parameters=setup.truth,
        effects=setup.effects,
        outside={name: dict(values) for name, values in outside.items()},
    )


def _recording(window: Window, vehicle: Vehicle, seed: int) -> Recording:
    channels: dict[str, Channel] = {}
    for name in ("gyro", "accel", "attitude", "attitude_reference", "velocity", "position", "battery"):
        values = getattr(window, name)
        if values is not None:
            channels[name] = Channel(name, window.t, values, "simulated")
    rotor = window.rotor_speed
    if vehicle.command.kind == "rotor_speed":
        channels["rotor_speed"] = Channel("rotor_speed", window.t, rotor, "simulated")
    else:
        assert vehicle.command.max_speed is not None
        command = rotor / vehicle.command.max_speed
        if vehicle.command.kind == "pwm":
            low, high = vehicle.command.range
            command = low + command * (high - low)
        channels["motor_command"] = Channel("motor_command", window.t, command, "simulated")
    return Recording(f"{vehicle.name}-seed{seed}", "simulated", channels, grid=window.dt)


def _streams(seed: int) -> dict[str, np.random.Generator]:
    """Independent generators, so that no effect shifts another's noise."""
    names = ("gyro", "attitude", "attitude_slow", "accel", "velocity", "position", "battery", "shake")
    children = np.random.SeedSequence([seed, 0xF117]).spawn(len(names))
    return {name: np.random.default_rng(child) for name, child in zip(names, children, strict=True)}


def fly(
    vehicle: Vehicle,
    truth: TruthParameters | None = None,
    seconds: float = 120.0,
    seed: int = 0,
    profile: str = "excited",
    *,
    effects: Effects | None = None,
    outside: Effects | None = None,
    noise_scale: float = 1.0,
    noise: SensorNoise | None = None,
    log_rate: float = 50.0,
    command_rate: float | None = None,
    altitude: float | None = None,
    gains: Mapping[str, float] | None = None,
    segments: Sequence[Segment] | None = None,
    extras: Sequence[str] = (),
) -> Flight:
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
        altitude: height above the ground [m]; default 30, or 0.6 with ground_effect.
        gains: of the stabiliser; default the vehicle file's, else `default_gains`.
        segments: the manoeuvre of profile ``scripted``.
        extras: optional channels to log: velocity, position, battery.

    Raises:
        ParameterError: unknown names, impossible rates or values.
        FlightError: the vehicle crashed.
    """
    truth = TruthParameters.of(vehicle) if truth is None else truth
    effects, outside = effects or {}, outside or {}
    check_outside(outside)
    plan = _clock(seconds, log_rate, log_rate if command_rate is None else command_rate)
    streams, rotors = _streams(seed), len(vehicle.rotors)
    sensor = (noise or SensorNoise()).scaled(noise_scale)
    phase = streams["shake"].uniform(0.0, 2.0 * np.pi, (6, rotors))
    ramp = plan.control_every * plan.dt if vehicle.command.sampling == "instant" else 0.0
    last = (plan.rows - 1) * plan.log_every * plan.dt
    setup = prepare(vehicle, truth, effects, last, ramp, (sensor.gyro_shake, sensor.accel_shake), phase)
    if gains is None:
        gains = default_gains(vehicle) if vehicle.stabiliser is None else vehicle.stabiliser.gains
    height = altitude if altitude is not None else (0.6 if setup.air.ground_radius != 0.0 else 30.0)
    return _march(plan, setup, outside, gains, height, profile, segments, sensor, streams, seed, extras)


def _march(
    plan: Plan,
    setup: Setup,
    outside: Effects,
    gains: Mapping[str, float],
    altitude: float,
    profile: str,
    segments: Sequence[Segment] | None,
    sensor: SensorNoise,
    streams: Mapping[str, np.random.Generator],
    seed: int,
    extras: Sequence[str],
) -> Flight:
    controls, control_dt = -(-plan.steps // plan.control_every), plan.control_every * plan.dt
    gyro_noise = sensor.gyro * streams["gyro"].standard_normal((controls, 3))
    tilt_noise = sensor.attitude * streams["attitude"].standard_normal((controls, 3)) + sensors.coloured(
        streams["attitude_slow"], controls, sensor.attitude_slow, sensor.attitude_time, control_dt
    )
    arrival = plan.start + control_dt * np.arange(controls, dtype=np.float64) + setup.delay
    scene = Scene(setup, plan, arrival, np.zeros((1, 6)))
    apply_outside(scene, outside, seed)
    pilot, trim = _pilot(setup, gains, altitude)
    track = _empty_track(plan, len(setup.vehicle.rotors))
    outcome, end = march(
        plan, setup.body, setup.air, setup.odd, setup.drive, setup.events, setup.on_board, pilot,
        pack_gains(gains), mixer_matrix(setup.vehicle, gains), _sticks(profile, seed, plan, segments, altitude),
        gyro_noise, tilt_noise, scene.arrival, scene.pushes, setup.efficiency,
        _start(altitude), np.full(len(setup.vehicle.rotors), trim), track,
    )  # fmt: skip
    if outcome == CRASHED:
        raise FlightError(f"the vehicle crashed at {end:.1f} s", fix="smaller effects, or gains that fit the vehicle")
    window = _log(plan, setup, outside, track, sensor, streams, gyro_noise, tilt_noise, seed, extras)
    assert window.attitude_reference is not None
    return Flight(
        window=window,
        recording=_recording(window, setup.vehicle, seed),
        truth=_truth(track, plan, setup, outside),
        references=window.attitude_reference,
        gains=dict(gains),
        vehicle=setup.vehicle,
    )


def _log(
    plan: Plan,
    setup: Setup,
    outside: Effects,
    track: Track,
    sensor: SensorNoise,
    streams: Mapping[str, np.random.Generator],
    gyro_noise: FloatArray,
    tilt_noise: FloatArray,
    seed: int,
    extras: Sequence[str],
) -> Window:
    steps = sensors.log_steps(plan)
    at = np.arange(plan.first_log, plan.first_log + plan.rows * plan.log_every, plan.log_every) // plan.control_every
    rotor = _logged_rotors(track, plan, setup.vehicle.command.sampling)
    lagged = sensors.attitude_at(track, steps - setup.attitude_delay / plan.dt)
    hover = setup.air.hover_sum / rotor.shape[1]
    white = sensor.accel * streams["accel"].standard_normal((plan.rows, 3))
    rows = LogRows(
        gyro=sensors.read_gyro(track, plan, setup.on_board, setup.imu_cutoff, steps) + gyro_noise[at],
        accel=sensors.read_accel(track, plan, setup.on_board, setup.imu_cutoff, steps) + white,
        attitude=sensors.continuous_sign(sensors.quaternion_multiply(lagged, sensors.quaternion_exp(tilt_noise[at]))),
        steps=steps,
        track=track,
        plan=plan,
        on_board=setup.on_board,
        thrust=np.mean((rotor / hover) ** 2, axis=1),
    )
    distort_log(rows, outside, seed)
    period = plan.log_every * plan.dt
    progress = np.arange(plan.rows) / (plan.rows - 1)
    volts = 12.4 * np.sqrt(np.maximum(0.1, 1.0 - setup.events.sag_fraction * progress))
    optional = {
        "velocity": track.state[:, 3:6] + sensor.velocity * streams["velocity"].standard_normal((plan.rows, 3)),
        "position": track.state[:, 0:3] + sensor.position * streams["position"].standard_normal((plan.rows, 3)),
        "battery": (volts + sensor.battery * streams["battery"].standard_normal(plan.rows))[:, None],
    }
    for name in extras:
        if name not in optional:
            raise ParameterError(f"unknown optional channel '{name}'", ", ".join(optional))
    return Window(
        t0=0.0,
        dt=period,
        rotor_speed=rotor,
        gyro=rows.gyro,
        attitude=rows.attitude,
        accel=rows.accel,
        attitude_reference=track.reference,
        sampling=setup.vehicle.command.sampling,
        name=f"{setup.vehicle.name}-seed{seed}",
        velocity=optional["velocity"] if "velocity" in extras else None,
        position=optional["position"] if "position" in extras else None,
        battery=optional["battery"] if "battery" in extras else None,
    )
