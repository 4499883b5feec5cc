"""One sentence a finding, for a pilot: what it is, how large, what it is worth."""

from __future__ import annotations

from collections.abc import Mapping

_FORMS: dict[str, str] = {
    "motor_lag": "the rotors need {tau:.0f} ms to follow a command (first-order lag), seen as late rotation and thrust",
    "command_delay": "commands reach the rotors {delay:.0f} ms late, seen as a pure delay of rotation and thrust",
    "imu_lag": "gyro and accelerometer are low-passed at {cutoff:.1f} Hz and so lag behind the attitude",
    "attitude_delay": "the attitude estimate arrives {delay:.0f} ms late against the integrated gyro",
    "rotor_drag": "the rotors drag against sideways flight by {k_x:.2f} and {k_y:.2f} m/s^2 for each m/s",
    "parasitic_drag": "the frame's air drag grows with the square of speed, {c:.3f} 1/m",
    "rotor_drag_moment": "rotor drag acts {h_x:.1f} and {h_y:.1f} mm off the centre of gravity and tilts the vehicle "
    "in sideways flight",
    "rate_damping": "the air damps roll and pitch rotation by {l_p:.2f} and {m_q:.2f} 1/s",
    "axial_inflow": "thrust falls by {k_z:.2f} m/s^2 for each m/s of climb",
    "wind": "the air moved by {north:.1f} m/s north and {east:.1f} m/s east",
    "weak_rotor": "rotor {rotor:.0f} gives {loss:.1f} % less thrust and drag torque than the others",
    "cg_offset": "the centre of gravity lies {x:.1f} mm forward and {y:.1f} mm to the right of the geometric centre",
    "mass_change": "at {time:.1f} s the mass changed by {fraction:.1f} %",
    "thrust_drop": "at {time:.1f} s all rotors lost {fraction:.1f} % of their thrust",
    "battery_sag": "thrust at the same command faded by {fraction:.1f} % from the first to the last sample",
    "thrust_curve": "thrust follows (speed - {dead_speed:.0f} rad/s)^2 rather than speed^2",
    "product_of_inertia": "the inertia axes are tilted: a moment about one axis also turns another",
    "rotor_spin_up": "speeding the rotors up or down turns the vehicle in yaw (rotor inertia {J:.2e} kg m^2)",
    "gyro_bias": "the gyro reads {x:.4f}, {y:.4f}, {z:.4f} rad/s too much",
    "accel_bias": "the accelerometer reads {x:.2f}, {y:.2f}, {z:.2f} m/s^2 too much",
    "gyro_scale": "the gyro's scale is off by {x:.1f}, {y:.1f}, {z:.1f} %",
    "imu_misalignment": "the IMU is turned against the body by {x:.1f}, {y:.1f}, {z:.1f} degrees",
    "imu_lever_arm": "the accelerometer sits {x:.0f}, {y:.0f}, {z:.0f} mm from the geometric centre",
    "ahrs_acceleration_error": "the attitude filter is pulled towards the accelerometer's level with {k:.2f} 1/s",
    "ground_effect": "thrust rises near the ground (rotor radius scale {radius_scale:.2f})",
}
_FACTOR: dict[str, dict[str, float]] = {
    "motor_lag": {"tau": 1e3},
    "command_delay": {"delay": 1e3},
    "attitude_delay": {"delay": 1e3},
    "rotor_drag_moment": {"h_x": 1e3, "h_y": 1e3},
    "weak_rotor": {"loss": 1e2},
    "cg_offset": {"x": 1e3, "y": 1e3},
    "mass_change": {"fraction": 1e2},
    "thrust_drop": {"fraction": 1e2},
    "battery_sag": {"fraction": 1e2},
    "gyro_scale": {"x": 1e2, "y": 1e2, "z": 1e2},
    "imu_misalignment": {"x": 57.29578, "y": 57.29578, "z": 57.29578},
    "imu_lever_arm": {"x": 1e3, "y": 1e3, "z": 1e3},
}


def evidence(effect: str, values: Mapping[str, float], before: float, after: float) -> str:
    """Sentence of one finding.

    Args:
        effect: contract name.
        values: its numbers in contract units.
        before: mean squared error on unseen data without it (noise floor 1).
        after: the same with it.
    """
    factor = _FACTOR.get(effect, {})
    shown = {k: v * factor.get(k, 1.0) for k, v in values.items()}
    body = _FORMS[effect].format(**shown)
    return (
        f"{body[0].upper()}{body[1:]}; on unseen data the error falls from {before:.3g} to {after:.3g} times the noise."
    )
