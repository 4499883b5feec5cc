"""`quadid score`: open-loop prediction error of a vehicle file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.cli import options
from quadid.errors import ParameterError


def score(
    logs: options.Logs,
    vehicle: options.VehicleName,
    horizons: Annotated[
        str, typer.Option("--horizons", metavar="H,H,...", help="Samples after the start of each run.")
    ] = "1,10,50",
    rate: options.OwnRate = None,
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
    wanted = parse_horizons(horizons)
    read = options.reader(load_vehicle(vehicle), rate, start, stop, preset, unchecked, columns)
    done = work.score(read(logs), horizons=wanted, rate=rate)
    terminal.conclude(done, json)


def parse_horizons(text: str) -> list[int]:
    """Reads ``1,10,50``; raises ParameterError for anything but whole numbers."""

    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ParameterError(
            f"--horizons {text}", "whole numbers of samples", "for example --horizons 1,10,50"
        ) from error
