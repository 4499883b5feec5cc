"""Topics of the stacks that quadid reads from, with their types and the channels that they feed.

Names are relative: they match a topic that ends with them, so that a namespace before makes no difference.
"""

from __future__ import annotations

from functools import lru_cache

from quadid.errors import LogError, nearest

TOPICS: dict[str, dict[str, tuple[str, str]]] = {
    "canonical": {
        "attitude": ("geometry_msgs/QuaternionStamped", "attitude"),
        "imu": ("sensor_msgs/Imu", "gyro accel attitude"),
        "rotor_speeds": ("sensor_msgs/JointState", "rotor_speed"),
        "motor_command": ("quadid_msgs/MotorCommand", "motor_command"),
        "command": ("quadid_msgs/AttitudeCommand", "attitude_reference"),
        "odom": ("nav_msgs/Odometry", "velocity position"),
        "battery": ("sensor_msgs/BatteryState", "battery"),
    },
    "mavros": {
        "imu/data_raw": ("sensor_msgs/Imu", "gyro accel"),
        "imu/data": ("sensor_msgs/Imu", "gyro accel attitude"),
        "esc_status/status": ("mavros_msgs/ESCStatus", "rotor_speed"),
        "esc_telemetry/telemetry": ("mavros_msgs/ESCTelemetry", "rotor_speed"),
        "rc/out": ("mavros_msgs/RCOut", "motor_command"),
        "setpoint_raw/target_attitude": ("mavros_msgs/AttitudeTarget", "attitude_reference"),
        "local_position/pose": ("", "attitude position"),
        "local_position/odom": ("nav_msgs/Odometry", "velocity position"),
        "local_position/velocity_local": ("", "velocity"),
        "battery": ("sensor_msgs/BatteryState", "battery"),
    },
    "px4": {
        "fmu/out/sensor_combined": ("px4_msgs/SensorCombined", "gyro accel"),
        "fmu/out/vehicle_attitude": ("px4_msgs/VehicleAttitude", "attitude"),
        "fmu/out/esc_status": ("px4_msgs/EscStatus", "rotor_speed"),
        "fmu/out/actuator_motors": ("px4_msgs/ActuatorMotors", "motor_command"),
        "fmu/out/actuator_outputs": ("", "motor_command"),
        "fmu/out/vehicle_attitude_setpoint": ("px4_msgs/VehicleAttitudeSetpoint", "attitude_reference"),
        "fmu/out/vehicle_local_position": ("px4_msgs/VehicleLocalPosition", "velocity position"),
        "fmu/out/vehicle_odometry": ("", "attitude velocity position"),
        "fmu/out/battery_status": ("px4_msgs/BatteryStatus", "battery"),
        "fmu/out/vehicle_status": ("px4_msgs/VehicleStatus", "vehicle_kind"),
    },
    "ardupilot": {
        "ap/imu/experimental/data": ("sensor_msgs/Imu", "gyro accel attitude"),
        "ap/pose/filtered": ("geometry_msgs/PoseStamped", "attitude position"),
        "ap/twist/filtered": ("", "velocity"),
        "ap/battery": ("sensor_msgs/BatteryState", "battery"),
    },
    "rotors": {
        "imu": ("sensor_msgs/Imu", "gyro accel attitude"),
        "imu/data_raw": ("", "gyro accel"),
        "motor_speed": ("actuator_msgs/Actuators", "rotor_speed"),
        "gazebo/command/motor_speed": ("", "motor_command"),
        "rotors": ("", "rotor_speed motor_command"),
        "odometry_sensor1/odometry": ("nav_msgs/Odometry", "attitude velocity position"),
        "ground_truth/odometry": ("", "attitude velocity position"),
    },
}
"""By preset and topic: the type for live subscription, empty where it is read from logs only, and channels.

Of several topics with one channel the first is the best.
"""


def sources(preset: str, channel: str) -> tuple[str, ...]:
    """Topics of a preset with a channel, the best first."""
    return tuple(topic for topic, (_, channels) in TOPICS[preset].items() if channel in channels.split())


AUTO = "auto"


@lru_cache(maxsize=1024)
def preset_rank(preset: str, channel: str, topic: str) -> int | None:
    """Returns the place of a topic in a preset's list for a channel; None when it is not in it.

    With ``auto`` every topic is in the list; those that any preset names come before others, raw ones first.

    Raises:
        LogError: unknown preset.
    """
    if preset == AUTO:
        known = [preset_rank(name, channel, topic) for name in TOPICS]
        ranks = [rank for rank in known if rank is not None]
        return (0 if "raw" in topic.rsplit("/", 1)[-1] else 1) + (min(ranks) if ranks else 10)
    if preset not in TOPICS:
        raise LogError(f"unknown preset '{preset}'", f"{AUTO}, {', '.join(TOPICS)}", nearest(preset, TOPICS))
    # A topic ends with the name, whole path elements only; PX4 may append its message version (_v1).
    stem, _, version = topic.rpartition("_v")
    ends = [f"/{topic}", *([f"/{stem}"] if stem and version.isdecimal() else [])]
    names = enumerate(sources(preset, channel))
    return next((rank for rank, name in names if any(end.endswith(f"/{name}") for end in ends)), None)
