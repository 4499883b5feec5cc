"""What a pilot or builder can do about each effect, beside putting it into the model."""

from __future__ import annotations

ADVICE: dict[str, str] = {
    "motor_lag": "Usual for real motors; a controller that knows it can lead it.",
    "command_delay": "Look for buffering between controller and speed controllers: protocol, loop rates, filters.",
    "imu_lag": "Check the gyro's low-pass and notch filters; log unfiltered where possible.",
    "attitude_delay": "Check the attitude estimator's rate and the telemetry path.",
    "rotor_drag": "Usual; leaving it out makes a simulated vehicle glide too far.",
    "parasitic_drag": "Usual at speed; leaving it out makes a simulated vehicle too fast.",
    "rotor_drag_moment": "The rotors sit above or below the centre of gravity; moving the battery changes it.",
    "rate_damping": "Usual for large propellers.",
    "axial_inflow": "Usual; matters for climbs and descents.",
    "wind": "Belongs to that day. Fly in calm air, or in several directions.",
    "weak_rotor": "Check that rotor: propeller, motor, speed controller, arm.",
    "cg_offset": "Move the battery or the payload, or tell the controller.",
    "mass_change": "Check the payload and its release.",
    "thrust_drop": "Look for a voltage drop or a thermal limit at that moment.",
    "battery_sag": "Compensate thrust for voltage, or log measured rotor speeds.",
    "thrust_curve": "Measure thrust against command on a stand, or log measured rotor speeds.",
    "product_of_inertia": "The mass is not symmetric; check the mounting of battery and payload.",
    "rotor_spin_up": "Usual; it makes yaw quicker than drag torque alone would.",
    "gyro_bias": "Calibrate the gyro before take-off, warm.",
    "accel_bias": "Calibrate the accelerometer.",
    "gyro_scale": "Calibrate the gyro's scale on a turntable.",
    "imu_misalignment": "Check the mounting, or set the board rotation.",
    "imu_lever_arm": "Tell the estimator where the IMU sits.",
    "ahrs_acceleration_error": "Lower the accelerometer's weight in the attitude estimator.",
    "ground_effect": "Fly higher to identify, or keep it in the model for landing.",
}
