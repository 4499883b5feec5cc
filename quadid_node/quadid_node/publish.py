"""Publication over ROS: publishers, ownership of topics, other nodes of the graph, and the bond."""

import math
import random
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration, Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)

from quadid.sanitise import plain
from quadid_node.inputs import message_class, to_message
from quadid_node.messages import TOPICS, Message

# An event that the events executor watches outlives its topic's end, and takes the process down with it
# (ros2/rclpy issue 1644); rclpy asks for some by default.  What they would tell is looked for in the graph instead.
NO_SUBSCRIPTION_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)
NO_PUBLISHER_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)

# --- The right to publish the parameter sets of one vehicle: who comes second observes until the first is gone


FOUND_WITHIN = 4.0
"""Others are found by then [s]: Fast DDS announces a participant every 3 s, and half of the starts measured found a
service that ran already only by its next announcement (up to 2.9 s)."""
YOUNG = 10.0
"""Two that claimed at once, within this time [s], both let go, and try again after pauses of different length."""
PAUSES = (0.5, 4.0)
"""Least and most of such a pause [s]."""
OBSERVES = "another service publishes parameter sets here: this one observes until that one is gone"
BESIDE = "another service publishes parameter sets too: one of the two stops in a moment"
STRANGER = "someone else publishes parameter sets on our topic: check sequence and log_hash"


