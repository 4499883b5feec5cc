"""The node's publishers: status and diagnostics always; results; parameter sets while the topic is ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.duration import Duration, Infinite
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)

from quadid_node.claim import Claim
from quadid_node.convert import message_class, to_message
from quadid_node.messages import TOPICS, Message
from quadid_node.polling import NO_PUBLISHER_EVENTS

# Said in full, so that they can be compared with what subscribers ask for.
_ALWAYS = {"deadline": Infinite, "liveliness": LivelinessPolicy.AUTOMATIC, "liveliness_lease_duration": Infinite}
USUAL_QOS = QoSProfile(
    depth=10, durability=DurabilityPolicy.VOLATILE, reliability=ReliabilityPolicy.RELIABLE, **_ALWAYS
)  # fmt: skip
LATCHED_QOS = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE, **_ALWAYS
)  # fmt: skip
LEASE = 5.0
"""A service that asserts its liveliness on the parameter topic for longer than this [s] no more is dead or hangs."""
PARAMETERS_QOS = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE, deadline=Infinite,
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC, liveliness_lease_duration=Duration(seconds=LEASE),
)  # fmt: skip
ALWAYS = ("status", "diagnostics")
"""Topics that speak in every state of the life cycle."""
LATCHED = ("diagnosis", "vehicle_health")
"""Topics whose last message is for late joiners too, as is that of the parameters."""


class Speaker:
    """Publishes for one vehicle.

    Attributes:
        ours: full name of the topic of parameter sets.
    """

    def __init__(self, node: LifecycleNode) -> None:
        """Publishes status and diagnostics of `node`."""
        self._node = node
        self.ours = node.resolve_topic_name(TOPICS["parameters"][0])
        self._publishers = {topic: self._create(topic, USUAL_QOS, node.create_publisher) for topic in ALWAYS}
        self._claim: Claim | None = None

    def open(self, observer: bool) -> None:
        """Offers the results too; an observer none of them."""
        managed = self._node.create_lifecycle_publisher
        for topic in TOPICS.keys() - {"parameters", *ALWAYS}:
            self._publishers[topic] = self._create(topic, LATCHED_QOS if topic in LATCHED else USUAL_QOS, managed)
        if not observer:
            self._claim = Claim(
                lambda: self._node.count_publishers(self.ours), self._kin, self._claimed,
                self._node.destroy_lifecycle_publisher,
            )  # fmt: skip

    @property
    def silent(self) -> bool:
        """Whether results stay unsaid: an observer, or another service speaks for this vehicle."""
        return self._claim is None or self._claim.publisher is None

    @property
    def problem(self) -> str:
        """Who else publishes parameter sets, or empty."""
        return self._claim.problem if self._claim is not None else ""

    def step(self, wanted: bool = True) -> bool:
        """Looks who else publishes parameter sets; True when the topic has just become ours, if it is `wanted`."""
        if self._claim is None:
            return False
        if self._claim.publisher is not None:
            self._claim.publisher.assert_liveliness()
        return self._claim.step(wanted)

    def publish(self, topic: str, fields: Message) -> None:
        """Publishes a message given as a dictionary; parameter sets only while the topic is ours."""
        publisher = self._publishers.get(topic)
        if topic == "parameters" and self._claim is not None:
            publisher = self._claim.publisher
        if publisher is not None:
            publisher.publish(to_message(TOPICS[topic][1], fields))

    def deaf(self) -> dict[str, bool]:
        """For each topic of ours: whether somebody subscribes with a QoS that is not offered, and hears nothing."""
        published = dict(self._publishers)
        if self._claim is not None and self._claim.publisher is not None:
            published["parameters"] = self._claim.publisher
        return {p.topic_name: self._unheard(p) for p in published.values()}

    def _unheard(self, publisher: Any) -> bool:
        asked = [info.qos_profile for info in self._node.get_subscriptions_info_by_topic(publisher.topic_name)]
        offered = publisher.qos_profile
        return any(qos_check_compatible(offered, wish)[0] == QoSCompatibility.ERROR for wish in asked)

    def close(self) -> None:
        """Takes the publishers of results away."""
        if self._claim is not None:
            self._claim.let_go()
            self._claim = None
        for topic in self._publishers.keys() - {*ALWAYS}:
            self._node.destroy_lifecycle_publisher(self._publishers.pop(topic))

    def _create(self, topic: str, qos: Any, create: Callable[..., Any]) -> Any:
        name, kind = TOPICS[topic]
        return create(message_class(kind), name, qos, event_callbacks=NO_PUBLISHER_EVENTS)

    def _kin(self) -> int:
        """Publishers of parameter sets that belong to a node of our name: services of this vehicle, this one too."""
        found = self._node.get_publishers_info_by_topic(self.ours)
        return sum(info.node_name == self._node.get_name() for info in found)

    def _claimed(self) -> Any:
        publisher = self._create("parameters", PARAMETERS_QOS, self._node.create_lifecycle_publisher)
        publisher.on_activate(None)  # made after the node's own activation
        return publisher
