"""Inspection: what a log holds, whether it can be true, what it allows, and how to log what is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid.errors import QuadidError
from quadid_workflow.loading import GRID, LONGEST, Log, as_vehicle, gridded, open_recording
from quadid_workflow.log_parts import LogPart, flown_parts, left_on_ground, names_of, parse_part
from quadid_workflow.outcome import Outcome

if TYPE_CHECKING:
    from quadid_report.text_table import TextTable

    from quadid.inspection import Inspection
    from quadid.inspection.airborne import Spans
    from quadid.vehicle import Vehicle
    from quadid.window import Recording


@dataclass(frozen=True, repr=False)
class Inspected(Outcome):
    """What a log holds; `result` has the form ``quadid.inspect/1``."""

    result: dict[str, Any]
    found: Inspection

    @property
    def heading(self) -> str:
        """Name, format, length, and when it flies."""
        from quadid_report.inspect_tables import heading

        return heading(self.found)

    @property
    def sentences(self) -> list[str]:
        """What the checks found, what is missing, and whether the log can be used."""
        from quadid_report.inspect_tables import sentences

        return [cell.text for cell in sentences(self.found)]

    @property
    def warnings(self) -> list[str]:
        """What the reader had to say, and what to leave out of the log."""
        use = self.result["use"]
        return [*self.found.warnings, *([left_on_ground(use)] if use else [])]

    def tables(self) -> list[TextTable]:
        """Channels, checks, parameters, and what is missing."""
        from quadid_report.inspect_tables import inspect_tables

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
    from quadid.inspection import inspect as inspect_recording

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
        found = replace(found, excitation=_excitation(whole, described, cut, flown))
    use = names_of(cut, flown)
    return Inspected({**found.to_dict(), "use": use, "log": str(cut.path.resolve()), "files": []}, found)


def _excitation(recording: Recording, vehicle: Vehicle, cut: LogPart, flown: Spans) -> tuple[dict[str, Any], ...]:
    """Expected relative standard deviation per parameter, from up to `LONGEST` s of flight; none when refused."""
    from quadid.identify.excitation import excitation
    from quadid.parameters import NOMINAL_UNITS
    from quadid.window import beginning

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
