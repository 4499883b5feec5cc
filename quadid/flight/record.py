"""From what was flown to what a log of it holds, with the truth beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quadid.errors import ParameterError
from quadid.flight import sensors
from quadid.flight.loop import Plan, Track, quaternion_of, supply
from quadid.flight.outside import distort_log
from quadid.flight.outside_log import LogRows
from quadid.flight.sensors import SensorNoise
from quadid.flight.setup import Effects, Setup
from quadid.flight.truth import TruthParameters
from quadid.rotation import continuous_sign
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Channel, Recording, Window

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


@dataclass(frozen=True)
class Flown:
    """A finished flight, not yet logged.

    Attributes:
        plan: clock.
        setup: constants.
        outside: effects outside the catalogue.
        track: output of `march`.
        sensor: noise.
        streams: random generators by name.
        gyro_noise: white noise of the gyro at the control instants [rad/s], shape (controls, 3).
        tilt_noise: error of the attitude there, body rotation vector [rad], shape (controls, 3).
        seed: of the flight.
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


def _sensor_rows(flown: Flown, rotor: FloatArray) -> LogRows:
    plan, setup, track = flown.plan, flown.setup, flown.track
    steps = sensors.log_steps(plan)
    at = steps.astype(np.int64) // plan.control_every
    lagged = sensors.attitude_at(track, steps - setup.attitude_delay / plan.dt)
    hover = setup.air.hover_sum / rotor.shape[1]
    gyro = sensors.read_gyro(track, plan, setup.on_board, setup.imu_cutoff, steps)
    accel = sensors.read_accel(track, plan, setup.on_board, setup.imu_cutoff, steps)
    attitude = sensors.quaternion_multiply(lagged, sensors.quaternion_exp(flown.tilt_noise[at]))
    rows = LogRows(
        gyro=gyro + flown.gyro_noise[at],
        accel=accel + flown.noise("accel", flown.sensor.accel, 3),
        attitude=continuous_sign(attitude),
        steps=steps,
        track=track,
        plan=plan,
        on_board=setup.on_board,
        thrust=np.mean((rotor / hover) ** 2, axis=1),
    )
    distort_log(rows, flown.outside, flown.seed)
    return rows


def _extras(flown: Flown, wanted: Sequence[str]) -> dict[str, FloatArray]:
    for name in wanted:
        if name not in EXTRAS:
            raise ParameterError(f"unknown optional channel '{name}'", ", ".join(EXTRAS))
    progress = np.arange(flown.plan.rows) / (flown.plan.rows - 1)
    events, t = flown.setup.events, flown.plan.dt * flown.plan.log_every * np.arange(flown.plan.rows)
    volts = FULL_BATTERY * np.sqrt(np.maximum(0.1, 1.0 - events.sag_fraction * progress))
    if events.supply_exponent != 0.0:
        hover = flown.setup.body.hover_speed
        speeds = zip(t, flown.track.rotor, strict=True)
        volts = FULL_BATTERY * np.array([supply(float(x), omega, hover, events) for x, omega in speeds])
    felt = flown.track.state[:, 3:6] * flown.setup.velocity_gain
    clean = {"velocity": felt, "position": flown.track.state[:, 0:3], "battery": volts[:, None]}
    sigma = {"velocity": flown.sensor.velocity, "position": flown.sensor.position, "battery": flown.sensor.battery}
    return {name: clean[name] + flown.noise(name, sigma[name], clean[name].shape[1]) for name in wanted}


def write_window(flown: Flown, extras: Sequence[str]) -> Window:
    """Logs the flight: sensors with all their errors, commands, references, and the optional channels asked for."""
    sampling = flown.setup.vehicle.command.sampling
    rotor = logged_rotors(flown.track, flown.plan, sampling, flown.setup.reading_delay)
    rows = _sensor_rows(flown, rotor)
    optional = _extras(flown, extras)
    return Window(
        t0=0.0,
        dt=flown.plan.log_every * flown.plan.dt,
        rotor_speed=rotor,
        gyro=rows.gyro,
        attitude=rows.attitude,
        accel=rows.accel,
        attitude_reference=flown.track.reference,
        sampling=sampling,
        name=flown.name,
        velocity=optional.get("velocity"),
        position=optional.get("position"),
        battery=optional.get("battery"),
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
