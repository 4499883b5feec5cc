"""Which logs and which vehicle a piece of work is about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from quadid.errors import LogError, VehicleError
from quadid_workflow.loading import Log, as_vehicle, load
from quadid_workflow.overlap import check_unseen, without_own_priors

if TYPE_CHECKING:
    from quadid.vehicle import Vehicle

Flight = str | Path | Log
"""A log: its path, with a span if wanted, or as `quadid.load` returns it."""
Given = Flight | Sequence[Flight]
"""A log or several."""


def listed(logs: Given) -> list[Flight]:
    """Logs as a list."""
    return [logs] if isinstance(logs, str | Path | Log) else list(logs)


def vehicle_of(logs: Sequence[Flight], vehicle: str | Path | Vehicle | None) -> Vehicle:
    """The vehicle that is asked for, else that of the first loaded log.

    Raises:
        VehicleError: no such vehicle, or only paths of logs, which do not say whose they are.
    """
    if vehicle is not None:
        return as_vehicle(vehicle)
    for log in logs:
        if isinstance(log, Log):
            return log.vehicle
    raise VehicleError(
        f"no vehicle for {logs[0]}", "a shipped name, a YAML file or a Vehicle",
        'give vehicle="...", or a log from quadid.load(path, vehicle="...")',
    )  # fmt: skip


def read(logs: Given, vehicle: Vehicle) -> list[Log]:
    """Logs as a list, read with this description of the vehicle: checked, and on the grid.

    Raises:
        LogError: a log that cannot be read or does not fit the vehicle.
    """
    return [log.of(vehicle) if isinstance(log, Log) else load(log, vehicle) for log in listed(logs)]


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
        found = [*self.notes, *(text for log in (*self.train, *self.held) for text in log.warnings)]
        return list(dict.fromkeys(found))  # parts of one log repeat them


def settled(logs: Given, validate: Given, vehicle: str | Path | Vehicle | None) -> Settled:
    """The vehicle, and the logs to fit and to score, all read with its description.

    Raises:
        LogError: no log, or a log to score that is fitted too, or that the vehicle file was fitted to.
        VehicleError: no such vehicle, or only paths of logs and none that says whose they are.
    """
    given = listed(logs)
    if not given:
        raise LogError("no log", "at least one, a path or from quadid.load", "give a log")
    described = vehicle_of(given, vehicle)
    train, held = read(given, described), read(validate, described)
    check_unseen(train, held, described)
    described, notes = without_own_priors(described, train)
    return Settled(described, train, held, notes)
