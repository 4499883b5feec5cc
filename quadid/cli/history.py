"""`quadid history`: stored parameter sets: what, when, from which data, who approved."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from quadid.app.options import shipped_names
from quadid.app.outcome import Outcome
from quadid.chi_square import Z95
from quadid.errors import VehicleError
from quadid.report.tables import Cell, Column, TextTable, heads, number
from quadid.vehicle import Vehicle


def history(
    vehicle: Annotated[str, typer.Option(metavar="V", autocompletion=shipped_names)],
    file: Annotated[Path | None, typer.Option("--history", metavar="FILE")] = None,
    candidates: Annotated[int, typer.Option(metavar="N", min=0)] = 0,
    events: Annotated[int, typer.Option("--events", metavar="N", min=0, help="Also the newest N events.")] = 0,
) -> Stored:
    """Show the stored parameter sets of a vehicle: what, when, from which data, who approved.

    Args:
        vehicle: a name in the history (--id of a service, a namespace), a shipped name, or a YAML file.
        file: history file; default QUADID_HISTORY, else the user's own.
        candidates: also the newest N estimates, accepted or not.
    """
    from quadid_node.history import StoreError, default_path, read_history, read_in_force

    path, name, described = file or default_path(), vehicle, None
    found = read_history(path, name, candidates, events)
    names = [entry["name"] for entry in found["vehicles"]]
    try:
        described = Vehicle.named(vehicle)
    except VehicleError as error:
        if vehicle not in names:
            there = ", ".join(names) or "none"
            raise StoreError(
                f"{error.found}, and no vehicle in {path}", f"a vehicle file, or a name in that history: {there}"
            ) from error
    if described is not None and vehicle not in names:
        name = described.name
        found = read_history(path, name, candidates, events)
    last = read_in_force(path, name, described)
    force = None if last.item is None else {"sequence": last.item.sequence, "doubt": last.doubt}
    told = {"schema": "quadid.history/1", "vehicle": name, "history": str(path.absolute()), "in_force": force}
    return Stored({**told, **found})


@dataclass(frozen=True, repr=False)
class Stored(Outcome):
    """Sets, estimates and events of a vehicle; `result` has the form ``quadid.history/1``."""

    result: dict[str, Any]

    def tables(self) -> list[TextTable]:
        """Time, author and data of the set; then the values."""
        sets = self.result["sets"]
        if not sets:
            return []
        told, values = list[tuple[str, ...]](), list[tuple[str, ...]]()
        shown = sets[-1]["parameters"][:6]
        for item in sets:
            seconds = f"{(item['stop'] or 0.0) - (item['start'] or 0.0):.0f}"
            rests_on = f"{item['reference']}, +-{Z95 * item['reference_sd']:.0%}"
            made = (_when(item["wall"]), item["state"], item["approved_by"], seconds, number(item["mse"], 3), rests_on)
            told.append((str(item["sequence"]), *made))
            found = {p["name"]: p["value"] for p in item["parameters"]}
            values.append((str(item["sequence"]), *(number(found.get(p["name"])) for p in shown)))
        columns = heads("set > | when | state | by | data [s] > | error > | rests on")
        each = (Column("set", right=True), *(Column(f"{p['name']} [{p['unit']}]", right=True) for p in shown))
        title = f"Parameter sets of {self.result['vehicle']}"
        return [TextTable(title, columns, tuple(told)), TextTable("Values", each, tuple(values))]

    @property
    def sentences(self) -> list[Cell]:
        """Reasons of sets, which one was in force last, estimates and events."""
        sets, force = self.result["sets"], self.result["in_force"]
        old = [f"; out of date: {item['outdated']}" if item.get("outdated") else "" for item in sets]
        told = [f"set {item['sequence']}: {item['reason']}{late}" for item, late in zip(sets, old, strict=True)]
        if not sets:
            others = ", ".join(v["name"] for v in self.result["vehicles"]) or "none"
            told = [f"no sets of '{self.result['vehicle']}' yet; vehicles in this history: {others}"]
        elif force is not None:
            told.append(f"last in force: set {force['sequence']}{', ' * bool(force['doubt'])}{force['doubt']}")
        for item in self.result["candidates"]:
            told.append(f"{_when(item['wall'])}  {item['state']:9} {item['check']}: {item['reason']}")
        for item in self.result["events"]:
            told.append(f"{_when(item['wall'])}  {item['level']:7} {item['kind']}: {item['text']}")
        return [Cell(text) for text in told]


def _when(wall: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(wall))
