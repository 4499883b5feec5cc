"""What ROS users publish wrongly, on the topics of a real node: each is named in /diagnostics, at WARN."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_node.inputs import deserializer, message_class
from quadid_node.replay_node import QOS
from quadid_replay import TopicWriter
from quadid_replay.writers import write_recording

from quadid.data.window import Recording
from tests.node.peers import Ear, node
from tests.node.test_mistakes_are_said import MISTAKES
from tests.online.driving import EPOCH, flight

pytestmark = pytest.mark.usefixtures("ros")
WARN = b"\x01"
SECONDS, SPEED = 9.0, 3.0
"""Of flight that a mistake is made in [s], and how much faster than that it is published."""
Edit = Callable[[Any, int], None]
"""Spoils a message; its number among those of the topic."""


class Tape(TopicWriter):
    """Keeps the messages of a recording: topic, type, bytes, stamp [ns]."""

    def __init__(self, recording: Recording) -> None:
        super().__init__(BytesIO())
        self.messages: list[tuple[str, str, bytes, int]] = []
        write_recording(self, recording, round(EPOCH * 1e9))

    def write_cdr(self, topic: str, kind: str, data: bytes, stamp_ns: int) -> None:
        self.messages.append((topic, kind, data, stamp_ns))


def spoilt(mistake: str) -> Recording:
    recording = flight(16.0, 3).recording
    channels = dict(recording.channels)
    for name, change in MISTAKES[mistake][0].items():
        values = np.array([change(tuple(row)) for row in channels[name].values.tolist()])
        channels[name] = replace(channels[name], values=values)
    return replace(recording, channels=channels)


@dataclass
class Vehicle:
    """A vehicle on the topics, and what the node says of it."""

    ear: Ear
    health: list[Any]

    def __post_init__(self) -> None:
        self.publishers: dict[str, Any] = {}

    def fly(self, recording: Recording, edit: Edit | None = None, burst: int = 1, stamps: str = "measured") -> None:
        """Publishes the messages of some seconds in order.

        Args:
            recording: of the flight.
            edit: what to do to messages of the IMU.
            burst: so many messages of each topic are sent together.
            stamps: ``measured``, or ``sent``: of the moment of publishing.
        """
        tape = Tape(recording).messages
        first, start, numbers = tape[0][3], time.monotonic(), dict.fromkeys((m[0] for m in tape), -1)
        held: dict[str, list[Any]] = {topic: [] for topic in numbers}
        base = time.time_ns()
        for topic, kind, data, stamp in tape:
            due = (stamp - first) * 1e-9
            if due > SECONDS:
                break
            numbers[topic] += 1
            message = deserializer(kind)(data)
            self._stamp(message, base + stamp - first)
            if edit is not None and topic == "imu":
                edit(message, numbers[topic])
            held[topic].append(message)
            self.ear.until(lambda due=due: time.monotonic() - start >= due / SPEED, 5.0)  # type: ignore[misc]
            if len(held[topic]) < burst:
                continue
            for one in held[topic]:
                if stamps == "sent":
                    self._stamp(one, base + round((time.monotonic() - start) * SPEED * 1e9))
                self._publisher(topic, kind).publish(one)
            held[topic].clear()

    @staticmethod
    def _stamp(message: Any, ns: int) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = ns // 10**9, ns % 10**9

    def _publisher(self, topic: str, kind: str) -> Any:
        if topic not in self.publishers:
            self.publishers[topic] = self.ear.node.create_publisher(message_class(kind), topic, QOS)
            self.ear.until(lambda: self.publishers[topic].get_subscription_count(), 20.0)
        return self.publishers[topic]

    def said(self, part: str) -> list[Any]:
        """What the node has said of a part of its health."""
        name = f"{self.ear.node.get_namespace()}/quadid: {part}".strip("/")
        return [s for h in self.health for s in h.status if s.name == name]

    def hears(self, part: str, word: str) -> None:
        """The node says `word` of a part of its health, at WARN."""

        def said() -> list[Any]:
            return [s for s in self.said(part) if word in s.message]

        assert self.ear.until(said, 5.0), [s.message for s in self.said(part)]
        assert {s.level for s in said()} == {WARN}


@contextmanager
def alone(folder: Path, mistake: str) -> Iterator[Vehicle]:
    """A vehicle with a node of its own: what others had told before would stand for what is missing."""
    from diagnostic_msgs.msg import DiagnosticArray

    namespace = re.sub(r"\W+", "_", mistake)
    with node(folder / "h.sqlite", namespace) as identify, Ear(namespace) as ear:
        identify.wait_for("ready", 120.0)
        yield Vehicle(ear, ear.listen("/diagnostics", DiagnosticArray))


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES)
def test_units_frames_and_motors(mistake: str, tmp_path: Path, ros: None) -> None:
    with alone(tmp_path, mistake) as vehicle:
        vehicle.fly(spoilt(mistake))
        vehicle.hears("session", MISTAKES[mistake][1])


def without_stamp(message: Any, number: int) -> None:
    message.header.stamp.sec = message.header.stamp.nanosec = 0


def without_rates(message: Any, number: int) -> None:
    message.angular_velocity_covariance[0] = -1.0


EDITS: dict[str, tuple[Edit | None, int, str, str]] = {
    "a covariance of -1": (without_rates, 1, "measured", "angular_velocity_covariance[0] is -1"),
    "sent in bursts": (None, 50, "measured", "comes in bursts"),
    "stamped in bursts": (None, 10, "sent", "stamped in bursts"),
    "zero stamps": (without_stamp, 1, "measured", "messages have no time (header.stamp is zero)"),
}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", EDITS)
def test_stamps_covariances_and_bursts(mistake: str, tmp_path: Path, ros: None) -> None:
    edit, burst, stamps, word = EDITS[mistake]
    with alone(tmp_path, mistake) as vehicle:
        vehicle.fly(flight(16.0, 3).recording, edit, burst, stamps)
        vehicle.hears("inputs", word)


@pytest.mark.slow
def test_a_good_flight_has_nothing_wrong(tmp_path: Path, ros: None) -> None:
    with alone(tmp_path, "good") as vehicle:
        vehicle.fly(flight(16.0, 3).recording)
        told = [s.message for part in ("inputs", "session") for s in vehicle.said(part)]
    assert "data arrive" in told
    assert not [text for text in told if "bursts" in text or "motor order" in text or "_covariance" in text]
