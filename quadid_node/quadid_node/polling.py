"""A node that takes the messages of some topics when it wants them, instead of being woken for each."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.subscription import Subscription

# An event that the events executor watches outlives its topic's end, and takes the process down with it
# (ros2/rclpy issue 1644); rclpy asks for some by default.  What they would tell is looked for in the graph instead.
NO_SUBSCRIPTION_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)
NO_PUBLISHER_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)


class PollingNode(Node):
    """Keeps polled subscriptions from the executor; all others it serves as ever."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """As the class that follows."""
        self._polled: list[Subscription[Any]] = []
        self._broken_at: dict[str, float] = {}
        super().__init__(*arguments, **options)

    @property
    def subscriptions(self) -> Iterator[Subscription[Any]]:
        """What the executor waits for."""
        return (s for s in super().subscriptions if s not in self._polled)

    def poll(self, kind: Any, topic: str, qos: Any) -> Callable[[], bytes | None]:
        """Subscribes to a topic; returns what gives its next serialized message that waits, None when there is none."""
        subscription = self.create_subscription(
            kind, topic, _never, qos, raw=True, event_callbacks=NO_SUBSCRIPTION_EVENTS
        )
        self._polled.append(subscription)
        handle, name, last = subscription.handle, subscription.topic_name, None

        def take() -> bytes | None:
            nonlocal last
            with handle:
                taken = handle.take_message(kind, True)
            if taken is None:
                return None
            number = taken[1]["publication_sequence_number"]
            if number is None or last is None or number != last + 1:
                self._broken_at[name] = time.monotonic()
            last = number
            return bytes(taken[0])

        return take

    def unbroken(self, topic: str) -> float:
        """For how long [s] the messages of a polled topic have been one publisher's, each numbered one above the last.

        Publishers number their own messages, so two that are heard break each other's row; so does a loss.
        """
        return time.monotonic() - self._broken_at.get(topic, -math.inf)

    def publisher_counts(self) -> dict[str, int]:
        """How many publishers send to each polled topic now; one is counted before its first message can be taken."""
        return {s.topic_name: s.get_publisher_count() for s in self._polled}

    def destroy_polled(self) -> None:
        """Ends all polled subscriptions."""
        for subscription in self._polled:
            self.destroy_subscription(subscription)
        self._polled.clear()
        self._broken_at.clear()


def _never(message: bytes) -> None:
    """Stands where rclpy wants a callback."""
