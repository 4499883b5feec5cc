"""Inspection: what a log holds, whether it can be true, what it allows, and how to log what is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid.app.logs import (
    GRID,
    LONGEST,
    Log,
    LogPart,
    as_vehicle,
    flown_parts,
    gridded,
    left_on_ground,
    names_of,
    open_recording,
    parse_part,
)
from quadid.app.outcome import Outcome
from quadid.data.window import Recording, beginning
from quadid.errors import QuadidError
from quadid.parameters import NOMINAL_UNITS
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.checks import Check, Inspection
    from quadid.checks.motion import Spans
    from quadid.report.tables import TextTable


@dataclass(frozen=True, repr=False)
class Inspected(Outcome):
    """What a log holds; `result` has the form ``quadid.inspect/1``."""

    result: dict[str, Any]
    found: Inspection

    @property
    def heading(self) -> str:
        """Name, format, length, when it flies, and whether the log can be used."""
        from quadid.report.tables import heading, usability

        return f"{heading(self.found)}\n{usability(self.found).text}"

    @property
    def sentences(self) -> list[str]:
        """Findings of the checks, then missing channels."""
        from quadid.report.tables import sentences

        return [cell.text for cell in sentences(self.found)]

    @property
    def warnings(self) -> list[str]:
        """What the reader had to say, and what to leave out of the log."""
        use = self.result["use"]
        return [*self.found.warnings, *([left_on_ground(use)] if use else [])]

    def tables(self) -> list[TextTable]:
        """Channels, checks, parameters, and what is missing."""
        from quadid.report.tables import inspect_tables

        return inspect_tables(self.found)

    def records(self) -> list[dict[str, Any]]:
        """One row a channel."""
        return list(self.result["channels"])


def inspect(
    log: str | Path | Log, vehicle: str | Path | Vehicle | None = None, *, start: float | None = None,
    stop: float | None = None, preset: str = "auto", columns: Mapping[str, str] | None = None,
) -> Inspected:  # fmt: skip
    """Inspects a log, and never refuses one that can be read.

    Args:
        log: path, path with a span as in ``flight.bin@76:216``, or a log from `load`.
        vehicle: with it, motors and excitation are checked too; default the one a loaded log has.
        start: first time to look at [s], after the log's first IMU sample.
        stop: last time [s], likewise.
        preset: topic names of ROS logs.
        columns: names in a CSV by names of the contract, beside those of the vehicle file.

    Raises:
        LogError: not readable, or nothing in the span.
        VehicleError: no such vehicle.
    """
    from quadid.checks import inspect as inspect_recording

    if isinstance(log, Log):
        cut, whole, vehicle = log.cut, log.recording, log.vehicle if vehicle is None else vehicle
    else:
        cut = parse_part(str(log), start, stop)
        whole = None
    described = None if vehicle is None else as_vehicle(vehicle)
    if whole is None:
        named = {} if described is None else described.columns
        whole = open_recording(cut.path, preset, {**named, **(columns or {})})
    found = replace(inspect_recording(cut.of(whole), described), zero=whole.first_imu_time)
    flown = flown_parts(whole, found.flying, cut)
    if described is not None:
        refused = _refused(whole, described, cut, flown) if found.usable else ()
        rows = _excitation(whole, described, cut, flown)
        found = replace(found, excitation=rows, checks=(*found.checks, *refused))
    use = names_of(cut, flown)
    return Inspected({**found.to_dict(), "use": use, "log": str(cut.path.resolve()), "files": []}, found)


def _refused(recording: Recording, vehicle: Vehicle, cut: LogPart, flown: Spans) -> tuple[Check, ...]:
    """An error with the reason for which `identify` would not fit the log; none where it would."""
    from quadid.checks import Check, CheckResult
    from quadid.identification.fit import check_windows

    try:
        check_windows(gridded(recording, vehicle, None, cut, flown)[0])
    except QuadidError as error:
        return (Check("data", CheckResult.ERROR, error.found, error.fix or f"allowed: {error.allowed}"),)
    return ()


def _excitation(recording: Recording, vehicle: Vehicle, cut: LogPart, flown: Spans) -> tuple[dict[str, Any], ...]:
    """Expected relative standard deviation per parameter, from up to `LONGEST` s of flight; none when refused."""
    from quadid.identification.excitation import excitation

    try:
        windows, _ = beginning(gridded(recording, vehicle, GRID, cut, flown)[0], LONGEST)
        found = excitation(windows, vehicle)
    except QuadidError:
        return ()  # the inspection itself says what is missing or too slow
    return tuple(
        {
            "name": name,
            "unit": NOMINAL_UNITS[name],
            "relative_sigma": float(bound),
            "relative_sigma_alone": float(alone),
        }
        for name, bound, alone in zip(found.names, found.bound, found.alone, strict=True)
    )
