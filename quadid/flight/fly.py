"""Flies the vehicle and returns what a log of it would hold, with the truth beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from quadid.attitude_controller import mixer_matrix, pack_gains
from quadid.errors import ParameterError, QuadidError
from quadid.flight.airframe import STATES
from quadid.flight.loop import Plan, Track
from quadid.flight.march import CRASHED, march
from quadid.flight.outside import apply_outside, check_outside
from quadid.flight.outside_flight import Scene
from quadid.flight.pilot import PILOT_STEP, Pilot
from quadid.flight.profiles import Segment, band_noise, scripted, stick_profile
from quadid.flight.record import Flight, Flown, as_recording, true_states, write_window
from quadid.flight.sensors import SensorNoise, coloured
from quadid.flight.setup import Effects, Setup, prepare
from quadid.flight.stabiliser import default_gains
from quadid.flight.truth import TruthParameters
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

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
        altitude: mean height above the ground [m]; default 30, or 0.6 with ground_effect.
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
    mode = np.stack([np.cos(phase), np.sin(phase)], axis=2)
    ramp = plan.control_every * plan.dt if vehicle.command.sampling == "instant" else 0.0
    last = (plan.rows - 1) * plan.log_every * plan.dt
    setup = prepare(vehicle, truth, effects, last, ramp, (sensor.gyro_shake, sensor.accel_shake), mode)
    if gains is None:
        gains = default_gains(vehicle) if vehicle.stabiliser is None else vehicle.stabiliser.gains
    height = altitude if altitude is not None else (0.6 if setup.air.ground_radius != 0.0 else 30.0)
    sticks = _sticks(profile, seed, plan, segments, height)
    flown = _march(plan, setup, outside, gains, height, sticks, sensor, streams, seed)
    window = write_window(flown, extras)
    assert window.attitude_reference is not None
    return Flight(
        window=window,
        recording=as_recording(window, vehicle),
        truth=true_states(flown),
        references=window.attitude_reference,
        gains=dict(gains),
        vehicle=vehicle,
    )


def _march(
    plan: Plan,
    setup: Setup,
    outside: Effects,
    gains: Mapping[str, float],
    altitude: float,
    sticks: FloatArray,
    sensor: SensorNoise,
    streams: Mapping[str, np.random.Generator],
    seed: int,
) -> Flown:
    controls, step = -(-plan.steps // plan.control_every), plan.control_every * plan.dt
    gyro_noise = sensor.gyro * streams["gyro"].standard_normal((controls, 3))
    white = sensor.attitude * streams["attitude"].standard_normal((controls, 3))
    slow = coloured(streams["attitude_slow"], controls, sensor.attitude_slow, sensor.attitude_time, step)
    arrival = plan.start + step * np.arange(controls, dtype=np.float64) + setup.delay
    scene = Scene(setup, plan, arrival, np.zeros((1, 6)))
    apply_outside(scene, outside, seed)
    pilot, trim = _pilot(setup, gains, altitude)
    track = _empty_track(plan, len(setup.vehicle.rotors))
    outcome, end = march(
        plan, setup.body, setup.air, setup.odd, setup.drive, setup.events, setup.on_board, pilot,
        pack_gains(gains), mixer_matrix(setup.vehicle, gains), sticks, gyro_noise, white + slow,
        scene.arrival, scene.pushes, setup.efficiency,
        _start(altitude), np.full(len(setup.vehicle.rotors), trim), track,
    )  # fmt: skip
    if outcome == CRASHED:
        raise FlightError(f"the vehicle crashed at {end:.1f} s", fix="smaller effects, or gains that fit the vehicle")
    return Flown(plan, setup, outside, track, sensor, streams, gyro_noise, white + slow, seed)
