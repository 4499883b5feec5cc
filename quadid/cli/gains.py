"""`quadid gains`: rate and attitude gains from the identified vehicle."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.app.gains import PHASE_MARGIN
from quadid.app.gains import gains as proposed
from quadid.cli.options import JsonTarget, ReportFile, VehicleName
from quadid.report.autopilots import AUTOPILOTS


def gains(
    vehicle: VehicleName,
    form: Annotated[str, typer.Option("--format", metavar="F", help=f"{', '.join(AUTOPILOTS)}.")] = "px4",
    bandwidth: Annotated[
        float | None,
        typer.Option("--bandwidth", metavar="HZ", help="Of roll and pitch rate; default the largest possible."),
    ] = None,
    phase_margin: Annotated[
        float, typer.Option("--phase-margin", metavar="DEG", help="Least one of the rate loops, over the intervals.")
    ] = PHASE_MARGIN,
    derivative: Annotated[bool, typer.Option("--derivative/--no-derivative", help="Use the D term.")] = True,
    motor_lag: Annotated[
        float | None, typer.Option("--motor-lag", metavar="S", help="Where the vehicle file has none.")
    ] = None,
    delay: Annotated[
        float | None, typer.Option("--delay", metavar="S", help="From command to rotor, where the file has none.")
    ] = None,
    current: Annotated[
        Path | None,
        typer.Option("--from", metavar="LOG|PARAMS", help="Filters, loop rate and present gains of the autopilot."),
    ] = None,
    anyway: Annotated[bool, typer.Option("--anyway", help="Take guesses and unproven values, too.")] = False,
    report: ReportFile = None,
    json: JsonTarget = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write the proposed parameters as a file into it.")
    ] = None,
) -> None:
    """Propose rate and attitude gains, with margins over the intervals; nothing is sent to a vehicle."""
    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    terminal.check_file(report, "--report")
    done = proposed(
        vehicle, form, bandwidth=bandwidth, phase_margin=phase_margin, derivative=derivative, motor_lag=motor_lag,
        delay=delay, current=current, anyway=anyway,
    )  # fmt: skip
    done.result["file"] = None if out is None else str(done.save(terminal.out_folder(out)))
    terminal.conclude(done, json, report)
