"""`quadid history`: stored parameter sets: what, when, from which data, who approved."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from quadid.app.logs import load_vehicle
from quadid.cli.options import JsonTarget, shipped_names
from quadid.errors import VehicleError
from quadid.report.tables import Column, TextTable, number


def history(
    vehicle: Annotated[
        str,
        typer.Option(
            "--vehicle",
            metavar="V",
            help="A name in the history (--id of a service, a namespace), a shipped name, or a YAML file.",
            autocompletion=shipped_names,
        ),
    ],
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
    from quadid_node.history import StoreError, default_path, read_history, read_in_force

    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    path, name, described = file or default_path(), vehicle, None
    found = read_history(path, name, candidates, events)
    names = [entry["name"] for entry in found["vehicles"]]
    try:
        described = load_vehicle(vehicle)
    except VehicleError as error:
        if vehicle not in names:
            there = ", ".join(names) or "none"
            raise StoreError(f"{error.found}, and no vehicle of {path}", f"there: {there}") from error
    if described is not None and vehicle not in names:
        name = described.name
        found = read_history(path, name, candidates, events)
    last = read_in_force(path, name, described)
    force = None if last.item is None else {"sequence": last.item.sequence, "doubt": last.doubt}
    result = {
        "schema": "quadid.history/1", "vehicle": name, "history": str(path.absolute()), "in_force": force, **found,
    }  # fmt: skip
    terminal.write_json(result, json)
    show(result, quiet=json == "-")


def show(result: dict[str, Any], quiet: bool) -> None:
    """Prints sets, estimates and events."""
    from quadid.cli import terminal
    from quadid.cli.terminal import print_tables

    console = terminal.console(quiet=quiet)
    if not result["sets"]:
        others = ", ".join(v["name"] for v in result["vehicles"]) or "none"
        console.print(f"no sets of '{result['vehicle']}' yet; vehicles in this history: {others}")
    else:
        story = _story(result["sets"], f"Parameter sets of {result['vehicle']}")
        print_tables(console, [story, _values(result["sets"])])
        for item in result["sets"]:
            old = f"; out of date: {item['outdated']}" if item.get("outdated") else ""
            console.print(f"set {item['sequence']}: {item['reason']}{old}")
        force = result["in_force"]
        if force is not None:
            doubt = f", {force['doubt']}" if force["doubt"] else ""
            console.print(f"last in force: set {force['sequence']}{doubt}")
    for item in result["candidates"]:
        console.print(f"{_when(item['wall'])}  {item['state']:9} {item['check']}: {item['reason']}")
    for item in result["events"]:
        console.print(f"{_when(item['wall'])}  {item['level']:7} {item['kind']}: {item['text']}")


def _story(sets: Sequence[dict[str, Any]], title: str) -> TextTable:
    """When, by whom and from which data."""
    columns = (
        Column("set", right=True), Column("when"), Column("state"), Column("by"), Column("data [s]", right=True),
        Column("error", right=True),
    )  # fmt: skip
    rows = tuple(
        (str(item["sequence"]), _when(item["wall"]), item["state"], item["approved_by"],
         f"{(item['stop'] or 0.0) - (item['start'] or 0.0):.0f}", number(item["mse"], 3))
        for item in sets
    )  # fmt: skip
    return TextTable(title, columns, rows)


def _values(sets: Sequence[dict[str, Any]]) -> TextTable:
    """The parameters of every set, with units."""
    shown = sets[-1]["parameters"][:6]
    columns = (Column("set", right=True), *(Column(f"{p['name']} [{p['unit']}]", right=True) for p in shown))
    rows = []
    for item in sets:
        values = {p["name"]: p["value"] for p in item["parameters"]}
        rows.append((str(item["sequence"]), *(number(values.get(p["name"])) for p in shown)))
    return TextTable("Values", columns, tuple(rows))


def _when(wall: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(wall))
