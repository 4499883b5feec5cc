"""Draws catalogue effects at the sizes met on real vehicles (docs/diagnosis.md), for blinded campaigns."""

from __future__ import annotations

import zlib

import numpy as np

from quadid.effects import EFFECTS
from quadid.errors import ParameterError, nearest
from quadid.vehicle import Vehicle

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "motor_lag": {"tau": (0.02, 0.06)},
    "command_delay": {"delay": (0.012, 0.04)},
    "imu_lag": {"cutoff": (4.0, 12.0)},
    "attitude_delay": {"delay": (0.015, 0.06)},
    "rotor_drag": {"k_x": (0.12, 0.45), "k_y": (0.12, 0.45)},
    "parasitic_drag": {"c": (0.01, 0.06)},
    "translational_lift": {"k": (0.005, 0.03)},
    "rotor_drag_moment": {"h_x": (0.01, 0.05), "h_y": (0.01, 0.05)},
    "rate_damping": {"l_p": (0.3, 2.0), "m_q": (0.3, 2.0), "n_r": (0.1, 0.6)},
    "axial_inflow": {"k_z": (0.1, 0.5)},
    "wind": {"north": (1.0, 5.0), "east": (1.0, 5.0)},
    "weak_rotor": {"loss": (0.03, 0.15)},
    "cg_offset": {"x": (0.002, 0.012), "y": (0.002, 0.012)},
    "mass_change": {"fraction": (0.05, 0.25)},
    "thrust_drop": {"fraction": (0.04, 0.15)},
    "battery_sag": {"fraction": (0.05, 0.15)},
    "supply_voltage": {"exponent": (0.7, 1.3)},
    "rotor_telemetry_delay": {"delay": (0.005, 0.015)},
    "drag_torque_curve": {"growth": (0.5, 1.2)},
    "no_gyroscopic_coupling": {"share": (0.9, 1.0)},
    "thrust_curve": {"dead_speed": (18.0, 70.0)},
    "product_of_inertia": {"J_xy": (5e-4, 2e-3), "J_xz": (5e-4, 2e-3), "J_yz": (5e-4, 2e-3)},
    "rotor_spin_up": {"J": (2e-5, 8e-5)},
    "gyro_bias": {"x": (0.005, 0.03), "y": (0.005, 0.03), "z": (0.005, 0.03)},
    "accel_bias": {"x": (0.1, 0.5), "y": (0.1, 0.5), "z": (0.1, 0.5)},
    "gyro_scale": {"x": (0.01, 0.05), "y": (0.01, 0.05), "z": (0.01, 0.05)},
    "imu_misalignment": {"x": (0.0175, 0.07), "y": (0.0175, 0.07), "z": (0.0175, 0.07)},
    "imu_lever_arm": {"x": (0.02, 0.08), "y": (0.02, 0.08), "z": (0.02, 0.08)},
    "ahrs_acceleration_error": {"k": (0.05, 0.5)},
    "ground_effect": {"radius_scale": (1.5, 3.0)},
    "velocity_scale": {"horizontal": (0.03, 0.12), "vertical": (0.03, 0.12)},
}
"""Realistic magnitudes on a Pelican, in contract units."""
SIGNED = frozenset(
    (
        *("rotor_drag_moment", "wind", "cg_offset", "mass_change", "product_of_inertia"),
        *("gyro_bias", "accel_bias", "gyro_scale", "imu_misalignment", "imu_lever_arm", "velocity_scale"),
    )
)
"""Effects whose numbers may have either sign (mass is dropped or taken up)."""
COMPANION = {"rotor_drag_moment": "rotor_drag", "wind": "rotor_drag"}
"""Effects that cannot be seen alone: without drag there is no in-plane force and no feeling of wind."""


def vehicle_scales(vehicle: Vehicle | None) -> dict[str, float]:
    """Factors from a Pelican's sizes to this vehicle's, None being a Pelican.

    Keys: length; lever (inertia over mass: a force at a lever turns as much); balance (lever over length: one rotor's
    thrust turns as much); inertia; rotor (inertia); speed (of the rotors).
    """
    if vehicle is None:
        return dict.fromkeys(("length", "lever", "balance", "inertia", "rotor", "speed"), 1.0)
    arm = float(np.mean(np.linalg.norm(vehicle.rotor_positions[:, :2], axis=1)))
    length = arm / 0.21
    lever = min(1.0, vehicle.parameters["J_xx"].initial / vehicle.mass / (8.0e-3 / 1.30))
    return {
        "length": length,
        "lever": lever,
        "balance": min(1.0, lever / length),
        "inertia": min(1.0, vehicle.parameters["J_xx"].initial / 8.0e-3),
        "rotor": vehicle.parameters["J_r"].initial / 3.0e-5,
        "speed": vehicle.hover_speed() / 370.0,
    }


SCALED_BY = {
    "rotor_drag_moment": "lever",
    "cg_offset": "lever",
    "imu_lever_arm": "length",
    "product_of_inertia": "inertia",
    "rotor_spin_up": "rotor",
    "thrust_curve": "speed",
}
"""Effects whose size depends on the vehicle's; a moment's lever goes with inertia over mass, as the response does."""


def _one(
    name: str, rng: np.random.Generator, scale: float, vehicle: Vehicle | None, seconds: float
) -> dict[str, float]:
    factor = vehicle_scales(vehicle)[SCALED_BY[name]] if name in SCALED_BY else 1.0
    values: dict[str, float] = {}
    for key, (low, high) in SIZES[name].items():
        value = float(rng.uniform(low, high)) * factor
        value = value / scale if name == "imu_lag" else value * scale
        sign = float(rng.choice([-1.0, 1.0]))
        values[key] = value * sign if name in SIGNED else value
    if name in ("mass_change", "thrust_drop"):
        values["time"] = float(rng.uniform(0.3, 0.7)) * seconds
    if name == "weak_rotor":
        values["rotor"] = float(rng.integers(1, (4 if vehicle is None else len(vehicle.rotors)) + 1))
    return {p.name: values[p.name] for p in EFFECTS[name].parameters if p.name in values}


def draw_effect(
    name: str, seed: int, scale: float = 1.0, vehicle: Vehicle | None = None, seconds: float = 120.0
) -> dict[str, dict[str, float]]:
    """Draws one catalogue effect at realistic size, ready for ``fly(..., effects=...)``.

    Args:
        name: key of `quadid.effects.EFFECTS`.
        seed: decides the draw.
        scale: multiplies the size (divides the cut-off of imu_lag); companions are not scaled.
        vehicle: scales lengths, inertias and speeds from a Pelican's; default a Pelican.
        seconds: length of the flight, for effects that happen at a time (30 to 70 % of it).

    Returns:
        Effect name -> parameters.  Holds `rotor_drag` too where the effect is invisible without it (`COMPANION`).

    Raises:
        ParameterError: unknown name.
    """
    if name not in SIZES:
        raise ParameterError(f"unknown effect '{name}'", fix=nearest(name, SIZES))
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), 0xEFF])
    drawn = {name: _one(name, rng, scale, vehicle, seconds)}
    if name in COMPANION:
        drawn[COMPANION[name]] = _one(COMPANION[name], rng, 1.0, vehicle, seconds)
    return drawn
