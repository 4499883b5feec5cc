"""`quadid fleet`: many logs, with the report beside the results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.app import fleet as app
from quadid.app.logs import GRID, parse_columns
from quadid.app.options import Columns, JsonTarget, OutFolder, Rate, Seed
from quadid.cli import terminal


def fleet(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of logs, formats auto-detected; one vehicle a folder.")
    ],
    vehicle: Annotated[
        str | None,
        typer.Option(
            "--vehicle", metavar="V", help="Shipped name or YAML file for folders without a vehicle.yaml of their own."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDR", help="A Dask scheduler (tcp://…); default: own workers."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", metavar="N", min=1, help="Own workers; default one a core.")
    ] = None,
    memory: Annotated[
        str, typer.Option("--memory", metavar="SIZE", help="Memory that one own worker may take.")
    ] = "2GiB",
    diagnose: Annotated[
        bool, typer.Option("--diagnose", help="Also name what the simulation gets wrong (slower).")
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Identify all logs again, including those already done.")
    ] = False,
    rate: Rate = GRID,
    seed: Seed = 1,
    columns: Columns = None,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Identify every log of a folder on Dask; write SQLite, Parquet and a report. Run it again and it goes on."""
    terminal.check_file(json, "--json")
    target = terminal.out_folder(out)
    named = parse_columns(columns or [])
    if named and vehicle is None:
        raise typer.BadParameter(
            "vehicles in the folder name their own: give it with --vehicle", param_hint="--columns"
        )
    with terminal.progress() as advance:
        done = app.fleet(
            folder, target, vehicle, scheduler=scheduler, workers=workers, memory=memory, diagnose=diagnose,
            again=again, rate=rate, seed=seed, columns=named, advance=advance,
        )  # fmt: skip
    terminal.conclude(done, json, target / "fleet.html", target)
