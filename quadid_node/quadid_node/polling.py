"""A node that takes the messages of some topics when it wants them, instead of being woken for each."""

from __future__ import annotations

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
        handle = subscription.handle

        def take() -> bytes | None:
            with handle:
                taken = handle.take_message(kind, True)
            return None if taken is None else taken[0]

        return take

    def publisher_counts(self) -> dict[str, int]:
        """How many publishers send to each polled topic now; one is counted before its first message can be taken."""
        return {s.topic_name: s.get_publisher_count() for s in self._polled}

    def destroy_polled(self) -> None:
        """Ends all polled subscriptions."""
        for subscription in self._polled:
            self.destroy_subscription(subscription)
        self._polled.clear()


def _never(message: bytes) -> None:
    """Stands where rclpy wants a callback."""
