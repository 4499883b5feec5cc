"""`quadid score`: open-loop prediction error of a vehicle file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.cli import options


def score(
    logs: options.Logs,
    vehicle: options.VehicleName,
    horizons: Annotated[
        str,
        typer.Option("--horizons", metavar="H,H,...", help="Samples after the start of each run, or times, as 0.1s."),
    ] = "1,10,50",
    rate: options.OwnRate = None,
    closed_loop: Annotated[
        bool,
        typer.Option(
            "--closed-loop", help="Predict bands with the autopilot in the loop: gains of the file, or found."
        ),
    ] = False,
    start: options.Start = None,
    stop: options.Stop = None,
    preset: options.Preset = "auto",
    unchecked: options.Unchecked = False,
    columns: options.Columns = None,
    json: options.JsonTarget = None,
    out: options.OutFolder = Path(),
) -> None:
    """Open-loop prediction error after h samples: every sample starts one run from the measured state."""
    from quadid.app import score as work
    from quadid.app.logs import load_vehicle
    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    read = options.reader(load_vehicle(vehicle), rate, start, stop, preset, unchecked, columns)
    done = work.score(read(logs), horizons=horizons, rate=rate, closed_loop=closed_loop)
    terminal.conclude(done, json)
