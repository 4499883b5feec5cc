"""`quadid init`: a vehicle file to fill in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.cli.options import JsonTarget, OutFolder, Preset


def init(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the vehicle, and of its file.")],
    log: Annotated[
        str | None,
        typer.Option("--from", metavar="LOG", help="Take geometry, frame, motor order and limits from this log."),
    ] = None,
    mass: Annotated[float | None, typer.Option("--mass", metavar="KG", min=0.001, help="Mass as it flies.")] = None,
    arm: Annotated[
        float | None, typer.Option("--arm", metavar="M", min=0.001, help="Distance of the rotors from the centre.")
    ] = None,
    preset: Preset = "auto",
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Write a vehicle file to fill in; with a log, filled with what the autopilot's logged parameters describe."""
    from quadid.app import init as work
    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    done = work.init(name, log, mass=mass, arm=arm, preset=preset)
    path = done.save(terminal.out_folder(out) / f"{terminal.file_name(name)}.yaml")
    done.result["file"] = str(path)
    terminal.write_json(done.result, json)
    console = terminal.console(quiet=json == "-")
    console.print(f"Written: {path}", soft_wrap=True)
    if done.result["fill_in"]:
        blanks = ", ".join(done.result["fill_in"])
        console.print(f"To fill in: {blanks} (then delete the words FILL IN)", soft_wrap=True)
    console.print(f"Next: quadid inspect LOG --vehicle {path.name}", soft_wrap=True)
