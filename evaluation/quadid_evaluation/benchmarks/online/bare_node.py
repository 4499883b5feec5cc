"""A node that takes the same messages and does nothing with them: what executor and middleware cost by themselves.

``woken``: a callback for each message; ``polled``: taken as often as the node itself does.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import rclpy
from quadid_node.inputs import message_class, source
from quadid_node.node import SENSOR_QOS, PollingNode
from quadid_node.process import Stop
from quadid_node.service import ROUND_SECONDS
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future


class BareNode(PollingNode):
    """Listens to what `identify` listens to."""

    def __init__(self, polled: bool) -> None:
        super().__init__("bare")
        self._takes: list[Callable[[], bytes | None]] = []
        for entry in source("canonical").inputs:
            kind = message_class(entry.type)
            if polled:
                self._takes.append(self.poll(kind, entry.topic, SENSOR_QOS))
            else:
                self.create_subscription(kind, entry.topic, lambda data: None, SENSOR_QOS, raw=True)
        if polled:
            self.create_timer(ROUND_SECONDS, self._empty)

    def _empty(self) -> None:
        for take in self._takes:
            while take() is not None:
                pass


def main() -> int:
    """Listens until a signal comes."""
    stop = Stop()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = BareNode(sys.argv[1] == "polled")
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
