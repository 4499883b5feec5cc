"""`quadid export`: the parameters of a vehicle file for another program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid_cli.options import JsonTarget, OutFolder, VehicleName


def export(
    vehicle: VehicleName,
    form: Annotated[
        str, typer.Option("--format", metavar="F", help="yaml, px4, ardupilot, gazebo, rotorpy or agilicious.")
    ] = "yaml",
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Write the parameters for another program, with units and where each came from; nothing is sent to a vehicle."""
    from quadid.report.programs import export as written_as
    from quadid_cli import loading, output, terminal
    from quadid_cli.identify import file_name

    output.check_file(json, "--json")
    described = loading.load_vehicle(vehicle)
    texts = written_as(described, form, Path(vehicle).name)
    folder = output.out_folder(out)
    targets = {folder / f"{file_name(described.name)}{ending}": text for ending, text in texts.items()}
    for path in targets:
        if path.exists() and Path(vehicle).exists() and path.samefile(vehicle):
            raise output.OutputError(f"the export would overwrite {vehicle}", "another folder", "give --out")
    files = [str(output.write_text(path, text)) for path, text in targets.items()]
    guessed = [n for n, p in described.parameters.items() if p.sigma is None]
    warnings = [f"not from data but the guess of the vehicle file: {', '.join(guessed)}"] if guessed else []
    result = {
        "schema": "quadid.export/1", "vehicle": described.name, "format": form, "files": files, "warnings": warnings,
    }  # fmt: skip
    output.write_json(result, json)
    console = terminal.console(quiet=json == "-")
    for file in files:
        console.print(f"Written: {file}", soft_wrap=True)
    terminal.warn(warnings)
