"""What the channels of a log allow to identify, what is missing, and how to log it."""

from __future__ import annotations

import math

from quadid.inspection.findings import ChannelFacts, Missing, Outlook
from quadid.parameters import NOMINAL_NAMES
from quadid.rotor_signal import INERTIA_RATE, SLOWEST_RATE

_HOW: dict[str, dict[str, str]] = {
    "rotor": {
        "ulog": "set SDLOG_PROFILE to 17 (default + high rate), or list actuator_motors and esc_status in "
        "etc/logging/logger_topics.txt",
        "dataflash": "ArduCopter writes RCOU at 10 Hz: log rotor speeds of the ESCs (bidirectional DShot, ESC), "
        "or record SERVO_OUTPUT_RAW at 80 Hz as telemetry (.tlog)",
        "tlog": "ask for SERVO_OUTPUT_RAW and ESC_STATUS at 50 Hz with SET_MESSAGE_INTERVAL, or use the on-board log",
        "mcap": "record rotor_speeds (sensor_msgs/JointState) or motor_command; PX4's bridge needs actuator_motors and "
        "esc_status added to dds_topics.yaml; mavros: rc/out and esc_status/status",
        "csv": "add columns w1 … wN [rad/s] or u1 … uN",
    },
    "gyro": {
        "ulog": "set SDLOG_PROFILE to 17 (default + high rate): sensor_combined at full rate",
        "dataflash": "add IMU_FAST to LOG_BITMASK: IMU at loop rate",
        "tlog": "ask for HIGHRES_IMU or RAW_IMU at 50 Hz or more, or use the on-board log",
        "mcap": "record imu/data_raw (sensor_msgs/Imu) at 50 Hz or more; sensor_combined for PX4",
        "csv": "add columns p, q, r [rad/s]",
    },
    "accel": {
        "csv": "add columns ax, ay, az [m/s^2], specific force",
    },
    "attitude": {
        "ulog": "log vehicle_attitude (in every SDLOG_PROFILE)",
        "dataflash": "add ATTITUDE_FAST to LOG_BITMASK",
        "tlog": "ask for ATTITUDE_QUATERNION at 50 Hz",
        "mcap": "record attitude (geometry_msgs/QuaternionStamped) or an imu with orientation",
        "csv": "add columns qw, qx, qy, qz or phi, theta, psi [rad]",
    },
}  # fmt: skip


def missing_signals(log_format: str, facts: tuple[ChannelFacts, ...]) -> tuple[Missing, ...]:
    """Names absent and slow signals with the reason and the way to log them for this kind of log."""
    rates = {f.name: f.rate for f in facts}
    rotor = max((rates[n] for n in ("rotor_speed", "motor_command") if n in rates), default=None)
    out = [*_one(log_format, "rotor", rotor, "without rotor speeds or motor commands nothing can be identified")]
    out += _one(log_format, "gyro", rates.get("gyro"), "inertias and the drag coefficient show in rotation rates")
    if "accel" not in rates:
        how = _HOW["accel"].get(log_format) or _HOW["gyro"].get(log_format, "log the IMU")
        out.append(Missing("accel", "the thrust coefficient shows in the accelerometer", how))
    if "attitude" not in rates:
        why = "attitude constrains the fit over longer segments and reveals wrong units"
        out.append(Missing("attitude", why, _HOW["attitude"].get(log_format, "log the attitude")))
    return tuple(out)


def _one(log_format: str, channel: str, rate: float | None, why: str) -> list[Missing]:
    how = _HOW[channel].get(log_format, "log it")
    if rate is None:
        return [Missing(channel, why, how)]
    if rate >= INERTIA_RATE:
        return []
    slow = "one sample is too little" if math.isnan(rate) else f"{rate:.3g} Hz is too slow"
    return [Missing(channel, f"{slow} for inertias, which need {INERTIA_RATE:g} Hz or more", how)]


def parameter_outlook(facts: tuple[ChannelFacts, ...]) -> tuple[Outlook, ...]:
    """Says per parameter of the nominal model whether the channels and their rates allow it."""
    rates = {f.name: f.rate for f in facts}
    rotor = max((rates[n] for n in ("rotor_speed", "motor_command") if n in rates), default=0.0)
    gyro = rates.get("gyro", 0.0)
    out = []
    for name in NOMINAL_NAMES:
        if rotor < SLOWEST_RATE:
            reason = "no rotor signal" if rotor == 0.0 else f"rotor signal at {rotor:.2g} Hz is too slow"
            out.append(Outlook(name, False, reason))
        elif name == "b":
            possible = "accel" in rates
            out.append(Outlook(name, possible, "rotor signal and accelerometer" if possible else "no accelerometer"))
        elif gyro == 0.0:
            out.append(Outlook(name, False, "no gyro"))
        elif min(rotor, gyro) < INERTIA_RATE:
            slow, rate = ("rotor signal", rotor) if rotor < gyro else ("gyro", gyro)
            out.append(Outlook(name, False, f"{slow} at {rate:.3g} Hz is too slow, {INERTIA_RATE:g} Hz needed"))
        else:
            out.append(Outlook(name, True, "rotor signal and gyro; needs motion about its axis"))
    return tuple(out)
