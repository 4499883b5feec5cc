"""`ros2 run quadid_node replay LOG`: plays any log onto the canonical topics, at its own pace or faster."""

import argparse
import sys
import time
from collections.abc import Callable
from io import BytesIO
from typing import Any

try:
    import quadid  # noqa: F401 - refuses a folder that would run foreign code
except ImportError as refusal:
    print(f"replay: {refusal}", file=sys.stderr)  # noqa: T201 - a command's last word
    raise SystemExit(2) from None

import rclpy
from quadid_replay import TopicWriter, open_log
from quadid_replay.writers import write_recording
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from quadid.data.window import Recording
from quadid.errors import QuadidError
from quadid_node.inputs import message_class, source
from quadid_node.process import StopSignal, end_middleware, without_shared_memory

QOS = QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
_CHECK_EVERY = 0.1


class Stopped(Exception):  # noqa: N818 - a signal asked for it, nothing is wrong
    """A signal asked to stop."""


class TopicPlayer(TopicWriter):
    """Publishes what a `TopicWriter` would write, each message when its time has come."""

    def __init__(self, node: Node, speed: float, stop: Callable[[], bool]) -> None:
        """Publishes through `node` until `stop` is True, at `speed` times the log's pace; 0: as fast as possible."""
        super().__init__(BytesIO())
        self._node, self._speed, self._stop = node, speed, stop
        self._publishers: dict[str, Any] = {}
        self._begin: tuple[float, int] | None = None
        self.count = 0

    def announce(self, recording: Recording, wait: float) -> None:
        """Makes the publishers and gives subscribers `wait` seconds to find them."""
        for entry in source("canonical").inputs:
            if any(channel in recording.channels and rank == 0 for channel, rank in entry.channels):
                self._publisher(entry.topic, entry.type)
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
        return int(recording.epoch or 0.0) * 10**9
    first, _ = recording.span
    return (time.time_ns() // 10**6) * 10**6 - round(first * 1e9)


def play(
    recording: Recording, speed: float, stamps: str, wait: float, args: list[str] | None, stop: StopSignal
) -> None:
    """Plays a recording until its end or until `stop` returns True.

    Args:
        speed: times its pace; 0: as fast as possible.
        stamps: ``now`` or ``log``, as `epoch_of`.
        wait: given to subscribers to find the topics [s].
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


def main(args: list[str] | None = None) -> int:
    """Plays a log; returns the exit code: 0 done, 2 a log that cannot be read."""
    parser = argparse.ArgumentParser(prog="replay", description=__doc__)
    parser.add_argument("log", help="flight log: MCAP, .tlog, DataFlash, ULog, CSV")
    parser.add_argument("--speed", type=float, default=1.0, help="times the log's pace; 0: as fast as possible")
    parser.add_argument("--stamps", choices=("now", "log"), default="now", help="stamps from now on, or the log's own")
    parser.add_argument("--wait", type=float, default=2.0, help="seconds for subscribers to find the topics")
    parser.add_argument("--preset", default="auto", help="topic names of a ROS log")
    given = parser.parse_args(remove_ros_args(args or sys.argv)[1:])
    stop = StopSignal()
    try:
        recording = open_log(given.log, given.preset)
    except QuadidError as error:
        print(f"replay: {error}", file=sys.stderr)  # noqa: T201 - a command's last word
        return 2
    play(recording, given.speed, given.stamps, given.wait, args, stop)
    end_middleware()
    return 0


if __name__ == "__main__":
    sys.exit(main())
