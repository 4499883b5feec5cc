"""Effects OUTSIDE the catalogue: what no entry of `quadid.effects` explains, so that a diagnosis must answer "unknown".

Each has a realistic size and a seed.  `arrange` changes the flight before take-off, `distort` the log afterwards.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from quadid.errors import ParameterError, nearest
from quadid.flight import outside_flight, outside_log
from quadid.flight.draw import vehicle_scales
from quadid.flight.outside_flight import Arrange, Scene
from quadid.flight.outside_log import Distort, LogRows
from quadid.vehicle import Vehicle


@dataclass(frozen=True)
class Size:
    """Realistic range of one number on a Pelican.

    Attributes:
        low, high: range.
        unit: SI unit, or what it is relative to.
        scales: whether it grows with the effect (a frequency does not).
        by: key of `draw.vehicle_scales`, for numbers that depend on the vehicle's size.
    """

    low: float
    high: float
    unit: str
    scales: bool = True
    by: str = ""


@dataclass(frozen=True)
class OutsideEffect:
    """One effect outside the catalogue.

    Attributes:
        name: identifier.
        nature: structure, propulsion, environment, sensors or software.
        summary: one sentence.
        sizes: its numbers.
        arrange: changes the flight, or None.
        distort: changes the log, or None.
    """

    name: str
    nature: str
    summary: str
    sizes: Mapping[str, Size]
    arrange: Arrange | None = None
    distort: Distort | None = None


def _effects() -> tuple[OutsideEffect, ...]:
    f, g, s, fixed = outside_flight, outside_log, Size, False
    make = OutsideEffect
    return (
        make(
            "suspended_load", "structure", "A load swings below the vehicle.",
            {"share": s(0.05, 0.12, ""), "length": s(0.5, 1.5, "m", fixed), "damping": s(0.04, 0.08, "", fixed),
             "depth": s(0.02, 0.05, "m", fixed, "lever")}, f.suspended_load),
        make(
            "flexible_arm", "structure", "Torque reaches the body through arms that resonate.",
            {"share": s(0.25, 0.5, ""), "frequency": s(6.0, 11.0, "Hz", fixed), "damping": s(0.05, 0.12, "", fixed)},
            f.flexible_arm),
        make(
            "slosh", "structure", "Fluid moves in a tank.",
            {"share": s(0.05, 0.12, ""), "frequency": s(1.2, 2.2, "Hz", fixed), "damping": s(0.08, 0.15, "", fixed),
             "depth": s(0.04, 0.08, "m", fixed, "lever")}, f.slosh),
        make(
            "gimbal_torque", "structure", "An unbalanced gimbal turns steadily.",
            {"roll": s(0.5, 1.5, "rad/s^2"), "pitch": s(0.5, 1.5, "rad/s^2"),
             "frequency": s(0.6, 2.0, "Hz", fixed)}, f.gimbal_torque),
        make(
            "thrust_hysteresis", "propulsion", "Thrust depends on whether the rotor last sped up or slowed down.",
            {"fraction": s(0.02, 0.06, "")}, f.thrust_hysteresis),
        make(
            "esc_slew", "propulsion", "Rotor speed changes at a limited rate (smaller is stronger).",
            {"rate": s(1.4, 2.2, "hover speeds per s", fixed)}, f.esc_slew),
        make(
            "weak_supply", "propulsion", "Above a knee the rotors follow a share of the command (smaller: stronger).",
            {"knee": s(0.98, 1.04, "hover speeds", fixed), "share": s(0.4, 0.7, "", fixed)}, f.weak_supply),
        make(
            "esc_grain", "propulsion", "Rotor speed comes in coarse steps.",
            {"grain": s(0.03, 0.06, "hover speeds")}, f.esc_grain),
        make(
            "rotor_dropout", "propulsion", "One rotor loses thrust now and then.",
            {"share": s(0.08, 0.2, "", True, "balance"), "every": s(5.0, 12.0, "s", fixed),
             "lasts": s(0.6, 2.0, "s", fixed)},
            f.rotor_dropout),
        make(
            "gusts", "environment", "Turbulence pushes and turns (Dryden-like).",
            {"push": s(0.3, 0.9, "m/s^2"), "turn": s(0.4, 1.2, "rad/s^2"), "time": s(0.3, 1.0, "s", fixed)}, f.gusts),
        make(
            "transverse_flow", "environment", "Flying diagonally rolls the vehicle.",
            {"roll": s(0.3, 0.8, "rad/m^2")}, f.transverse_flow),
        make(
            "dead_time_jitter", "software", "Every command takes its own time.",
            {"jitter": s(0.02, 0.045, "s")}, f.dead_time_jitter),
        make(
            "lost_commands", "software", "Some commands never reach the rotors.",
            {"probability": s(0.15, 0.4, "")}, f.lost_commands),
        make(
            "vibration_rectification", "sensors", "Vibration shifts the accelerometer with rotor speed.",
            {"shift": s(0.3, 0.8, "m/s^2")}, None, g.vibration_rectification),
        make(
            "gyro_g_sensitivity", "sensors", "The gyro answers to acceleration.",
            {"gain": s(0.004, 0.012, "rad s/m")}, None, g.gyro_g_sensitivity),
        make(
            "gyro_warm_up", "sensors", "The gyro's offset moves while it warms up.",
            {"shift": s(0.02, 0.06, "rad/s"), "time": s(20.0, 60.0, "s", fixed)}, None, g.gyro_warm_up),
        make(
            "gyro_clipping", "sensors", "The gyro saturates (smaller is stronger).",
            {"limit": s(0.5, 0.8, "rad/s", fixed)}, None, g.gyro_clipping),
        make(
            "accel_clipping", "sensors", "The accelerometer saturates (smaller is stronger).",
            {"limit": s(1.03, 1.08, "g", fixed)}, None, g.accel_clipping),
        make(
            "loose_imu", "sensors", "The IMU swings on its soft mount.",
            {"frequency": s(5.0, 9.0, "Hz", fixed), "damping": s(0.06, 0.15, "", fixed)}, None, g.loose_imu),
        make(
            "compass_throttle", "sensors", "Motor current turns the compass.",
            {"gain": s(0.4, 1.2, "rad")}, None, g.compass_throttle),
        make(
            "attitude_steps", "sensors", "Attitude is logged in coarse steps.",
            {"step": s(0.02, 0.05, "rad")}, None, g.attitude_steps),
        make(
            "clock_jitter", "software", "Sensor rows carry a time that is not when they were measured.",
            {"sigma": s(0.004, 0.009, "s")}, None, g.clock_jitter),
        make(
            "repeated_rows", "software", "Some sensor rows are copies of the row before.",
            {"probability": s(0.1, 0.3, "")}, None, g.repeated_rows),
        make(
            "gyro_spikes", "sensors", "Single gyro rows are far off.",
            {"probability": s(0.01, 0.03, ""), "size": s(0.5, 2.0, "rad/s", fixed)}, None, g.gyro_spikes),
    )  # fmt: skip


OUTSIDE: dict[str, OutsideEffect] = {effect.name: effect for effect in _effects()}
"""Every effect outside the catalogue, by name."""


def _stream(name: str, seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def draw_outside(name: str, seed: int, scale: float = 1.0, vehicle: Vehicle | None = None) -> dict[str, float]:
    """Draws the numbers of one outside effect at realistic size.

    Args:
        name: key of `OUTSIDE`.
        seed: decides the draw.
        scale: multiplies those numbers that grow with the effect.
        vehicle: scales levers from a Pelican's; default a Pelican.

    Raises:
        ParameterError: unknown name.
    """
    if name not in OUTSIDE:
        raise ParameterError(f"unknown outside effect '{name}'", fix=nearest(name, OUTSIDE))
    rng, factors = _stream(name, seed), vehicle_scales(vehicle)
    return {
        key: float(rng.uniform(size.low, size.high) * (scale if size.scales else 1.0) * factors.get(size.by, 1.0))
        for key, size in OUTSIDE[name].sizes.items()
    }


def check_outside(outside: Mapping[str, Mapping[str, float]]) -> None:
    """Raises ParameterError unless every effect is known and has exactly its numbers."""
    for name, values in outside.items():
        if name not in OUTSIDE:
            raise ParameterError(f"unknown outside effect '{name}'", fix=nearest(name, OUTSIDE))
        sizes = OUTSIDE[name].sizes
        if set(values) != set(sizes) or not all(np.isfinite(v) for v in values.values()):
            raise ParameterError(f"{name} with {dict(values)}", "finite values for " + ", ".join(sizes))


def apply_outside(scene: Scene, outside: Mapping[str, Mapping[str, float]], seed: int) -> None:
    """Arranges all outside effects before take-off; changes `scene`."""
    for name, values in outside.items():
        arrange = OUTSIDE[name].arrange
        if arrange is not None:
            arrange(scene, values, _stream(name, seed))


def distort_log(rows: LogRows, outside: Mapping[str, Mapping[str, float]], seed: int) -> None:
    """Distorts the log with all outside effects; changes `rows`."""
    for name, values in outside.items():
        distort = OUTSIDE[name].distort
        if distort is not None:
            distort(rows, values, _stream(name, seed))
