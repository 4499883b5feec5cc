"""Pilot of the flown vehicle: stick movements, stabiliser, and what keeps the vehicle in its box."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfilt

from quadid.errors import ParameterError, nearest
from quadid.flight.airframe import kernel
from quadid.flight.setup import TruthParameters
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

# --- The pilot: keeps the vehicle in the box, and moves the sticks on top of that
#
# Works at 50 Hz on what a pilot sees (true position, velocity, heading), so its corrections carry no sensor noise.


PILOT_STEP = 0.02
"""Time between two looks of the pilot [s]."""


class Pilot(NamedTuple):
    """Gains with which the pilot holds the vehicle in place.

    Attributes:
        altitude: wanted height above the ground, which is at world z = 0 [m].
        hover_throttle: throttle that carries the weight in hover.
        hold: position gain [1/s^2]; brake: velocity gain [1/s], horizontally.
        climb_hold: height gain [1/s^2]; climb_brake: vertical velocity gain [1/s]; trim: integral gain [1/s^3].
        horizon: how quickly the pilot corrects a tilt that stays away from what was asked for [1/s]; a human looks at
            the horizon, and so survives an attitude filter that drifts.
        reach: largest horizontal acceleration asked for [m/s^2].
        tilt_limit: largest roll or pitch reference [rad].
        throttle_limits: lowest and highest throttle.
    """

    altitude: float
    hover_throttle: float
    hold: float = 0.03
    brake: float = 0.22
    climb_hold: float = 0.5
    climb_brake: float = 1.2
    trim: float = 0.1
    horizon: float = 0.8
    reach: float = 2.0
    tilt_limit: float = 0.5
    throttle_limits: tuple[float, float] = (0.08, 0.85)


@kernel
def fly_by_hand(
    pilot: Pilot,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
    stick: FloatArray,
    memory: FloatArray,
    reference: FloatArray,
) -> None:
    """One look of the pilot: corrections plus stick movement give the references of the stabiliser.

    Args:
        position: world NED [m].
        velocity: world NED [m/s].
        attitude: rotation matrix, body to world.
        stick: roll, pitch to add [rad], yaw [rad], collective to add [fraction of hover thrust].
        memory: trim of the collective [m/s^2], of roll and of pitch [rad], shape (3,); updated.
        reference: roll, pitch, yaw [rad], throttle 0..1; written.
    """
    ask_north = -pilot.hold * position[0] - pilot.brake * velocity[0]
    ask_east = -pilot.hold * position[1] - pilot.brake * velocity[1]
    size = np.sqrt(ask_north * ask_north + ask_east * ask_east)
    if size > pilot.reach:
        ask_north, ask_east = ask_north * pilot.reach / size, ask_east * pilot.reach / size
    yaw = np.arctan2(attitude[1, 0], attitude[0, 0])
    forward = np.cos(yaw) * ask_north + np.sin(yaw) * ask_east
    right = -np.sin(yaw) * ask_north + np.cos(yaw) * ask_east
    limit = pilot.tilt_limit
    wanted_roll, wanted_pitch = np.arctan(right / GRAVITY) + stick[0], np.arctan(-forward / GRAVITY) + stick[1]
    roll = np.arctan2(attitude[2, 1], attitude[2, 2])
    pitch = -np.arcsin(min(max(attitude[2, 0], -1.0), 1.0))
    memory[1] = min(max(memory[1] + pilot.horizon * (wanted_roll - roll) * PILOT_STEP, -0.3), 0.3)
    memory[2] = min(max(memory[2] + pilot.horizon * (wanted_pitch - pitch) * PILOT_STEP, -0.3), 0.3)
    reference[0] = min(max(wanted_roll + memory[1], -limit), limit)
    reference[1] = min(max(wanted_pitch + memory[2], -limit), limit)
    reference[2] = stick[2]

    low = -pilot.altitude - position[2]
    # positive `low`: above the wanted height (z counts down)
    memory[0] = min(max(memory[0] - pilot.trim * low * PILOT_STEP, -0.5 * GRAVITY), 0.5 * GRAVITY)
    lift = -pilot.climb_hold * low + pilot.climb_brake * velocity[2] + memory[0]
    lift = min(max(lift, -0.5 * GRAVITY), 0.6 * GRAVITY)
    upright = max(attitude[2, 2], 0.6)
    throttle = pilot.hover_throttle * (1.0 + lift / GRAVITY + stick[3]) / upright
    reference[3] = min(max(throttle, pilot.throttle_limits[0]), pilot.throttle_limits[1])


# --- Stick movements: what the pilot does on top of keeping the vehicle in place.  All seeded, all at 50 Hz


AXES = ("roll", "pitch", "yaw", "throttle")
"""Columns of a stick profile: roll, pitch [rad], yaw [rad], collective [fraction of hover thrust]."""
KINDS = ("step", "pulse", "doublet", "3211", "sine", "chirp", "sweep", "multisine", "noise")


SWEEP_FADE = 1.0
"""Time over which a sweep grows at its beginning, and fades at its end [s]."""


@cache
def _band(low: float, high: float) -> tuple[FloatArray, float]:
    """Band-pass sections and the rms that they give white noise of unit rms."""
    sections = butter(2, [low, high], btype="bandpass", fs=1.0 / PILOT_STEP, output="sos")
    impulse = np.zeros(int(10.0 / (low * PILOT_STEP)))
    impulse[0] = 1.0
    return sections, float(np.sqrt(np.sum(sosfilt(sections, impulse) ** 2)))


def band_noise(rng: np.random.Generator, n: int, low: float, high: float, rms: float) -> FloatArray:
    """Gaussian noise in a band [Hz] with a given expected rms, `n` samples at 50 Hz; a longer one starts the same."""
    settle = int(3.0 / (low * PILOT_STEP))
    sections, gain = _band(low, high)
    return np.asarray(sosfilt(sections, rng.standard_normal(n + settle))[settle:] * (rms / gain))


def doublets(rng: np.random.Generator, n: int, every: float, width: tuple[float, float], size: float) -> FloatArray:
    """Doublets (up, then down) at random times, on average one in `every` seconds.

    Args:
        every: mean distance [s].
        width: shortest and longest half doublet [s].
        size: amplitude, each scaled by 0.5..1 with random sign.
    """
    out = np.zeros(n)
    k = int(rng.exponential(every) / PILOT_STEP)
    while k < n:
        half = int(rng.uniform(*width) / PILOT_STEP)
        height = size * rng.uniform(0.5, 1.0) * rng.choice([-1.0, 1.0])
        out[k : k + half] += height
        out[k + half : k + 2 * half] -= height
        k += 2 * half + int(rng.exponential(every) / PILOT_STEP)
    return out


def _tilt(rng: np.random.Generator, n: int) -> FloatArray:
    a, b, c = rng.spawn(3)
    slow, quick = band_noise(a, n, 0.06, 0.25, 0.115), band_noise(b, n, 0.25, 1.5, 0.05)
    return slow + quick + doublets(c, n, 10.0, (0.25, 0.6), 0.2)


def _yaw(rng: np.random.Generator, n: int) -> FloatArray:
    a, b = rng.spawn(2)
    rate = band_noise(a, n, 0.01, 0.5, 0.5) + doublets(b, n, 9.0, (0.6, 1.5), 0.9)
    return np.asarray(np.cumsum(np.clip(rate, -1.2, 1.2)) * PILOT_STEP)


def _collective(rng: np.random.Generator, n: int) -> FloatArray:
    a, b = rng.spawn(2)
    return band_noise(a, n, 0.15, 1.8, 0.09) + doublets(b, n, 11.0, (0.3, 0.7), 0.13)


def excited(rng: np.random.Generator, n: int) -> FloatArray:
    """All four axes moving together: filtered noise and doublets, tilt references mostly within 25 degrees."""
    return np.column_stack([_tilt(rng, n), _tilt(rng, n), _yaw(rng, n), _collective(rng, n)])


def gentle(rng: np.random.Generator, n: int) -> FloatArray:
    """Near hover with slow small moves; reveals little about inertia."""
    a, b, c, d = rng.spawn(4)
    tilt = [band_noise(stream, n, 0.04, 0.15, 0.02) for stream in (a, b)]
    yaw = np.cumsum(band_noise(c, n, 0.02, 0.08, 0.04)) * PILOT_STEP
    return np.column_stack([*tilt, yaw, band_noise(d, n, 0.03, 0.1, 0.008)])


def hover(rng: np.random.Generator, n: int) -> FloatArray:
    """Sticks untouched."""
    return np.zeros((n, 4))


def one_axis(rng: np.random.Generator, n: int) -> FloatArray:
    """Roll alone for a third of the flight, then pitch alone, then yaw alone; no deliberate throttle."""
    out = np.zeros((n, 4))
    first, second = n // 3, 2 * n // 3
    out[:first, 0] = _tilt(rng, n)[:first]
    out[first:second, 1] = _tilt(rng, n)[first:second]
    out[second:, 2] = _yaw(rng, n - second)
    return out


def roll_pitch(rng: np.random.Generator, n: int) -> FloatArray:
    """Roll and pitch together, yaw held, no deliberate throttle."""
    return np.column_stack([_tilt(rng, n), _tilt(rng, n), np.zeros(n), np.zeros(n)])


PROFILES: dict[str, Callable[[np.random.Generator, int], FloatArray]] = {
    f.__name__: f for f in (excited, gentle, hover, one_axis, roll_pitch)
}
"""Profiles by name; `scripted` needs a list of `Segment` and is not in here."""


@dataclass(frozen=True)
class Segment:
    """One movement of one stick.

    Attributes:
        axis: roll, pitch, yaw or throttle.
        kind: step, pulse, doublet, 3211, sine, chirp, sweep, multisine, noise.  A sweep is that of ArduCopter's
            SystemID mode: two swings of the lowest frequency, then exponentially to the highest; on yaw it is a rate.
        start: when it begins [s].
        duration: how long it lasts [s]; a step stays until then.
        amplitude: roll, pitch, yaw angle [rad] (sweep of yaw: rate [rad/s]) or fraction of hover thrust; rms for noise
            and multisine.
        frequency: of a sine, lowest of chirp, sweep, multisine and noise [Hz].
        frequency_end: highest of chirp, sweep, multisine and noise [Hz].
    """

    axis: str
    kind: str
    start: float
    duration: float
    amplitude: float
    frequency: float = 0.5
    frequency_end: float = 2.0

    def __post_init__(self) -> None:
        """Checks names and ranges; raises ParameterError."""
        if self.axis not in AXES:
            raise ParameterError(f"unknown axis '{self.axis}'", ", ".join(AXES), nearest(self.axis, AXES))
        if self.kind not in KINDS:
            raise ParameterError(f"unknown segment kind '{self.kind}'", ", ".join(KINDS), nearest(self.kind, KINDS))
        if not (self.duration > 0.0 and self.start >= 0.0):
            raise ParameterError(f"segment at {self.start:g} s for {self.duration:g} s", "start >= 0, duration > 0")
        if not 0.0 < self.frequency <= max(self.frequency, self.frequency_end) < 0.5 / PILOT_STEP:
            raise ParameterError(f"frequency {self.frequency:g} Hz", f"0 < frequency < {0.5 / PILOT_STEP:g} Hz")
        limit = np.inf if self.axis == "yaw" else 0.6
        if not abs(self.amplitude) <= limit:
            raise ParameterError(f"{self.axis} amplitude {self.amplitude:g}", f"at most {limit:g}")

    @classmethod
    def from_mapping(cls, data: Mapping[str, object]) -> "Segment":
        """Builds a segment from one entry of a manoeuvre file; raises ParameterError naming a wrong key."""
        known = {f.name: f for f in fields(cls)}
        values: dict[str, str | float] = {}
        for key, value in data.items():
            if key not in known:
                raise ParameterError(f"unknown key '{key}' in a manoeuvre segment", fix=nearest(key, known))
            if key in ("axis", "kind"):
                values[key] = str(value)
            elif isinstance(value, int | float) and np.isfinite(value):
                values[key] = float(value)
            else:
                raise ParameterError(f"{key} = {value!r} in a manoeuvre segment", "a finite number")
        missing = [n for n in ("axis", "kind", "start", "duration", "amplitude") if n not in values]
        if missing:
            raise ParameterError(f"a manoeuvre segment lacks {', '.join(missing)}", ", ".join(known))
        return cls(**values)  # type: ignore[arg-type]


def _shape(segment: Segment, rng: np.random.Generator, t: FloatArray) -> FloatArray:
    span, f0, f1 = segment.duration, segment.frequency, max(segment.frequency, segment.frequency_end)
    phase = t / span
    if segment.kind in ("step", "pulse"):
        return np.ones_like(t)
    if segment.kind == "doublet":
        return np.where(phase < 0.5, 1.0, -1.0)
    if segment.kind == "3211":
        return np.where(phase < 3 / 7, 1.0, np.where(phase < 5 / 7, -1.0, np.where(phase < 6 / 7, 1.0, -1.0)))
    if segment.kind == "sine":
        return np.asarray(np.sin(2.0 * np.pi * f0 * t))
    if segment.kind == "chirp":
        return np.asarray(np.sin(2.0 * np.pi * (f0 * t + 0.5 * (f1 - f0) * t * phase)))
    if segment.kind == "sweep":
        # An exponential sweep from `low` to `high` [Hz] over `span` [s], after two swings of the lowest frequency
        steady = min(2.0 / f0, 0.5 * span)
        grown = np.log(f1 / f0) * np.maximum(t - steady, 0.0) / (span - steady)
        turns = f0 * np.where(grown > 0.0, (span - steady) * np.expm1(grown) / max(np.log(f1 / f0), 1e-9), t - steady)
        fade = np.clip(np.minimum(t, span - t) / SWEEP_FADE, 0.0, 1.0)
        swing = np.asarray(np.sin(0.5 * np.pi * fade) ** 2 * np.sin(2.0 * np.pi * turns))
        return np.asarray(np.cumsum(swing) * PILOT_STEP) if segment.axis == "yaw" else swing
    if segment.kind == "noise":
        return band_noise(rng, len(t), f0, max(f1, 1.2 * f0), 1.0)
    lines = np.arange(np.ceil(f0 * span), np.floor(f1 * span) + 1) / span
    if len(lines) == 0:
        lines = np.array([f0])
    # Schroeder phases keep the peak of a multisine low.  Those of two axes differ by a turn over all lines, so that
    # their product has no mean: a tilt in step with the heading would push the vehicle away.
    k, n = np.arange(len(lines)), len(lines)
    angles = 2.0 * np.pi * (np.outer(t, lines) + AXES.index(segment.axis) * k / n) - np.pi * k * (k + 1) / n
    return np.asarray(np.sin(angles).sum(axis=1) * np.sqrt(2.0 / len(lines)))


def scripted(segments: Sequence[Segment], seed: int, n: int) -> FloatArray:
    """Sticks that fly a manoeuvre: the sum of its segments.

    Args:
        segments: movements; those after the end are cut.
        seed: decides noise segments only.
        n: samples at 50 Hz.

    Returns:
        Shape (n, 4), see `AXES`.
    """
    out = np.zeros((n, 4))
    for index, segment in enumerate(segments):
        first = round(segment.start / PILOT_STEP)
        last = min(n, first + round(segment.duration / PILOT_STEP))
        if first < last:
            t = PILOT_STEP * np.arange(last - first, dtype=np.float64)
            rng = np.random.default_rng([seed, 0x5E6, index])
            out[first:last, AXES.index(segment.axis)] += segment.amplitude * _shape(segment, rng, t)
    return out


def stick_profile(profile: str, seed: int, n: int) -> FloatArray:
    """Sticks of a named profile, shape (n, 4); raises ParameterError for an unknown name."""
    if profile not in PROFILES:
        raise ParameterError(f"unknown profile '{profile}'", ", ".join(PROFILES), nearest(profile, PROFILES))
    return PROFILES[profile](np.random.default_rng([seed, 0x571C]), n)


# --- The stabiliser of the flown vehicle: gains tuned on the type's truth; its law is `quadid.attitude_controller`


ANGLE_BANDWIDTH, YAW_BANDWIDTH = 4.5, 1.5
RATE_BANDWIDTH, YAW_RATE_BANDWIDTH = 11.0, 3.0
RATE_INTEGRAL, YAW_INTEGRAL = 14.0, 1.5
MAX_OVER_HOVER, MIN_OVER_HOVER = 1.8, 0.25


def default_gains(vehicle: Vehicle) -> dict[str, float]:
    """Gains tuned on the type's truth (`TruthParameters.of`), stable with commands held over 20 ms.

    Bandwidths: angle 4.5 1/s (yaw 1.5), rate 11 1/s (yaw 3).  They leave room for 60 ms of rotor lag or 40 ms of delay.
    """
    base = TruthParameters.of(vehicle)
    hover = base.hover_speed(len(vehicle.rotors))
    yaw_torque = 0.3 * base.d * len(vehicle.rotors) * hover**2
    fastest = min(MAX_OVER_HOVER * hover, vehicle.command.max_speed or np.inf)
    return {
        "roll_p": ANGLE_BANDWIDTH,
        "pitch_p": ANGLE_BANDWIDTH,
        "yaw_p": YAW_BANDWIDTH,
        "roll_rate_p": RATE_BANDWIDTH * base.J_xx,
        "pitch_rate_p": RATE_BANDWIDTH * base.J_yy,
        "yaw_rate_p": YAW_RATE_BANDWIDTH * base.J_zz,
        "roll_rate_i": RATE_INTEGRAL * base.J_xx,
        "pitch_rate_i": RATE_INTEGRAL * base.J_yy,
        "yaw_rate_i": YAW_INTEGRAL * base.J_zz,
        "yaw_rate_limit": 1.5,
        "roll_pitch_rate_limit": 4.0,
        "yaw_torque_limit": yaw_torque,
        "thrust_coefficient": base.b,
        "drag_coefficient": base.d,
        "min_speed": MIN_OVER_HOVER * hover,
        "max_speed": float(fastest),
    }
