"""What ROS users publish wrongly is named in /diagnostics, at WARN, and nothing is learned from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
from quadid_node.messages import WARN, diagnostics
from quadid_node.service import Service
from quadid_node.worker import InlineWorker

from quadid.online import SessionSettings
from quadid.vehicle import GRAVITY
from tests.node.aggregator import branches
from tests.online.driving import EPOCH, flight, samples
from tests.online.made_up import PELICAN

Values = tuple[float, ...]


def flipped(v: Values) -> Values:
    return v[0], -v[1], -v[2]


def turned(q: Values) -> Values:
    """The body's axes turned by half a turn about x."""
    return q[0], q[1], -q[2], -q[3]


def world(q: Values) -> Values:
    """The world's axes exchanged: north for east, up for down."""
    w, x, y, z = q
    return tuple(c / math.sqrt(2.0) for c in (-x - y, w + z, w - z, y - x))


MISTAKES: dict[str, tuple[dict[str, Callable[[Values], Values]], str]] = {
    "PX4's body axes in every channel": (
        {"gyro": flipped, "accel": flipped, "attitude": turned},
        "PX4 has FRD and NED",
    ),
    "PX4's body axes in the gyro": ({"gyro": flipped}, "gyro axes differ"),
    "PX4's world": ({"attitude": world}, "its world has z up"),
    "no gravity": ({"accel": lambda v: (v[0], v[1], v[2] + GRAVITY)}, "gravity is missing"),
    "acceleration in g": ({"accel": lambda v: tuple(c / GRAVITY for c in v)}, "in g"),
    "degrees": ({"gyro": lambda v: tuple(map(math.degrees, v))}, "deg/s"),
    "rpm": ({"rotor_speed": lambda v: tuple(c * 30.0 / math.pi for c in v)}, "rpm"),
    "two rotors exchanged": ({"rotor_speed": lambda v: (v[1], v[0], *v[2:])}, "in the order 2, 1, 3, 4"),
    "rotors numbered around": ({"rotor_speed": lambda v: (v[1], v[2], v[3], v[0])}, "in the order 4, 1, 2, 3"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_at_warn_and_nothing_is_learned(mistake: str) -> None:
    changes, word = MISTAKES[mistake]
    service = Service(PELICAN, SessionSettings(diagnose=0.0), InlineWorker())
    for sample in samples(flight(16.0, 3).recording, EPOCH):
        change = changes.get(sample.channel)
        service.push(sample if change is None else replace(sample, values=change(sample.values)))
    service.step()
    told = diagnostics(service.health(), "/quad1/quadid", "pelican", {}, {}, {})
    assert all(len(branches(entry["name"])) == 1 for entry in told["status"])
    session = next(entry for entry in told["status"] if entry["name"].endswith("session"))
    assert word in session["message"]
    assert session["level"] == WARN
    assert service.session.status().fits == 0
