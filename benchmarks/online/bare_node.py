"""A node that takes the same messages and does nothing with them: what executor and middleware cost by themselves."""

from __future__ import annotations

import sys

import rclpy
from quadid_node.convert import message_class
from quadid_node.node import SENSOR_QOS
from quadid_node.presets import source
from quadid_node.stopping import Stop
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future


def main() -> int:
    """Listens until a signal comes."""
    stop = Stop()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("bare")
    for entry in source("canonical").inputs:
        node.create_subscription(message_class(entry.type), entry.topic, lambda data: None, SENSOR_QOS, raw=True)
    executor = EventsExecutor()
    executor.add_node(node)
    print("ready", flush=True)
    while not stop():
        executor.spin_until_future_complete(Future(), timeout_sec=0.2)
    stop.ignore_more()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
