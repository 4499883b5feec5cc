"""Which logs and which vehicle a piece of work is about."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadid.errors import LogError
from quadid.workflow.loading import Log, as_vehicle
from quadid.workflow.overlap import check_unseen

if TYPE_CHECKING:
    from pathlib import Path

    from quadid.vehicle import Vehicle

Given = Log | Sequence[Log]
"""A log or several."""


def listed(logs: Given) -> list[Log]:
    """Logs as a list."""
    return [logs] if isinstance(logs, Log) else list(logs)


def settled(logs: Given, validate: Given, vehicle: str | Path | Vehicle | None) -> tuple[Vehicle, list[Log], list[Log]]:
    """The vehicle, and the logs to fit and to score, all read with its description.

    Raises:
        LogError: no log, or a log to score that is fitted too.
    """
    train, held = listed(logs), listed(validate)
    if not train:
        raise LogError("no log", "at least one, from quadid.load", "give a log")
    check_unseen(train, held)
    described = train[0].vehicle if vehicle is None else as_vehicle(vehicle)
    return described, [log.of(described) for log in train], [log.of(described) for log in held]
