"""Topic names of the stacks that quadid reads from; a preset lists, per channel, the topics to look for in order.

Names are relative: they match a topic that ends with them, so that a namespace before makes no difference.
"""

from __future__ import annotations

from functools import lru_cache

from quadid.errors import LogError, nearest

PRESETS: dict[str, dict[str, tuple[str, ...]]] = {
    "canonical": {
        "gyro": ("imu",),
        "accel": ("imu",),
        "attitude": ("attitude", "imu"),
        "rotor_speed": ("rotor_speeds",),
        "motor_command": ("motor_command",),
        "attitude_reference": ("command",),
        "velocity": ("odom",),
        "position": ("odom",),
        "battery": ("battery",),
    },
    "mavros": {
        "gyro": ("imu/data_raw", "imu/data"),
        "accel": ("imu/data_raw", "imu/data"),
        "attitude": ("imu/data", "local_position/pose"),
        "rotor_speed": ("esc_status/status", "esc_telemetry/telemetry"),
        "motor_command": ("rc/out",),
        "attitude_reference": ("setpoint_raw/target_attitude",),
        "velocity": ("local_position/odom", "local_position/velocity_local"),
        "position": ("local_position/pose", "local_position/odom"),
        "battery": ("battery",),
    },
    "px4": {
        "gyro": ("fmu/out/sensor_combined",),
        "accel": ("fmu/out/sensor_combined",),
        "attitude": ("fmu/out/vehicle_attitude", "fmu/out/vehicle_odometry"),
        "rotor_speed": ("fmu/out/esc_status",),
        "motor_command": ("fmu/out/actuator_motors", "fmu/out/actuator_outputs"),
        "attitude_reference": ("fmu/out/vehicle_attitude_setpoint",),
        "velocity": ("fmu/out/vehicle_local_position", "fmu/out/vehicle_odometry"),
        "position": ("fmu/out/vehicle_local_position", "fmu/out/vehicle_odometry"),
        "battery": ("fmu/out/battery_status",),
        "vehicle_kind": ("fmu/out/vehicle_status",),
    },
    "ardupilot": {
        "gyro": ("ap/imu/experimental/data",),
        "accel": ("ap/imu/experimental/data",),
        "attitude": ("ap/imu/experimental/data", "ap/pose/filtered"),
        "velocity": ("ap/twist/filtered",),
        "position": ("ap/pose/filtered",),
        "battery": ("ap/battery",),
    },
    "rotors": {
        "gyro": ("imu", "imu/data_raw"),
        "accel": ("imu", "imu/data_raw"),
        "attitude": ("imu", "odometry_sensor1/odometry", "ground_truth/odometry"),
        "rotor_speed": ("motor_speed", "rotors"),
        "motor_command": ("gazebo/command/motor_speed", "rotors"),
        "velocity": ("odometry_sensor1/odometry", "ground_truth/odometry"),
        "position": ("odometry_sensor1/odometry", "ground_truth/odometry"),
    },
}
"""Topics by preset and channel."""
AUTO = "auto"


@lru_cache(maxsize=1024)
def preset_rank(preset: str, channel: str, topic: str) -> int | None:
    """Returns the place of a topic in a preset's list for a channel; None when it is not in it.

    With ``auto`` every topic is in the list; those that any preset names come before others, raw ones first.

    Raises:
        LogError: unknown preset.
    """
    if preset == AUTO:
        known = [preset_rank(name, channel, topic) for name in PRESETS]
        ranks = [rank for rank in known if rank is not None]
        return (0 if "raw" in topic.rsplit("/", 1)[-1] else 1) + (min(ranks) if ranks else 10)
    if preset not in PRESETS:
        raise LogError(f"unknown preset '{preset}'", f"{AUTO}, {', '.join(PRESETS)}", nearest(preset, PRESETS))
    # A topic ends with the name, whole path elements only; PX4 may append its message version (_v1).
    stem, _, version = topic.rpartition("_v")
    ends = [f"/{topic}", *([f"/{stem}"] if stem and version.isdecimal() else [])]
    names = PRESETS[preset].get(channel, ())
    return next((rank for rank, name in enumerate(names) if any(end.endswith(f"/{name}") for end in ends)), None)
