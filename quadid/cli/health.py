"""`quadid health`: what changed in the vehicle since the baseline flights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.cli.explaining import explained
from quadid.cli.options import JsonTarget, Logs, OutFolder, Preset, ReportFile, Unchecked, VehicleName

Baseline = Annotated[
    list[str], typer.Option("--baseline", metavar="LOG", help="A healthy flight of this vehicle; repeatable.")
]


def health(
    logs: Logs,
    baseline: Baseline,
    vehicle: VehicleName,
    report: ReportFile = None,
    preset: Preset = "auto",
    unchecked: Unchecked = False,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """What changed since the baseline flights: which rotor, mass, centre of gravity, thrust, how much, how sure."""
    from quadid.app import health as work
    from quadid.app.logs import load_vehicle
    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    terminal.check_file(report, "--report")
    terminal.out_folder(out)
    described = load_vehicle(vehicle)
    with explained(report, f"Health of {described.name}", [*logs, *baseline], described, preset):
        done = work.health(logs, baseline, vehicle=described, preset=preset, unchecked=unchecked)
    terminal.conclude(done, json, report)
