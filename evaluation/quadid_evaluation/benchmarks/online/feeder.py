"""A vehicle on the topics: IMU at 1 kHz, attitude and rotor speeds at 250 Hz, references and odometry at 50 Hz.

    python -m quadid_evaluation.benchmarks.online.feeder SECONDS PROFILE

The moment of publishing stands in the last number of each IMU message, a covariance that nobody reads.
"""

from __future__ import annotations

import struct
import sys
import time

import rclpy
from quadid_node.process import Stop
from quadid_node.replay_node import Stopped, TopicPlayer, epoch_of
from quadid_replay.writers import write_recording
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from quadid.data.window import Channel, Recording
from quadid.flight import fly
from quadid.vehicle import Vehicle

FAST = 1000.0
EVERY = {"attitude": 4, "rotor_speed": 4, "attitude_reference": 20, "velocity": 20, "position": 20}
"""Of these channels every so many rows are sent."""
WAIT = 3.0


class Feeder(TopicPlayer):
    """Publishes in real time, with the moment of publishing inside."""

    def write_cdr(self, topic: str, kind: str, data: bytes, stamp_ns: int) -> None:
        """Waits for the message's time and publishes it."""
        self._wait(stamp_ns)
        if topic == "imu":
            data = data[:-8] + struct.pack("<d", time.time())
        self._publisher(topic, kind).publish(data)
        self.count += 1


def recording(seconds: float, profile: str) -> Recording:
    """A Pelican flight with the channels at their rates."""
    flight = fly(
        Vehicle.shipped("pelican"), seconds=seconds, seed=4, profile=profile, log_rate=FAST, extras=["velocity"]
    )
    channels = {
        name: Channel(name, c.t[:: EVERY.get(name, 1)], c.values[:: EVERY.get(name, 1)], name)
        for name, c in flight.recording.channels.items()
    }
    return Recording("feeder", "stream", channels)


def main() -> None:
    """Feeds until the flight is over."""
    stop = Stop()
    made = recording(float(sys.argv[1]), sys.argv[2])
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("feeder")
    feeder = Feeder(node, 1.0, stop)
    feeder.announce(made, WAIT)
    print("flying", flush=True)
    try:
        write_recording(feeder, made, epoch_of(made, "now"))
        print(f"{feeder.count} messages", flush=True)
        time.sleep(1.0)
    except Stopped:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
