"""`quadid identify`: fits the parameters of a vehicle to flight logs, and scores the fit on them and on others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.app import identify as work
from quadid.app.identify import OPTIMIZERS, Identified, check_optimizer
from quadid.app.logs import GRID, OutputError, file_name, load_vehicle
from quadid.cli import options
from quadid.cli.explaining import explained
from quadid.vehicle import Vehicle


def identify(
    logs: options.Logs,
    vehicle: options.VehicleName,
    validate: options.Validate = None,
    optimizer: Annotated[
        str, typer.Option("--optimizer", metavar="NAME", help="How to search: " + ", ".join(OPTIMIZERS) + ".")
    ] = OPTIMIZERS[0],
    seed: options.Seed = 1,
    report: options.ReportFile = None,
    series: options.SeriesFolder = None,
    rate: options.Rate = GRID,
    start: options.Start = None,
    stop: options.Stop = None,
    preset: options.Preset = "auto",
    unchecked: options.Unchecked = False,
    columns: options.Columns = None,
    json: options.JsonTarget = None,
    out: options.OutFolder = Path(),
) -> None:
    """Fit b, d, J_xx, J_yy, J_zz and J_r to flight logs; say how well each is known and how well they predict."""
    from quadid.cli import terminal

    check_optimizer(optimizer)
    terminal.check_file(json, "--json")
    terminal.check_file(report, "--report")
    if series is not None:
        terminal.out_folder(series)
    described = load_vehicle(vehicle)
    read = options.reader(described, rate, start, stop, preset, unchecked, columns)
    target = fitted_path(terminal.out_folder(out), described, vehicle)

    def conclude(done: Identified) -> None:
        terminal.conclude(done, json, report, {"vehicle": target}, series)

    with explained(report, f"Identification of {described.name}", [*logs, *(validate or [])], described, preset):
        train, held = read(logs), read(validate or [])
        try:
            with terminal.progress() as advance:
                done = work.identify(train, held, optimizer=optimizer, seed=seed, advance=advance)
        except work.UnansweredError as error:
            conclude(error.outcome)
            raise
    conclude(done)


def fitted_path(folder: Path, vehicle: Vehicle, given: str) -> Path:
    """Where the fitted vehicle file goes; raises OutputError when that would overwrite the file it was made from."""

    path = folder / f"{file_name(vehicle.name)}.fitted.yaml"
    if path.exists() and Path(given).exists() and path.samefile(given):
        raise OutputError(f"the result would overwrite {given}", "another folder", "use --out, or rename the vehicle")
    return path
