"""Bond with a lifecycle manager (nav2): heartbeats on the topic `bond` from activation to deactivation."""

from __future__ import annotations

import uuid
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from quadid_node.inputs import MessageTypeError, message_class
from quadid_node.polling import NO_PUBLISHER_EVENTS, NO_SUBSCRIPTION_EVENTS

TOPIC, TYPE = "bond", "bond/Status"
PERIOD, TIMEOUT = 0.25, 4.0
"""Between two heartbeats, and after which the other side takes this one for dead [s]: as nav2's own nodes have them."""
GOODBYE = 1.0
"""The end of the bond waits so long to be received [s]; then the other side's timeout tells it."""


class Bond:
    """This side of one bond, named like the node, by the protocol of bondcpp.

    The node does nothing when the manager's side breaks: it acknowledges, and goes on as it is.
    """

    def __init__(self, node: Node) -> None:
        """Begins to send heartbeats; raises MessageTypeError where the package `bond` is not installed."""
        self._node, self._kind, self._me = node, message_class(TYPE), uuid.uuid4().hex
        self._publisher = node.create_publisher(self._kind, TOPIC, 5, event_callbacks=NO_PUBLISHER_EVENTS)
        self._subscription = node.create_subscription(
            self._kind, TOPIC, self._hear, 100, event_callbacks=NO_SUBSCRIPTION_EVENTS
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(PERIOD, lambda: self._say(True), clock=steady)

    def _say(self, active: bool) -> None:
        status = self._kind(id=self._node.get_name(), instance_id=self._me, active=active)
        status.header.stamp = self._node.get_clock().now().to_msg()
        status.heartbeat_period, status.heartbeat_timeout = PERIOD, TIMEOUT
        self._publisher.publish(status)

    def _hear(self, status: Any) -> None:
        ours = status.id == self._node.get_name() and status.instance_id != self._me
        if ours and not status.active and not self._timer.is_canceled():
            self._timer.cancel()
            self._say(False)

    def close(self) -> None:
        """Breaks the bond: the other side is told."""
        self._timer.cancel()
        self._say(False)
        self._publisher.wait_for_all_acked(Duration(seconds=GOODBYE))
        self._node.destroy_timer(self._timer)
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)


def bond_of(node: Node) -> Bond | None:
    """A bond, where the package `bond` is installed; None elsewhere: then the manager needs `bond_timeout: 0.0`."""
    try:
        return Bond(node)
    except MessageTypeError:
        return None
