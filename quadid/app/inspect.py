"""Inspection: what a log holds, whether it can be true, what it allows, and how to log what is missing."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.app.logs import (
    GRID,
    LONGEST,
    Flight,
    Log,
    file_name,
    gridded,
    left_on_ground,
    parse_part,
    read_log,
    write_text,
)
from quadid.app.options import Described, NamedColumns, Preset, Start, Stop, Typed, vehicle_if
from quadid.app.outcome import Outcome, json_text
from quadid.data.window import beginning
from quadid.errors import QuadidError
from quadid.parameters import NOMINAL_UNITS
from quadid.report.tables import Cell, Column, TextTable, Tone, heads, number
from quadid.report.verdict import parameter_name
from quadid.sanitise import LONGEST_LINE, plain
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.checks import Inspection


@dataclass(frozen=True, repr=False)
class Inspected(Outcome):
    """Contents of a log; `result` has the form ``quadid.inspect/1``."""

    endings = (".inspect.json",)
    rows = "channels"
    result: dict[str, Any]
    found: Inspection

    @property
    def opening(self) -> list[Cell]:
        """Name, format, length, when it flies; then whether the log can be used, with the first reason against it."""
        found = self.found
        flying = ", ".join(_from_to(a, b, found) for a, b in found.flying) or "none found"
        head = f"{_clean(found.name)}: {found.format}, {found.seconds:.1f} s, flying from-to (s): {flying}"
        wrong = [c for c in found.checks if c.verdict == "error"]
        why = f": {_spaced(wrong[0].name)}, {_clean(wrong[0].message)}" if wrong else ""
        usable = Cell("usable for identification", "good")
        return [
            Cell(head, "title"),
            usable if found.usable else Cell(f"not usable for identification as it is{why}", "poor"),
        ]

    @property
    def sentences(self) -> list[Cell]:
        """Findings of the checks and missing channels, a sentence each."""
        out = []
        for check in self.found.checks:
            fix = f". Fix: {_clean(check.fix)}" if check.fix else ""
            out.append(Cell(f"{_spaced(check.name)}: {_clean(check.message)}{fix}", _TONES[check.verdict]))
        missing = self.found.missing
        return out + [
            Cell(f"missing: {m.channel}: {_clean(m.why)}. To get it: {_clean(m.how)}", "fair") for m in missing
        ]

    @property
    def warnings(self) -> list[str]:
        """Remarks of the reader, and what to leave out of the log."""
        use = self.result["use"]
        return [*self.found.warnings, *([left_on_ground(use)] if use else [])]

    def tables(self) -> list[TextTable]:
        """Channels, checks, and parameters."""
        # Verdict of every check; what was found and what to do follow as sentences
        columns = heads("check | verdict")
        rows = tuple((_spaced(c.name), Cell(c.verdict.value, _TONES[c.verdict.value])) for c in self.found.checks)
        return [channel_table(self.found), TextTable("Checks", columns, rows), parameter_outlook_table(self.found)]

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """Writes the inspection as JSON."""
        path = folder / f"{file_name(self.result['log'])}.inspect.json"
        self.result["files"] = [str(path)]
        return [("Written", write_text(path, json_text(self.result)))]


def inspect(
    log: Annotated[Flight, Typed(str, typer.Argument(metavar="LOG"), ...)],
    vehicle: Annotated[Described | None, vehicle_if(": checks motors and excitation too.")] = None,
    *,
    start: Start = None,
    stop: Stop = None,
    preset: Preset = "auto",
    columns: NamedColumns = None,
) -> Inspected:
    """Says what a log holds: channels, rates, gaps, faults, units and frames, excitation, what is missing.

    Every log that can be read is shown, usable or not.

    Args:
        log: a flight log: ROS 2 MCAP, .tlog, DataFlash, ULog or CSV, format auto-detected; or a span of one, as
            ``flight.bin@76:216``.
        vehicle: with it, motors and excitation are checked too; default the one a loaded log has.
        start: first time to look at [s], after the log's first IMU sample.
        stop: last time [s], likewise.
        preset: topic names of ROS logs.
        columns: names in a CSV by names of the contract, beside those of the vehicle file.

    Raises:
        LogError: not readable, or nothing in the span.
        VehicleError: no such vehicle.
    """
    from quadid.checks import Check, CheckResult
    from quadid.checks import inspect as inspect_recording

    if isinstance(log, Log):
        cut, whole, vehicle = log.cut, log.recording, log.vehicle if vehicle is None else vehicle
    else:
        cut = parse_part(str(log), start, stop)
        whole = None
    described = None if vehicle is None else Vehicle.named(vehicle)
    if whole is None:
        whole = read_log(cut.path, preset, described, columns)
    found = replace(inspect_recording(cut.of(whole), described), zero=whole.first_imu_time)
    flown = cut.flown(whole, found.flying)
    if described is not None and found.usable:  # after an error nothing later is asked: it would be as wrong
        from quadid.identification.fit import check_windows
        from quadid.identification.uncertainty import excitation

        # An error with the reason for which `identify` would not fit the log.
        try:
            check_windows(gridded(whole, described, None, cut, flown)[0])
        except QuadidError as error:
            refused = Check("data", CheckResult.ERROR, error.found, error.fix or f"allowed: {error.allowed}")
            found = replace(found, checks=(*found.checks, refused))
        # Expected relative standard deviation per parameter; none where the inspection itself says what is missing.
        with contextlib.suppress(QuadidError):
            shown = excitation(beginning(gridded(whole, described, GRID, cut, flown)[0], LONGEST)[0], described)
            sigmas = zip(shown.names, shown.bound.tolist(), shown.alone.tolist(), strict=True)
            rows = [
                {"name": n, "unit": NOMINAL_UNITS[n], "relative_sigma": bound, "relative_sigma_alone": alone}
                for n, bound, alone in sigmas
            ]
            found = replace(found, excitation=tuple(rows))
    use, found = cut.names(flown), replace(found, warnings=(*found.warnings, *cut.standing(whole, found.flying)))
    return Inspected({**found.to_dict(), "use": use, "log": str(cut.path.resolve()), "files": []}, found)


# --- An inspection as tables for people


_TONES: dict[str, Tone] = {"ok": "good", "warning": "fair", "error": "poor", "unknown": "dim"}


def channel_table(found: Inspection) -> TextTable:
    """One row a channel."""
    columns = heads(
        "channel | rate (Hz) > | samples >4 | from-to (s) >3 | gaps > | longest (s) >5 | dropped >2 | source <1"
    )
    rows = tuple(
        (
            f.name,
            number(f.rate),
            str(f.count),
            _from_to(f.first, f.last, found),
            str(f.gaps),
            f"{f.longest_gap:.3g}" if f.gaps else "",
            str(sum(f.dropped.values()) or ""),
            _clean(f.source),
        )
        for f in found.channels
    )
    return TextTable("Channels", columns, rows)


def parameter_outlook_table(found: Inspection) -> TextTable:
    """Parameters that the log can show, and how sharply, unless a channel is missing or too slow."""
    expected = {str(row["name"]): float(row["relative_sigma"]) for row in found.excitation}
    columns = list(heads("parameter | possible"))
    if expected:
        columns.append(Column("expected 1-sigma", right=True))
    columns.append(Column("why", rank=1))
    rows = []
    for outlook in found.parameters:
        cells = [parameter_name(outlook.parameter), "yes" if outlook.possible else "no"]
        if expected:
            sigma = expected.get(outlook.parameter, float("nan"))
            excited = f"{100.0 * sigma:.2g} %" if sigma < 10.0 else "not excited"
            cells.append(excited if outlook.possible else "")
        rows.append((*cells, _clean(outlook.reason)))
    wrong = any(c.verdict.value == "error" for c in found.checks)
    title = "What these channels show once the error is mended" if wrong else "What can be identified"
    return TextTable(title, tuple(columns), tuple(rows))


def _from_to(first: float, last: float, found: Inspection) -> str:
    """In the time of ``LOG@from:to``; a channel may begin before the IMU."""
    return f"{first - found.zero:z.1f}-{last - found.zero:z.1f}"


def _spaced(name: str) -> str:
    return name.replace("_", " ")


def _clean(text: str) -> str:
    return plain(text, LONGEST_LINE)
