"""`quadid history`: stored parameter sets: what, when, from which data, who approved."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from quadid_cli.options import JsonTarget, VehicleName


def history(
    vehicle: VehicleName,
    file: Annotated[
        Path | None,
        typer.Option("--history", metavar="FILE", help="History file; default QUADID_HISTORY, else the user's own."),
    ] = None,
    candidates: Annotated[
        int, typer.Option("--candidates", metavar="N", min=0, help="Also the newest N estimates, accepted or not.")
    ] = 0,
    events: Annotated[int, typer.Option("--events", metavar="N", min=0, help="Also the newest N events.")] = 0,
    json: JsonTarget = None,
) -> None:
    """Show the stored parameter sets of a vehicle: what, when, from which data, who approved."""
    from quadid_node.store import default_path, read_history

    from quadid_cli import output
    from quadid_cli.loading import load_vehicle

    output.check_file(json, "--json")
    name = load_vehicle(vehicle).name
    path = file or default_path()
    found = read_history(path, name, candidates, events)
    result = {"schema": "quadid.history/1", "vehicle": name, "history": str(path.absolute()), **found}
    output.write_json(result, json)
    show(result, quiet=json == "-")


def show(result: dict[str, Any], quiet: bool) -> None:
    """Prints sets, estimates and events."""
    from rich.table import Table
    from rich.text import Text

    from quadid_cli import terminal

    console = terminal.console(quiet=quiet)
    if not result["sets"]:
        others = ", ".join(v["name"] for v in result["vehicles"]) or "none"
        console.print(f"no sets of '{result['vehicle']}' yet; vehicles in this history: {others}", markup=False)
    else:
        table = Table(title=f"Parameter sets of {result['vehicle']}")
        for heading in ("set", "when", "state", "by", "data", "error", "b", "d", "J_xx", "J_yy", "J_zz", "J_r", "why"):
            table.add_column(heading, overflow="fold")
        for item in result["sets"]:
            values = {p["name"]: p["value"] for p in item["parameters"]}
            span = (item["stop"] or 0.0) - (item["start"] or 0.0)
            table.add_row(
                str(item["sequence"]), _when(item["wall"]), item["state"], Text(item["approved_by"]), f"{span:.0f} s",
                f"{item['mse'] or float('nan'):.2f}", *(f"{values[n]:.4g}" for n in list(values)[:6]),
                Text(item["reason"]),
            )  # fmt: skip
        console.print(table)
    for item in result["candidates"]:
        console.print(f"{_when(item['wall'])}  {item['state']:9} {item['check']}: {item['reason']}", markup=False)
    for item in result["events"]:
        console.print(f"{_when(item['wall'])}  {item['level']:7} {item['kind']}: {item['text']}", markup=False)


def _when(wall: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(wall))
