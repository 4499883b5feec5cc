"""A process of its own: publishes one latched ParameterSet on quadid/parameters and stays until it is told to go."""

import sys

import rclpy
from quadid_msgs.msg import ParameterSet
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


def example(sequence: int) -> ParameterSet:
    """A set with every field filled, so that a lost or swapped one is seen."""
    message = ParameterSet(schema_version=ParameterSet.SCHEMA_VERSION, vehicle_id="pelican-7", sequence=sequence)
    message.header.stamp.sec = 12
    message.header.frame_id = "base_link_frd"
    message.state = ParameterSet.STATE_ACCEPTED
    message.reason = "interval below 5 % in three windows"
    message.boot_id, message.mass = "0" * 32, 1.3
    message.out_of_date, message.out_of_date_reason = True, "mass +15 % since"
    message.names = ["b", "J_xx", "motor_lag.tau"]
    message.units = ["N s^2/rad^2", "kg m^2", "s"]
    message.values = [2.33e-5, 8.1e-3, 0.05]
    message.covariance = [float(i) for i in range(9)]
    message.status = [ParameterSet.STATUS_IDENTIFIED, ParameterSet.STATUS_RATIO_ONLY, ParameterSet.STATUS_FIXED]
    message.relative_to = ["", "b", ""]
    message.window_start.sec, message.window_end.sec, message.window_end.nanosec = 2, 11, 980_000_000
    message.samples = 500
    message.mse, message.mse_held_out = 1.02, 1.05
    message.log_hash = "0" * 64
    message.approved_by = "auto"
    return message


def main() -> None:
    """Publish two sets at once (depth 1 keeps the second), say so, wait for end of input."""
    rclpy.init()
    node = rclpy.create_node("latched_publisher")
    publisher = node.create_publisher(ParameterSet, "quadid/parameters", LATCHED)
    publisher.publish(example(1))
    publisher.publish(example(2))
    print("published", flush=True)
    sys.stdin.read()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
