"""A vehicle on the topics that flies the same two minutes over and over in real time, lightly: IMU at 100 Hz.

python -m quadid_evaluation.studies.soak.feeder SECONDS --ros-args -r __ns:=/soak
"""

from __future__ import annotations

import json
import sys
import time

import rclpy
from quadid_node.process import Stop
from quadid_node.replay_node import Stopped, epoch_of
from quadid_replay.writers import write_recording
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from quadid.flight import fly
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.online.feeder import Feeder

FLIGHT, GROUND, RATE = 120.0, 5.0, 100.0


class Looping(Feeder):
    """Counts by topic, and begins anew."""

    counts: dict[str, int]

    def again(self) -> None:
        """The next flight begins when it is written."""
        self._begin = None

    def write_cdr(self, topic: str, kind: str, data: bytes, stamp_ns: int) -> None:
        """Waits, publishes, counts."""
        super().write_cdr(topic, kind, data, stamp_ns)
        self.counts[topic] = self.counts.get(topic, 0) + 1


def main() -> None:
    """Flies until the time is over; says what was sent."""
    stop = Stop()
    seconds = float(remove_ros_args(sys.argv)[1])
    made = fly(Vehicle.shipped("pelican"), seconds=min(FLIGHT, seconds), seed=3, log_rate=RATE).recording
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("feeder")
    feeder = Looping(node, 1.0, stop)
    feeder.counts = {}
    feeder.announce(made, 3.0)
    print("flying", flush=True)
    end = time.monotonic() + seconds
    try:
        while time.monotonic() < end:
            write_recording(feeder, made, epoch_of(made, "now"))
            feeder.again()
            time.sleep(min(GROUND, max(end - time.monotonic(), 0.0)))
    except Stopped:
        pass
    finally:
        print(json.dumps(feeder.counts), flush=True)
        time.sleep(1.0)
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
