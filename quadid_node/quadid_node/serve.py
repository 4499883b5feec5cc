"""The service without ROS: a MAVLink link in, MAVLink and Zenoh out, until someone says stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from quadid_node.mavlink_link import MavlinkLink
from quadid_node.publication import Output
from quadid_node.service import Health, Service

IDLE = 0.005
"""Pause when nothing arrives [s]."""
WORK_SECONDS = 0.02
"""No piece of the session's work begins later than this in a step [s]."""


class Outlet(Protocol):
    """Somewhere results go."""

    def publish(self, output: Output) -> None:
        """Tells a result."""

    def report(self, health: Health) -> None:
        """Tells once a second how things are."""

    def attend(self) -> None:
        """Carries out what was asked through it."""


def run(
    service: Service, link: MavlinkLink, outlets: list[Outlet], stop: Callable[[], bool],
    clock: Callable[[], float] = time.monotonic,
) -> None:  # fmt: skip
    """Serves until `stop` says so.

    Args:
        service: of the vehicle.
        link: where samples come from and results go.
        outlets: where results go as well.
        stop: asked often.
        clock: seconds, monotonic.
    """
    reported = clock()
    while not stop():
        busy = False
        for sample in link.receive():
            busy = True
            service.push(sample)
        for output in service.step(WORK_SECONDS):
            link.publish(output)
            for outlet in outlets:
                outlet.publish(output)
        link.step()
        for outlet in outlets:
            outlet.attend()
        if clock() - reported >= 1.0:
            reported = clock()
            health = service.health()
            for outlet in outlets:
                outlet.report(health)
        if not busy:
            time.sleep(IDLE)
