"""Health: what changed in a vehicle since the baseline flights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadid.app.logs import Flight, Given, Log, check_conventions, listed, open_recording, parse_part, vehicle_of
from quadid.app.outcome import LIBRARY, NUMBER_COLUMNS, Reported, number_rows, provenance
from quadid.data.window import Recording
from quadid.errors import LogError, NotIdentifiableError
from quadid.report.verdict import Verdict
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.condition import FlightTrim
    from quadid.condition.changes import Health
    from quadid.report.tables import TextTable

LEAST_THRUST = 0.25
"""No vehicle flies on less of its baseline's thrust per command, whatever it dropped and however new its propellers."""


@dataclass(frozen=True, repr=False)
class HealthOutcome(Reported):
    """What changed.

    Attributes:
        result: of the form ``quadid.health/1``.
        found: the comparison itself.
        vehicle: whose flights they are.
        recordings: the logs as read, those in question first.
    """

    result: dict[str, Any]
    found: Health
    vehicle: Vehicle
    recordings: tuple[Recording, ...]

    @property
    def verdict(self) -> Verdict:
        """Healthy or changed, and what to do."""
        from quadid.report.health_page import health_verdict

        return health_verdict(self.result)

    def tables(self) -> list[TextTable]:
        """Changes, and each trim against the baseline."""
        from quadid.report.health_page import change_table, trim_table

        changes = [change_table(self.result["changes"])] if self.result["changes"] else []
        return [*changes, trim_table(self.result)]

    @property
    def columns(self) -> tuple[str, ...]:
        """Those of `records`."""
        return (*NUMBER_COLUMNS, "p_value")

    def records(self) -> list[dict[str, Any]]:
        """One row a number of a change."""
        return [
            dict(zip(self.columns, (*row, c["p_value"]), strict=True)) for c, row in number_rows(self.result["changes"])
        ]

    def page(self, command: str = LIBRARY) -> str:
        """The page: what changed, a picture of the airframe, how far each flight is from healthy ones."""
        from quadid.condition.changes import distance
        from quadid.condition.trim import AXES
        from quadid.report.health_page import airframe_picture, health_page, trim_figure
        from quadid.report.page import render

        found, healthy = self.found, self.found.healthy
        now = np.mean([flight.shares for flight in found.flights], axis=0)
        marked = self.result["changes"] if found.verdict == "changed" else ()
        picture = airframe_picture(self.vehicle, now.tolist(), healthy.shares.tolist(), marked)
        rows = [
            (role, flight.name, distance(flight.mean - healthy.mean, healthy.predictive(1), healthy.freedom).tolist())
            for role, part in (("measured", found.baseline), ("after", found.flights))
            for flight in part
        ]
        made = provenance([], command) + [
            {"name": recording.name, "value": f"sha256 {recording.sha256 or 'unknown'}"}
            for recording in self.recordings
        ]
        return render(health_page(self.result, picture, made, [trim_figure(rows, AXES)]))


def health(
    logs: Given, baseline: Given, *, vehicle: str | Path | Vehicle | None = None, preset: str = "auto",
    unchecked: bool = False,
) -> HealthOutcome:  # fmt: skip
    """Compares flights with healthy flights of the same vehicle: which rotor, mass, centre of gravity, thrust.

    Works on gentle flights: hover for 5 s or more between take-off and landing.  All baseline flights share one healthy
    vehicle, all `logs` one that may have changed; how far healthy flights differ is estimated from the baseline.

    Args:
        logs: a flight or several in question, as paths or from `load`.
        baseline: a healthy flight or, much better, several.
        vehicle: a shipped name, a YAML file or a `Vehicle`; geometry counts, its parameters may be poorly known;
            default that of the first loaded log.
        preset: topic names of ROS logs.
        unchecked: use logs even when their units, frames or motors look wrong.

    Raises:
        LogError: no log, one that cannot be read, or a flight that is given twice.
        NotIdentifiableError: too little steady flight.
    """
    from quadid.condition.changes import assess
    from quadid.condition.trim import flight_trim

    tested, healthy = listed(logs), listed(baseline)
    if not tested or not healthy:
        missing = "flight in question" if not tested else "baseline flight"
        raise LogError(f"no {missing}", "one log or more of each", "name healthy flights with --baseline")
    described = vehicle_of([*tested, *healthy], vehicle)
    warnings: list[str] = []
    opened = [[_open(one, described, preset, unchecked, warnings) for one in part] for part in (tested, healthy)]
    _distinct(*opened)
    trims = [[flight_trim(recording, described) for recording in part] for part in opened]
    for trim in trims[0]:
        _check_flown(trim, trims[1])
    found = assess(trims[0], trims[1], described)
    if len(trims[1]) < 3:
        warnings.append(
            f"{len(trims[1])} baseline flight{'s' * (len(trims[1]) > 1)}: the spread of healthy flights is mostly "
            "assumed; use five or more, with several batteries"
        )
    result = found.to_dict()
    result["vehicle"] = described.name
    result["logs"], result["baseline"] = ([recording.name for recording in part] for part in opened)
    result["warnings"] = warnings
    return HealthOutcome(result, found, described, tuple(opened[0] + opened[1]))


def _check_flown(trim: FlightTrim, healthy: Sequence[FlightTrim]) -> None:
    """Raises NotIdentifiableError where rotors give far less thrust than the healthy vehicle weighs."""
    share = math.exp(trim.mean[-1] - sum(one.mean[-1] for one in healthy) / len(healthy))
    if share < LEAST_THRUST:
        raise NotIdentifiableError(
            f"{trim.name}: the rotors give {100.0 * share:.0f} % of the thrust of the baseline flights: not a flight",
            "flights", "use a flight; a hover is enough",
        )  # fmt: skip


def _open(given: Flight, vehicle: Vehicle, preset: str, unchecked: bool, warnings: list[str]) -> Recording:
    """The recording, cut to the part that is used; adds what looks wrong to `warnings`."""
    if isinstance(given, Log):
        recording, cut = given.recording, given.cut
    else:
        cut = parse_part(str(given))
        recording = open_recording(cut.path, preset, vehicle.columns)
    doubts = () if unchecked or not cut.checked else check_conventions(recording, vehicle, cut).doubts
    warnings += [f"{recording.name}: {text}" for text in (*recording.warnings, *doubts)]
    return cut.of(recording)


def _distinct(tested: Sequence[Recording], healthy: Sequence[Recording]) -> None:
    """Raises LogError where a flight counts twice: it would be compared with itself, or narrow the spread."""
    seen: list[tuple[str, Recording]] = []
    for place, part in (("in question", tested), ("in the baseline", healthy)):
        for one in part:
            for before, other in seen:
                if one.sha256 and one.sha256 == other.sha256 and _overlap(one, other):
                    copy = "is" if one.name == other.name else f"holds the bytes of {other.name}: the flight is"
                    where = f"twice {place}" if place == before else f"{before} and {place}"
                    raise LogError(f"{one.name} {copy} {where}", "each flight once", "leave one of the two out")
            seen.append((place, one))


def _overlap(one: Recording, other: Recording) -> bool:
    """Whether two parts of a log share time."""
    (a, b), (c, d) = one.span, other.span
    return a < d and c < b
