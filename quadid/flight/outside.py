"""Effects OUTSIDE the catalogue: what no entry of `quadid.effects` explains, so that a diagnosis must answer "unknown".

Each has a realistic size and a seed.  `arrange` changes the flight before take-off, `distort` the log afterwards.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quadid.errors import ParameterError, nearest
from quadid.flight import outside_flight as f
from quadid.flight import outside_log as g
from quadid.flight.draw import vehicle_scales
from quadid.flight.outside_flight import Arrange, Scene
from quadid.flight.outside_log import Distort, LogRows
from quadid.vehicle import Vehicle


class Size(NamedTuple):
    """Realistic range of one number on a Pelican.

    Attributes:
        low, high: range.
        scales: whether it grows with the effect (a frequency does not).
        by: key of `draw.vehicle_scales`, for numbers that depend on the vehicle's size.
    """

    low: float
    high: float
    scales: bool = True
    by: str = ""


def _fixed(low: float, high: float, by: str = "") -> Size:
    return Size(low, high, False, by)


Sizes = dict[str, Size]
ARRANGE: dict[Arrange, Sizes] = {
    f.suspended_load: {  # length, depth [m]
        "share": Size(0.05, 0.12), "length": _fixed(0.5, 1.5), "damping": _fixed(0.04, 0.08),
        "depth": _fixed(0.02, 0.05, "lever"),
    },
    f.flexible_arm: {"share": Size(0.25, 0.5), "frequency": _fixed(6.0, 11.0), "damping": _fixed(0.05, 0.12)},  # [Hz]
    f.slosh: {  # [Hz], [m]
        "share": Size(0.05, 0.12), "frequency": _fixed(1.2, 2.2), "damping": _fixed(0.08, 0.15),
        "depth": _fixed(0.04, 0.08, "lever"),
    },
    f.gimbal_torque: {"roll": Size(0.5, 1.5), "pitch": Size(0.5, 1.5), "frequency": _fixed(0.6, 2.0)},  # [rad/s^2]
    f.thrust_hysteresis: {"fraction": Size(0.02, 0.06)},
    f.esc_slew: {"rate": _fixed(1.4, 2.2)},  # hover speeds per s; smaller is stronger
    f.weak_supply: {"knee": _fixed(0.98, 1.04), "share": _fixed(0.4, 0.7)},  # hover speeds; smaller is stronger
    f.esc_grain: {"grain": Size(0.03, 0.06)},  # hover speeds
    f.rotor_dropout: {"share": Size(0.08, 0.2, True, "balance"), "every": _fixed(5.0, 12.0), "lasts": _fixed(0.6, 2.0)},
    f.gusts: {"push": Size(0.3, 0.9), "turn": Size(0.4, 1.2), "time": _fixed(0.3, 1.0)},  # [m/s^2], [rad/s^2], [s]
    f.transverse_flow: {"roll": Size(0.3, 0.8)},  # [rad/m^2]
    f.dead_time_jitter: {"jitter": Size(0.02, 0.045)},  # [s]
    f.lost_commands: {"probability": Size(0.15, 0.4)},
}  # fmt: skip
"""What changes a flight: the function, which names and describes the effect, and its numbers."""
DISTORT: dict[Distort, Sizes] = {
    g.vibration_rectification: {"shift": Size(0.3, 0.8)},  # [m/s^2]
    g.gyro_g_sensitivity: {"gain": Size(0.004, 0.012)},  # [rad s/m]
    g.gyro_warm_up: {"shift": Size(0.02, 0.06), "time": _fixed(20.0, 60.0)},  # [rad/s], [s]
    g.gyro_clipping: {"limit": _fixed(0.5, 0.8)},  # [rad/s]; smaller is stronger
    g.accel_clipping: {"limit": _fixed(1.03, 1.08)},  # g; smaller is stronger
    g.loose_imu: {"frequency": _fixed(5.0, 9.0), "damping": _fixed(0.06, 0.15)},  # [Hz]
    g.compass_throttle: {"gain": Size(0.4, 1.2)},  # [rad]
    g.attitude_steps: {"step": Size(0.02, 0.05)},  # [rad]
    g.clock_jitter: {"sigma": Size(0.004, 0.009)},  # [s]
    g.repeated_rows: {"probability": Size(0.1, 0.3)},
    g.gyro_spikes: {"probability": Size(0.01, 0.03), "size": _fixed(0.5, 2.0)},  # size [rad/s]
}
"""What changes a log, likewise."""
OUTSIDE: dict[str, Sizes] = {act.__name__: sizes for act, sizes in (*ARRANGE.items(), *DISTORT.items())}
"""Numbers of every effect outside the catalogue, by its name."""


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
        for key, size in OUTSIDE[name].items()
    }


def check_outside(outside: Mapping[str, Mapping[str, float]]) -> None:
    """Raises ParameterError unless every effect is known and has exactly its numbers."""
    for name, values in outside.items():
        if name not in OUTSIDE:
            raise ParameterError(f"unknown outside effect '{name}'", fix=nearest(name, OUTSIDE))
        sizes = OUTSIDE[name]
        if set(values) != set(sizes) or not all(np.isfinite(v) for v in values.values()):
            raise ParameterError(f"{name} with {dict(values)}", "finite values for " + ", ".join(sizes))


def apply_outside(scene: Scene, outside: Mapping[str, Mapping[str, float]], seed: int) -> None:
    """Arranges all outside effects before take-off; changes `scene`."""
    arrange = {act.__name__: act for act in ARRANGE}
    for name in filter(arrange.__contains__, outside):
        arrange[name](scene, outside[name], _stream(name, seed))


def distort_log(rows: LogRows, outside: Mapping[str, Mapping[str, float]], seed: int) -> None:
    """Distorts the log with all outside effects; changes `rows`."""
    distort = {act.__name__: act for act in DISTORT}
    for name in filter(distort.__contains__, outside):
        distort[name](rows, outside[name], _stream(name, seed))
