"""What others do on the topics is told, and taken back when it is over."""

from __future__ import annotations

import pytest
from quadid_node.publish import GraphMonitor, Offer

IMU, JOINTS = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState"
GOOD = Offer(IMU, True)


class Topic:
    """One input, whose publishers are as set."""

    def __init__(self) -> None:
        self.offers: list[Offer] = [GOOD]
        self.lines: list[str] = []
        self.unbroken = 0.0
        self.graph = GraphMonitor(
            {"/imu": IMU}, lambda topic: self.offers, lambda topic: self.unbroken, self.lines.append
        )

    def look(self, *offers: Offer, deaf: bool = False) -> dict[str, str]:
        self.offers = [*offers]
        self.graph.look({"/candidate": deaf})
        return self.graph.notes


@pytest.fixture
def topic() -> Topic:
    return Topic()


@pytest.mark.parametrize(
    ("offers", "told"),
    [
        ([GOOD, GOOD], "2 publishers on one topic: paused until only one publishes"),
        ([Offer(IMU, False)], "its publisher's QoS does not match"),
        ([GOOD, Offer(JOINTS, True)], f"a publisher of another type ({JOINTS} for {IMU}), which is not listened to"),
    ],
)
def test_what_is_wrong_is_told_once_and_taken_back(topic: Topic, offers: list[Offer], told: str) -> None:
    assert topic.look(*offers) == {"/imu": told}
    topic.look(*offers)
    assert topic.lines == [f"/imu: {told}"]
    assert topic.look(GOOD) == {}
    assert topic.look(*offers) == {"/imu": told}
    assert topic.look() == {}, "nobody there any more"


def test_two_publishers_pause_at_once_and_one_goes_on(topic: Topic) -> None:
    topic.graph.count("/imu", 1)
    assert not topic.graph.paused
    topic.graph.count("/imu", 2)
    assert topic.graph.paused
    topic.look(GOOD, GOOD)
    assert topic.graph.paused
    topic.look(GOOD)
    assert not topic.graph.paused


def test_a_publisher_that_is_listed_but_not_heard_does_not_pause(topic: Topic) -> None:
    """One that was killed is listed until its lease ends."""
    topic.graph.count("/imu", 2)
    assert topic.graph.paused
    topic.unbroken = 1.1
    assert topic.look(GOOD, GOOD) == {"/imu": "2 publishers on one topic, only one publishes"}
    assert not topic.graph.paused
    topic.unbroken = 0.02
    topic.graph.count("/imu", 2)
    assert topic.graph.paused


def test_two_types_on_a_topic_do_not_pause(topic: Topic) -> None:
    topic.look(GOOD, Offer(JOINTS, True))
    assert not topic.graph.paused


def test_a_subscriber_that_hears_nothing_is_named_while_it_is_there(topic: Topic) -> None:
    assert topic.look(GOOD, deaf=True) == {
        "/candidate, its subscriber": "asks for a QoS that is not offered here, and receives nothing"
    }
    assert topic.look(GOOD) == {}
