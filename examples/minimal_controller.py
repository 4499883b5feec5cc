"""The shortest controller that takes its model from quadid; controller_subscriber.py makes every check."""

import contextlib

import rclpy
from quadid_msgs.msg import ParameterSet
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)
MASS, STEP = 1.3, 0.5  # [kg] of this vehicle; largest relative change by one set


class Controller(Node):
    """Holds roll inertia [kg m^2]; the gain follows it."""

    def __init__(self) -> None:
        super().__init__("controller")
        self.sequence, self.J_xx = 0, 0.010
        self.create_subscription(ParameterSet, "quadid/parameters", self.on_set, LATCHED)

    def on_set(self, s: ParameterSet) -> None:
        """Applies a set that is in force, newer, of this mass, and known."""
        in_force = s.state in (ParameterSet.STATE_ACCEPTED, ParameterSet.STATE_ROLLED_BACK) and not s.out_of_date
        ours = s.schema_version == ParameterSet.SCHEMA_VERSION and abs(s.mass - MASS) <= 0.02 * MASS
        if not (in_force and ours and s.sequence > self.sequence):
            return
        known = [v for n, *v in zip(s.names, s.values, s.units, s.status, strict=False) if n == "J_xx"]
        value, unit, status = known[0] if known else (self.J_xx, "", ParameterSet.STATUS_UNRELIABLE)
        if unit == "kg m^2" and status == ParameterSet.STATUS_IDENTIFIED and abs(value - self.J_xx) <= STEP * self.J_xx:
            self.J_xx, self.sequence = value, s.sequence
            self.get_logger().info(f"set {s.sequence}: J_xx = {value:.4g}, roll rate gain = {20.0 * value:.4g}")


rclpy.init()
with contextlib.suppress(KeyboardInterrupt):
    rclpy.spin(Controller())