class TopicOwnership:
    """Ownership of one topic that one service may publish on.

    Attributes:
        publisher: ours; None while another one is there.
        problem: what is wrong, or empty.
    """

    def __init__(
        self, node: Any, topic: str, create: Callable[[], Any], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Claims nothing yet; `create` makes our publisher on the topic of this full name."""
        self._node, self._topic, self._create, self._clock = node, topic, create, clock
        self._not_before, self._since = clock() + FOUND_WITHIN, 0.0
        self._leaves = math.inf
        self.publisher: Any = None
        self.problem = ""

    def step(self, wanted: bool = True) -> bool:
        """Looks who is there; returns True when the topic has just become ours.

        Args:
            wanted: False while nothing is to be published yet: only looks.
        """
        now = self._clock()
        others = self._node.count_publishers(self._topic) - (self.publisher is not None)
        if self.publisher is None:
            if others > 0:
                self._wait(now)
            elif not wanted:
                self.problem = ""
            elif now >= self._not_before:
                self.publisher, self._since, self.problem = self._create(), now, ""
                return True
        elif others > 0:
            # Gives way at once while young; later only to a service, each after a pause of its own: one of them
            # stays.
            if now - self._since >= YOUNG and self._kin() < 2:
                self.problem, self._leaves = STRANGER, math.inf
            elif now - self._since >= YOUNG and now < self._leaves:
                self.problem = BESIDE
                if math.isinf(self._leaves):
                    self._leaves = now + random.uniform(*PAUSES)
            else:
                self.let_go()
                self._wait(now)
        else:
            self.problem, self._leaves = "", math.inf
        return False

    def let_go(self) -> None:
        """Takes our publisher away."""
        if self.publisher is not None:
            self._node.destroy_lifecycle_publisher(self.publisher)
            self.publisher, self._leaves = None, math.inf

    def _kin(self) -> int:
        """Publishers that belong to a node of our name: services of this vehicle, this one too."""
        found = self._node.get_publishers_info_by_topic(self._topic)
        return sum(info.node_name == self._node.get_name() for info in found)

    def _wait(self, now: float) -> None:
        self._not_before = now + random.uniform(*PAUSES)
        self.problem = OBSERVES


# --- The node's publishers: status and diagnostics always; results; parameter sets while the topic is ours


LEASE = 5.0
"""A service that asserts its liveliness on the parameter topic for longer than this [s] no more is dead or hangs."""


def _qos(depth: int, durability: DurabilityPolicy, **more: Any) -> QoSProfile:
    """A profile, said in full so that it can be compared with what subscribers ask for."""
    usual = {"deadline": Infinite, "liveliness": LivelinessPolicy.AUTOMATIC, "liveliness_lease_duration": Infinite}
    return QoSProfile(depth=depth, durability=durability, reliability=ReliabilityPolicy.RELIABLE, **(usual | more))


USUAL_QOS = _qos(10, DurabilityPolicy.VOLATILE)
LATCHED_QOS = _qos(1, DurabilityPolicy.TRANSIENT_LOCAL)
PARAMETERS_QOS = _qos(
    1,
    DurabilityPolicy.TRANSIENT_LOCAL,
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
    liveliness_lease_duration=Duration(seconds=LEASE),
)
ALWAYS = ("status", "diagnostics")
"""Topics that speak in every state of the life cycle."""
LATCHED = ("diagnosis", "vehicle_health")
"""Topics whose last message is for late joiners too, as is that of the parameters."""


class Publishers:
    """Publishes for one vehicle.

    Attributes:
        ours: full name of the topic of parameter sets.
    """

    def __init__(self, node: LifecycleNode) -> None:
        """Publishes status and diagnostics of `node`."""
        self._node = node
        self.ours = node.resolve_topic_name(TOPICS["parameters"][0])
        self._publishers = {topic: self._create(topic, USUAL_QOS, node.create_publisher) for topic in ALWAYS}
        self._ownership: TopicOwnership | None = None

    def open(self, observer: bool) -> None:
        """Offers the results too; an observer none of them."""
        managed = self._node.create_lifecycle_publisher
        for topic in TOPICS.keys() - {"parameters", *ALWAYS}:
            self._publishers[topic] = self._create(topic, LATCHED_QOS if topic in LATCHED else USUAL_QOS, managed)
        if not observer:
            self._ownership = TopicOwnership(self._node, self.ours, self._claimed)

    @property
    def _speaking(self) -> dict[str, Any]:
        """The publishers by topic; that of parameter sets only while the topic is ours."""
        own = self._ownership.publisher if self._ownership is not None else None
        return self._publishers if own is None else {**self._publishers, "parameters": own}

    @property
    def silent(self) -> bool:
        """Checks whether results stay unsaid: an observer, or another service speaks for this vehicle."""
        return "parameters" not in self._speaking

    @property
    def problem(self) -> str:
        """Other publishers of parameter sets, or empty."""
        return self._ownership.problem if self._ownership is not None else ""

    def step(self, wanted: bool = True) -> bool:
        """Looks who else publishes parameter sets; True when the topic has just become ours, if it is `wanted`."""
        if self._ownership is None:
            return False
        if self._ownership.publisher is not None:
            self._ownership.publisher.assert_liveliness()
        return self._ownership.step(wanted)

    def publish(self, topic: str, fields: Message) -> None:
        """Publishes a message given as a dictionary; parameter sets only while the topic is ours."""
        if publisher := self._speaking.get(topic):
            publisher.publish(to_message(TOPICS[topic][1], fields))

    def deaf(self) -> dict[str, bool]:
        """For each topic of ours: whether somebody subscribes with a QoS that is not offered, and hears nothing."""

        def unheard(publisher: Any) -> bool:
            asked = [info.qos_profile for info in self._node.get_subscriptions_info_by_topic(publisher.topic_name)]
            return any(qos_check_compatible(publisher.qos_profile, q)[0] == QoSCompatibility.ERROR for q in asked)

        return {publisher.topic_name: unheard(publisher) for publisher in self._speaking.values()}

    def close(self) -> None:
        """Takes the publishers of results away."""
        if self._ownership is not None:
            self._ownership.let_go()
            self._ownership = None
        for topic in self._publishers.keys() - {*ALWAYS}:
            self._node.destroy_lifecycle_publisher(self._publishers.pop(topic))

    def _create(self, topic: str, qos: Any, create: Callable[..., Any]) -> Any:
        name, kind = TOPICS[topic]
        return create(message_class(kind), name, qos, event_callbacks=NO_PUBLISHER_EVENTS)

    def _claimed(self) -> Any:
        publisher = self._create("parameters", PARAMETERS_QOS, self._node.create_lifecycle_publisher)
        publisher.on_activate(None)  # made after the node's own activation
        return publisher


# --- Who else is on our topics: a second publisher of an input, others whose QoS or type does not match


ALONE = 1.0
"""An input with several publishers is used when only one of them was heard for this long [s].  One that was killed
stays listed until its lease ends (20 s with Fast DDS), while its successor already speaks."""


class Offer(NamedTuple):
    """One publisher of a topic: the type of its messages, and whether its QoS lets us hear them."""

    kind: str
    heard: bool


class GraphMonitor:
    """Monitors the graph: reports what is wrong on the topics.

    Attributes:
        paused: two publishers of an input are heard: taking samples would mix two vehicles.
    """

    def __init__(
        self,
        inputs: Mapping[str, str],
        offered: Callable[[str], Sequence[Offer]],
        unbroken: Callable[[str], float],
        tell: Callable[[str], None],
    ) -> None:
        """Watches the topics `inputs`.

        Args:
            unbroken: for how long [s] a topic's messages have been one publisher's.
        """
        self._inputs, self._offered, self._unbroken, self._tell = dict(inputs), offered, unbroken, tell
        self.notes: dict[str, str] = {}
        self.paused = False

    def note(self, topic: str, text: str) -> None:
        """Notes what is wrong on a topic; an empty text: nothing is."""
        if not text:
            self.notes.pop(topic, None)
        elif self.notes.get(topic) != text:
            self._tell(f"{topic}: {text}")
            self.notes[topic] = text

    def count(self, topic: str, publishers: int) -> None:
        """So many publishers send to an input: two are noted, and pause it at once while both are heard."""
        if publishers <= 1:
            return
        if self._unbroken(topic) < ALONE:
            self.paused = True
            self.note(topic, f"{publishers} publishers on one topic: paused until only one publishes")
        else:
            self.note(topic, f"{publishers} publishers on one topic, only one publishes")

    def look(self, deaf: Mapping[str, bool]) -> None:
        """Looks at every topic, once a second.

        Args:
            deaf: for each topic of ours, whether somebody subscribes with a QoS that is not offered.
        """
        self.paused = False
        for topic, kind in self._inputs.items():
            offers = self._offered(topic)
            ours = [offer for offer in offers if offer.kind == kind]
            strange = sorted({offer.kind for offer in offers} - {kind})
            if len(ours) > 1:
                self.count(topic, len(ours))
            elif strange:
                told = f"a publisher of another type ({plain(strange[0], 80)} for {kind}), which is not listened to"
                self.note(topic, told)
            else:
                self.note(topic, "" if all(offer.heard for offer in ours) else "its publisher's QoS does not match")
        for topic, found in deaf.items():
            why = "asks for a QoS that is not offered here, and receives nothing" if found else ""
            self.note(f"{topic}, its subscriber", why)


# --- Bond with a lifecycle manager (nav2): heartbeats on the topic `bond` from activation to deactivation


TOPIC, TYPE = "bond", "bond/Status"
PERIOD, TIMEOUT = 0.25, 4.0
"""Between two heartbeats, and after which the other side takes this one for dead [s]: as nav2's own nodes have them."""
GOODBYE = 1.0
"""The end of the bond waits so long to be received [s]; then the other side's timeout ends it."""


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
        """Breaks the bond, and announces that to the other side."""
        self._timer.cancel()
        self._say(False)
        self._publisher.wait_for_all_acked(Duration(seconds=GOODBYE))
        self._node.destroy_timer(self._timer)
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)
