"""A log played onto the canonical topics, at its own pace or faster."""

from __future__ import annotations

import time
from collections.abc import Callable
from io import BytesIO
from typing import Any

import rclpy
from quadid_replay import TopicWriter
from quadid_replay.writers import write_recording
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from quadid.data.window import Recording
from quadid_node.inputs import message_class
from quadid_node.playback import base_seconds
from quadid_node.stopping import Stop
from quadid_node.transport import without_shared_memory

QOS = QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
_CHECK_EVERY = 0.1
_TOPICS = {
    "imu": ("sensor_msgs/Imu", ("gyro", "accel")),
    "attitude": ("geometry_msgs/QuaternionStamped", ("attitude",)),
    "rotor_speeds": ("sensor_msgs/JointState", ("rotor_speed",)),
    "motor_command": ("quadid_msgs/MotorCommand", ("motor_command",)),
    "command": ("quadid_msgs/AttitudeCommand", ("attitude_reference",)),
    "odom": ("nav_msgs/Odometry", ("velocity", "position")),
    "battery": ("sensor_msgs/BatteryState", ("battery",)),
}


class Stopped(Exception):  # noqa: N818 - a signal asked for it, nothing is wrong
    """A signal asked to stop."""


class TopicPlayer(TopicWriter):
    """Publishes what a `TopicWriter` would write, each message when its time has come."""

    def __init__(self, node: Node, speed: float, stop: Callable[[], bool]) -> None:
        """Publishes through `node` until `stop` says so, at `speed` times the log's pace; 0: as fast as possible."""
        super().__init__(BytesIO())
        self._node, self._speed, self._stop = node, speed, stop
        self._publishers: dict[str, Any] = {}
        self._begin: tuple[float, int] | None = None
        self.count = 0

    def announce(self, recording: Recording, wait: float) -> None:
        """Makes the publishers and gives subscribers `wait` seconds to find them."""
        for topic, (kind, channels) in _TOPICS.items():
            if any(c in recording.channels for c in channels):
                self._publisher(topic, kind)
        time.sleep(wait)

    def write_cdr(self, topic: str, kind: str, data: bytes, stamp_ns: int) -> None:
        """Waits for the message's time and publishes it."""
        self._wait(stamp_ns)
        self._publisher(topic, kind).publish(data)
        self.count += 1

    def _publisher(self, topic: str, kind: str) -> Any:
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(message_class(kind), topic, QOS)
        return self._publishers[topic]

    def _wait(self, stamp_ns: int) -> None:
        now = time.monotonic()
        if self._begin is None:
            self._begin = (now, stamp_ns)
        due = self._begin[0] + ((stamp_ns - self._begin[1]) * 1e-9 / self._speed if self._speed > 0.0 else 0.0)
        while True:
            if self._stop():
                raise Stopped
            left = due - time.monotonic()
            if left <= 0.0:
                return
            time.sleep(min(left, _CHECK_EVERY))


def epoch_of(recording: Recording, stamps: str) -> int:
    """Nanoseconds to add to recording time: the log's own UNIX time, or such that the log begins now."""
    if stamps == "log":
        return base_seconds(recording) * 10**9
    first, _ = recording.span
    return (time.time_ns() // 10**6) * 10**6 - round(first * 1e9)


def play(recording: Recording, speed: float, stamps: str, wait: float, args: list[str] | None, stop: Stop) -> None:
    """Plays a recording until its end or until `stop` says so.

    Args:
        recording: of any log.
        speed: times its pace; 0: as fast as possible.
        stamps: ``now`` or ``log``, as `epoch_of`.
        wait: given to subscribers to find the topics [s].
        args: of ROS.
        stop: asked for by a signal.
    """
    without_shared_memory()
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    node = Node("quadid_replay")
    player = TopicPlayer(node, speed, stop)
    try:
        player.announce(recording, wait)
        write_recording(player, recording, epoch_of(recording, stamps))
        node.get_logger().info(f"{player.count} messages of {recording.name} played")
        time.sleep(0.5)  # the last ones are still on their way
    except Stopped:
        pass
    finally:
        stop.ignore_more()
        node.destroy_node()
        rclpy.try_shutdown()
