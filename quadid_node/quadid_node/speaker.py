"""The node's publishers: candidates, findings, status, health; and parameter sets while the topic is ours."""

from __future__ import annotations

from typing import Any

from rclpy.duration import Infinite
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
LATCHED = ("diagnosis", "vehicle_health")
"""Topics whose last message is for late joiners too, as is that of the parameters."""


class Speaker:
    """Publishes for one vehicle.

    Attributes:
        ours: full name of the topic of parameter sets.
    """

    def __init__(self, node: LifecycleNode, observer: bool) -> None:
        """Makes the publishers.

        Args:
            node: whose they are.
            observer: publish status and health only.
        """
        self._node = node
        self.ours = node.resolve_topic_name(TOPICS["parameters"][0])
        self._publishers = {
            topic: self._create(topic, LATCHED_QOS if topic in LATCHED else USUAL_QOS)
            for topic in TOPICS
            if topic != "parameters"
        }
        self._claim: Claim | None = None
        if not observer:
            self._claim = Claim(
                lambda: node.count_publishers(self.ours), self._kin, self._claimed, node.destroy_lifecycle_publisher
            )

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
        return self._claim is not None and self._claim.step(wanted)

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
        """Takes all publishers away."""
        if self._claim is not None:
            self._claim.let_go()
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._publishers.clear()

    def _create(self, topic: str, qos: Any) -> Any:
        name, kind = TOPICS[topic]
        return self._node.create_lifecycle_publisher(
            message_class(kind), name, qos, event_callbacks=NO_PUBLISHER_EVENTS
        )

    def _kin(self) -> int:
        """Publishers of parameter sets that belong to a node of our name: services of this vehicle, this one too."""
        found = self._node.get_publishers_info_by_topic(self.ours)
        return sum(info.node_name == self._node.get_name() for info in found)

    def _claimed(self) -> Any:
        publisher = self._create("parameters", LATCHED_QOS)
        publisher.on_activate(None)  # made after the node's own activation
        return publisher
