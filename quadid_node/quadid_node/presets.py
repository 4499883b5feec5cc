"""Topics and types that the stacks really publish, for live subscription; what a stack lacks, and the way out."""

from __future__ import annotations

from dataclasses import dataclass

from quadid_replay.presets import PRESETS

from quadid.errors import QuadidError, nearest


@dataclass(frozen=True)
class Input:
    """One topic to subscribe to.

    Attributes:
        topic: relative name.
        type: ``package/Type``.
        channels: the core's channels it may feed, each with its rank: the lowest that arrives is used.
    """

    topic: str
    type: str
    channels: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Source:
    """A preset: its inputs, and what its users should know when there is no motor signal."""

    inputs: tuple[Input, ...]
    motor_hint: str


_TYPES = {
    "canonical": {
        "imu": "sensor_msgs/Imu",
        "attitude": "geometry_msgs/QuaternionStamped",
        "rotor_speeds": "sensor_msgs/JointState",
        "motor_command": "quadid_msgs/MotorCommand",
        "command": "quadid_msgs/AttitudeCommand",
        "odom": "nav_msgs/Odometry",
        "battery": "sensor_msgs/BatteryState",
    },
    "mavros": {
        "imu/data_raw": "sensor_msgs/Imu",
        "imu/data": "sensor_msgs/Imu",
        "esc_status/status": "mavros_msgs/ESCStatus",
        "esc_telemetry/telemetry": "mavros_msgs/ESCTelemetry",
        "rc/out": "mavros_msgs/RCOut",
        "setpoint_raw/target_attitude": "mavros_msgs/AttitudeTarget",
        "local_position/odom": "nav_msgs/Odometry",
        "battery": "sensor_msgs/BatteryState",
    },
    "px4": {
        "fmu/out/sensor_combined": "px4_msgs/SensorCombined",
        "fmu/out/vehicle_attitude": "px4_msgs/VehicleAttitude",
        "fmu/out/esc_status": "px4_msgs/EscStatus",
        "fmu/out/actuator_motors": "px4_msgs/ActuatorMotors",
        "fmu/out/vehicle_attitude_setpoint": "px4_msgs/VehicleAttitudeSetpoint",
        "fmu/out/vehicle_local_position": "px4_msgs/VehicleLocalPosition",
        "fmu/out/battery_status": "px4_msgs/BatteryStatus",
    },
    "ardupilot": {
        "ap/imu/experimental/data": "sensor_msgs/Imu",
        "ap/pose/filtered": "geometry_msgs/PoseStamped",
        "ap/battery": "sensor_msgs/BatteryState",
    },
    "rotors": {
        "imu": "sensor_msgs/Imu",
        "motor_speed": "actuator_msgs/Actuators",
        "odometry_sensor1/odometry": "nav_msgs/Odometry",
    },
}
_PREFIX = {"mavros": "mavros/"}
_VERSIONED = {
    f"fmu/out/{name}"
    for name in ("vehicle_attitude", "vehicle_attitude_setpoint", "vehicle_local_position", "battery_status")
}
"""Topics to which newer PX4 appends the version of their messages: `_v1` is listened to as well."""
_HINTS = {
    "canonical": "publish rotor_speeds (sensor_msgs/JointState, rad/s) or motor_command (quadid_msgs/MotorCommand)",
    "mavros": "mavros/rc/out carries the motor outputs: ask the autopilot for SERVO_OUTPUT_RAW at 80 Hz "
    "(ros2 service call /mavros/set_message_interval, id 36), or for ESC telemetry",
    "px4": "the default bridge exports no motor signal: add actuator_motors (or esc_status) to the publications in "
    "dds_topics.yaml of the PX4 firmware and rebuild, or use quadid serve on MAVLink",
    "ardupilot": "ArduPilot's DDS bridge has no motor topic: use quadid serve on MAVLink beside it, or MAVROS",
    "rotors": "publish motor_speed (actuator_msgs/Actuators, rad/s)",
}


def source(name: str) -> Source:
    """The preset of that name.

    Raises:
        QuadidError: unknown preset, with the nearest one.
    """
    if name not in _TYPES:
        raise QuadidError(f"unknown source '{name}'", ", ".join(_TYPES), nearest(name, _TYPES))
    inputs = []
    for topic, kind in _TYPES[name].items():
        ranks = [(channel, names.index(topic)) for channel, names in PRESETS[name].items() if topic in names]
        for version in ("", "_v1") if topic in _VERSIONED else ("",):
            inputs.append(Input(_PREFIX.get(name, "") + topic + version, kind, tuple(ranks)))
    return Source(tuple(inputs), _HINTS[name])
