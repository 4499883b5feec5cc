"""Which logs and which vehicle a piece of work is about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from quadid.errors import LogError
from quadid.workflow.loading import Log, as_vehicle
from quadid.workflow.overlap import check_unseen, without_own_priors

if TYPE_CHECKING:
    from pathlib import Path

    from quadid.vehicle import Vehicle

Given = Log | Sequence[Log]
"""A log or several."""


def listed(logs: Given) -> list[Log]:
    """Logs as a list."""
    return [logs] if isinstance(logs, Log) else list(logs)


@dataclass(frozen=True)
class Settled:
    """What a piece of work is about.

    Attributes:
        vehicle: as described, without priors that come from the flights to fit.
        train: logs to fit.
        held: logs to score only.
        notes: what a user should know about this choice.
    """

    vehicle: Vehicle
    train: list[Log]
    held: list[Log]
    notes: list[str]

    @property
    def warnings(self) -> list[str]:
        """The notes, and what is wrong with the logs."""
        return [*self.notes, *(text for log in (*self.train, *self.held) for text in log.warnings)]


def settled(logs: Given, validate: Given, vehicle: str | Path | Vehicle | None) -> Settled:
    """The vehicle, and the logs to fit and to score, all read with its description.

    Raises:
        LogError: no log, or a log to score that is fitted too, or that the vehicle file was fitted to.
    """
    train, held = listed(logs), listed(validate)
    if not train:
        raise LogError("no log", "at least one, from quadid.load", "give a log")
    described = train[0].vehicle if vehicle is None else as_vehicle(vehicle)
    check_unseen(train, held, described)
    train, held = [log.of(described) for log in train], [log.of(described) for log in held]
    described, notes = without_own_priors(described, train)
    return Settled(described, train, held, notes)
