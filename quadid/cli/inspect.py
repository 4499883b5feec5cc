"""`quadid inspect`: what a log holds, whether it can be true, what it allows, and how to log what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from quadid.app.logs import parse_columns, write_text
from quadid.cli.options import Columns, JsonTarget, Preset, Start, Stop
from quadid.report.tables import Cell, heading, sentences, usability
from quadid.sanitise import LONGEST_LINE, plain

if TYPE_CHECKING:
    from quadid.app.inspect import Inspected


def inspect(
    log: Annotated[
        str,
        typer.Argument(
            metavar="LOG",
            help="A flight log: ROS 2 MCAP, .tlog, DataFlash, ULog, CSV, format auto-detected. LOG@76:216: a span.",
        ),
    ],
    vehicle: Annotated[
        str | None,
        typer.Option("--vehicle", metavar="V", help="A shipped name or a YAML file: checks motors and excitation too."),
    ] = None,
    json: JsonTarget = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Also write the inspection as JSON into this folder.")
    ] = None,
    start: Start = None,
    stop: Stop = None,
    preset: Preset = "auto",
    columns: Columns = None,
) -> None:
    """What a log holds: channels, rates, gaps, faults, units and frames, excitation, what is missing."""
    from quadid.app.inspect import inspect as inspected
    from quadid.app.outcome import json_text
    from quadid.cli.terminal import check_file, out_folder, write_json

    check_file(json, "--json")
    folder = None if out is None else out_folder(out)
    done = inspected(log, vehicle, start=start, stop=stop, preset=preset, columns=parse_columns(columns or []))
    if folder is not None:
        target = folder / f"{Path(done.result['log']).name}.inspect.json"
        done.result["files"] = [str(target)]
        write_text(target, json_text(done.result))
    write_json(done.result, json)
    show(done, quiet=json == "-")


def show(done: Inspected, quiet: bool) -> None:
    """Prints whether the log can be used, the tables, then what the checks found and what is missing."""
    from quadid.cli import terminal

    console = terminal.console(quiet)
    terminal.print_cell(console, Cell(heading(done.found), "title"))
    terminal.print_cell(console, usability(done.found))
    for warning in done.warnings:
        terminal.print_cell(console, Cell(f"note: {plain(warning, LONGEST_LINE)}", "fair"))
    terminal.print_tables(console, done.tables())
    for sentence in sentences(done.found):
        terminal.print_cell(console, sentence)
