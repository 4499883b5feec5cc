"""`quadid watch`: a live terminal view of one or many vehicles over Zenoh."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.app.options import JsonTarget
from quadid.errors import QuadidError
from quadid.sanitise import plain

if TYPE_CHECKING:
    from quadid_node.zenoh import FleetView
    from rich.table import Table

REFRESH = 0.5
SETTLE = 1.0
"""Time that a snapshot waits for answers [s]."""
_LONGEST = 160


class WatchError(QuadidError):
    """A command that a vehicle did not carry out."""

    exit_code = 3


def watch(
    zenoh: Annotated[
        str, typer.Option("--zenoh", metavar="WHERE", help="A locator (tcp/host:7447), a config file, or 'local'.")
    ] = "local",
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="End after this long; 0: never.")] = 0.0,
    approve: Annotated[
        str, typer.Option("--approve", metavar="VEHICLE[=N]", help="Approve set N, or the newest that waits, and end.")
    ] = "",
    rollback: Annotated[
        str,
        typer.Option(
            "--rollback", metavar="VEHICLE", help="Take the vehicle's set in force back to the previous one, and end."
        ),
    ] = "",
    json: JsonTarget = None,
) -> None:
    """Show parameters with intervals, gate state and reason, findings and data rates of all vehicles, live."""
    from quadid_node.zenoh import FleetView

    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    fleet = FleetView(zenoh)
    try:
        for vehicle, name in ((approve, "approve"), (rollback, "rollback")):
            if vehicle:
                done = _command(fleet, vehicle, name)
                if json != "-":
                    typer.echo(f"{vehicle}: {done['text']}")
                terminal.write_json(done, json)
        if approve or rollback:
            return
        if json is not None:
            time.sleep(max(seconds, SETTLE))
            terminal.write_json(snapshot(fleet), json)
            return
        with contextlib.suppress(KeyboardInterrupt):
            _live(fleet, seconds, terminal.console())
    finally:
        fleet.close()


def _command(fleet: FleetView, vehicle: str, name: str) -> dict[str, Any]:
    """Answer of the vehicle to a command that it carried out, of the form ``quadid.command/1``."""
    sequence = None
    if name == "approve" and (numbered := re.fullmatch(r"(.+)=([0-9]{1,18})", vehicle)):
        vehicle, sequence = numbered[1], int(numbered[2])
    if name == "approve" and sequence is None:
        end = time.monotonic() + SETTLE
        while not (sequence := fleet.waiting(vehicle)) and time.monotonic() < end:
            time.sleep(0.05)
    done, text = fleet.command(vehicle, name, sequence)
    if not done:
        raise WatchError(f"{vehicle}: {name} was not done: {text}")
    return {"schema": "quadid.command/1", "vehicle": vehicle, "command": name, "text": plain(text)}


def _live(fleet: FleetView, seconds: float, console: Any) -> None:
    from rich.live import Live

    end = time.monotonic() + seconds if seconds > 0.0 else float("inf")
    with Live(table(snapshot(fleet)), console=console, auto_refresh=False) as live:
        while time.monotonic() < end:
            time.sleep(REFRESH)
            live.update(table(snapshot(fleet)), refresh=True)


def snapshot(fleet: FleetView) -> dict[str, Any]:
    """State of all vehicles now, of the form ``quadid.watch/1``."""
    names = sorted({*fleet.latest, *fleet.alive})
    return {
        "schema": "quadid.watch/1",
        "vehicles": {n: {"alive": fleet.alive.get(n, False), **fleet.latest.get(n, {})} for n in names},
        "refused": fleet.refused,
    }


def table(found: Mapping[str, Any]) -> Table:
    """One row a vehicle."""
    from rich.table import Table
    from rich.text import Text

    count = len(found["vehicles"])
    out = Table(title=f"{count} vehicle{'s' * (count != 1)}", show_lines=True)
    for heading in ("vehicle", "state", "set", "parameters", "finding", "data"):
        out.add_column(heading, overflow="fold")
    for name, kinds in found["vehicles"].items():
        health, force = kinds.get("health", {}), kinds.get("parameters", {})
        status = _mapping(health.get("status"))
        color = "green" if kinds["alive"] else "red"
        state = f"{_plain(status.get('phase', 'unknown'))}: {_plain(status.get('reason', ''))}"
        notes = f"\nreference: {_plain(force['reference'])}" if force.get("reference") else ""
        notes += f"\nout of date: {_plain(force['outdated'])}" if force.get("outdated") else ""
        diagnosis = kinds.get("diagnosis", {})
        lines = []
        for finding in _listing(diagnosis.get("findings"))[:5]:
            sure = "" if finding.get("confident") else " (?)"
            lines.append(f"{_plain(finding.get('effect'))}{sure}: {_plain(finding.get('evidence'))}")
        out.add_row(
            Text(_plain(name), style=color),
            Text(state if kinds["alive"] else "gone"),
            Text(_plain(f"{force.get('sequence', '-')} {force.get('state', '')}") + notes),
            Text(_parameters(force)),
            Text("\n".join(lines)),
            Text(_feeds(health)),
        )
    return out


def _parameters(force: Mapping[str, Any]) -> str:
    lines = []
    for p in _listing(force.get("parameters"))[:12]:
        value, sigma = p.get("value"), p.get("sigma")
        if isinstance(value, int | float) and isinstance(sigma, int | float) and value:
            lines.append(f"{_plain(p.get('name'))} {value:.4g} +-{196.0 * sigma / abs(value):.1f} %")
    return "\n".join(lines)


def _feeds(health: Mapping[str, Any]) -> str:
    lines = []
    for name, feed in list(_mapping(health.get("feeds")).items())[:12]:
        rate = _mapping(feed).get("rate")
        if isinstance(rate, int | float):
            lines.append(f"{_plain(name)} {rate:.0f} Hz")
    return "\n".join(lines)


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _listing(value: Any) -> list[Mapping[str, Any]]:
    return [item for item in value if isinstance(item, Mapping)] if isinstance(value, list) else []


def _plain(value: Any) -> str:
    """Text from elsewhere, without anything a terminal would act on."""
    return plain(str(value), _LONGEST)
