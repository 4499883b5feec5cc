"""`quadid compare`: the swarm beside other optimisers and beside black-box models, on the same flights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.app.logs import GRID, load_vehicle
from quadid.cli import options
from quadid.types import JsonDict


def compare(
    logs: options.Logs,
    vehicle: options.VehicleName,
    validate: options.Validate = None,
    method: Annotated[
        list[str] | None,
        typer.Option("--method", metavar="NAME", help="Only this method; repeatable. Default: all ten."),
    ] = None,
    seeds: Annotated[int, typer.Option("--seeds", metavar="N", min=1, help="Runs of each random method.")] = 3,
    budget: Annotated[
        int, typer.Option("--budget", metavar="N", min=100, help="Simulations of the data that each run may spend.")
    ] = 4000,
    objective: Annotated[
        str,
        typer.Option(
            "--objective",
            metavar="NAME",
            help="What optimisers minimise: shooting (short stretches, initial states estimated) or closed_loop (the "
            "paper's: the whole set under its stabiliser, from references and throttle).",
        ),
    ] = "shooting",
    seed: options.Seed = 1,
    rate: options.Rate = GRID,
    start: options.Start = None,
    stop: options.Stop = None,
    preset: options.Preset = "auto",
    unchecked: options.Unchecked = False,
    columns: options.Columns = None,
    json: options.JsonTarget = None,
    out: options.OutFolder = Path(),
) -> None:
    """Set the initial guess, quasi-Newton, least squares, swarms, evolution, CVA and MOESP side by side."""
    from quadid_evaluation.paper import compare as work

    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    terminal.out_folder(out)
    names = work.check_names(method, objective)
    read = options.reader(load_vehicle(vehicle), rate, start, stop, preset, unchecked, columns)
    train, held = read(logs), read(validate or [])
    with terminal.progress() as advance:
        result = work.compare(
            train, held, methods=names, seeds=range(seed, seed + seeds), budget=budget, objective=objective,
            advance=advance,
        )  # fmt: skip
    terminal.write_json(result, json)
    show(result, quiet=json == "-")
    terminal.warn([text for log in (*train, *held) for text in log.warnings])


def show(result: JsonDict, quiet: bool) -> None:
    """Prints the table for people."""
    from quadid.cli import terminal
    from quadid.report.tables import Column, TextTable, number

    console = terminal.console(quiet)
    columns = (
        Column("method"), *(Column(name, right=True) for name in ("train", *result["validate"])),
        Column("paper's MSE", right=True, rank=1), Column("evaluations", right=True), Column("seconds", right=True),
        Column("failed", right=True), Column("remark", rank=2),
    )  # fmt: skip
    rows = []
    for m in result["methods"]:
        held = m["mse"]["validate"] or [None] * len(result["validate"])
        rows.append((
            m["name"], number(m["mse"]["train"]), *(number(v) for v in held),
            number(None if m["mse_paper"] is None else m["mse_paper"]["train"]), str(m["evaluations"]),
            number(m["seconds"], 3), f"{m['failures']}/{m['runs']}", m.get("note", m.get("stop", "")),
        ))  # fmt: skip
    title = "Methods on the same data (error over 1 s of simulation, 1 = noise floor)"
    terminal.print_tables(console, [TextTable(title, columns, tuple(rows))])
    console.print(
        f"failed: runs that ended above 1.01 times the lowest cost of all; at most {result['budget']} simulations a run"
    )
