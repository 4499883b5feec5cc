"""`quadid serve`, `worker` and `watch`: the online service on a MAVLink link, its fits elsewhere, and a view of all."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.app import options
from quadid.app.options import JsonTarget
from quadid.errors import QuadidError
from quadid.sanitise import plain

if TYPE_CHECKING:
    from quadid_node.mavlink_link import MavlinkLink
    from quadid_node.messages import Output, ServiceHealth
    from quadid_node.service import Service
    from quadid_node.zenoh import FleetView
    from rich.console import Console
    from rich.table import Table

SAY_EVERY = 10.0
"""Time between two lines about how things are [s]."""


def serve(
    vehicle: options.VehicleName,
    mavlink: Annotated[str, typer.Option(metavar="URL")],
    system: Annotated[int, typer.Option(metavar="N")] = 0,
    key: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    zenoh: Annotated[str | None, typer.Option(metavar="WHERE")] = None,
    ground: Annotated[str | None, typer.Option("--worker", metavar="WHERE")] = None,
    name: Annotated[str, typer.Option("--id", metavar="NAME")] = "",
    approval: options.Approval = "auto",
    window: options.WindowSeconds = 10.0,
    refit: options.Refit = 1.0,
    diagnose: options.Diagnose = 60.0,
    gate: options.Gate = "",
    file: Annotated[Path | None, typer.Option("--history", metavar="FILE")] = None,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="End after this long; 0: never.")] = 0.0,
    seed: options.Seed = 0,
    json: options.JsonTarget = None,
) -> None:
    """Identify a flying vehicle over MAVLink; publish parameters, findings and health as component 191.

    Args:
        mavlink: link: udpin:0.0.0.0:14540, tcp:HOST:PORT, /dev/ttyACM0,921600.
        system: system id of the vehicle; 0: the first autopilot heard.
        key: signing key: unsigned frames are then refused.
        zenoh: publish on Zenoh too: a locator, a config file, or 'local'.
        ground: let a 'quadid worker' fit that is found there on Zenoh.
        name: name of this vehicle; default the vehicle's.
        file: history file; default QUADID_HISTORY, else the user's.
    """
    from quadid_node.process import StopSignal

    stop = StopSignal()
    from quadid_node.history import Store, default_path
    from quadid_node.mavlink_link import MavlinkLink, Outlet, run
    from quadid_node.mavlink_wire import memory_path, read_key
    from quadid_node.service import Service, session_settings
    from quadid_node.zenoh import ZenohLink, fit_worker

    from quadid.cli import terminal
    from quadid.vehicle import Vehicle

    terminal.check_file(json, "--json")
    described = Vehicle.named(vehicle)
    settings = session_settings(
        approval, options.gate_settings(gate), window=window, refit=refit, diagnose=diagnose, seed=seed
    )
    known = name or described.name
    end = time.monotonic() + seconds if seconds > 0.0 else float("inf")
    with ExitStack() as opened:
        # First the store: who is refused there must not have taken the port.
        store = opened.enter_context(closing(Store(file or default_path(), known)))
        secret = read_key(key) if key is not None else None
        kept = memory_path((file or default_path()).parent, secret) if secret is not None else None
        link = opened.enter_context(closing(MavlinkLink(mavlink, len(described.rotors), system, secret, memory=kept)))
        worker = opened.enter_context(closing(fit_worker(described, known, ground or "")))
        service = opened.enter_context(closing(Service(described, settings, worker, store)))
        outlets: list[Outlet] = [_Console(terminal.console(quiet=json == "-"), link)]
        if zenoh is not None:
            outlets.append(opened.enter_context(closing(ZenohLink(zenoh, known, service))))
        opened.callback(stop.ignore_more)
        run(service, link, outlets, lambda: stop() or time.monotonic() > end)
        result = summary(service, link, known)
    terminal.write_json(result, json)


class _Console:
    """Tells a person what happens."""

    def __init__(self, console: Console, link: MavlinkLink) -> None:
        self._console, self._link, self._said, self._ready = console, link, -1e9, False

    def publish(self, item: Output) -> None:
        """A line for each event and finding."""
        if item.topic == "event":
            self._console.print(f"{item.level:7} {item.text}", soft_wrap=True)

    def report(self, health: ServiceHealth) -> None:
        """A line when fits can begin, and one now and then about how things are."""
        if not self._ready and health.worker in ("idle", "busy"):
            self._ready = True
            self._console.print("ready: the fit process is warm")
        if time.monotonic() - self._said < SAY_EVERY:
            return
        self._said = time.monotonic()
        traffic = self._link.traffic()
        status, late = health.status, f"signed with our key, but {traffic.behind:.0f} s behind this clock"
        told = [
            f"{status.phase.value}: {status.reason}",
            "Hz: " + (", ".join(f"{n} {r:.0f}" for n, r in sorted(traffic.rates.items()) if r > 0.5) or "nothing"),
            f"refused by the autopilot: {', '.join(traffic.denied)}" * bool(traffic.denied),
            f"{traffic.refused} frames refused" * bool(traffic.refused),
            f"{late}: set the time of the vehicle" * bool(traffic.behind),
            *traffic.problems,
            f"{status.backlog:.1f} s behind the data, {status.skipped} fits left out" * (status.backlog > 1.0),
            f"fit process {health.worker}",
        ]
        self._console.print(" | ".join(filter(None, told)), soft_wrap=True)

    def attend(self) -> None:
        """Nothing is asked through a terminal."""


def summary(service: Service, link: MavlinkLink, name: str) -> dict[str, Any]:
    """End of the service, of the form ``quadid.serve/1``."""
    from quadid_node.messages import set_to_dict, status_to_dict

    health, traffic = service.health(), link.traffic()
    force = service.published
    return {
        "schema": "quadid.serve/1",
        "vehicle": name,
        "system": link.vehicle_system,
        "in_force": set_to_dict(force) if force is not None else None,
        "status": status_to_dict(health.status),
        "rates": traffic.rates,
        "denied": list(traffic.denied),
        "problems": list(traffic.problems),
        "refused": traffic.refused,
        "behind": traffic.behind,
        "dropped": traffic.dropped,
        "worker_restarts": health.restarts,
        "history": health.history,
    }


# --- `quadid worker`: fits on this machine for services elsewhere, over Zenoh


def worker(
    connect: Annotated[str, typer.Option(metavar="WHERE")],
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="End after this long; 0: never.")] = 0.0,
    json: JsonTarget = None,
) -> None:
    """Fit windows on this machine for vehicles' services; they fit on board whenever this one is gone.

    Args:
        connect: a locator (tcp/host:7447), a config file, or 'local'.
    """
    from quadid_node.process import StopSignal

    stop = StopSignal()
    from quadid_node.zenoh import work

    from quadid.cli import terminal
    from quadid.online.fit_job import warm_up
    from quadid.vehicle import Vehicle

    terminal.check_file(json, "--json")
    console = terminal.console(quiet=json == "-")
    end = time.monotonic() + seconds if seconds > 0.0 else float("inf")
    warm_up(Vehicle.shipped("pelican"))
    done = work(
        connect, lambda: stop() or time.monotonic() > end, lambda text: console.print(plain(text), soft_wrap=True)
    )
    stop.ignore_more()
    result = {"schema": "quadid.worker/1", "answered": done.answered, "refused": done.refused, "seconds": done.seconds}
    console.print(f"{done.answered} requests answered, {done.refused} refused")
    terminal.write_json(result, json)


# --- `quadid watch`: a live terminal view of one or many vehicles over Zenoh


REFRESH = 0.5
SETTLE = 1.0
"""Time that a snapshot waits for answers [s]."""
_LONGEST = 160


class WatchError(QuadidError):
    """A command that a vehicle did not carry out."""

    exit_code = 3


def watch(
    zenoh: Annotated[str, typer.Option(metavar="WHERE")] = "local",
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="End after this long; 0: never.")] = 0.0,
    approve: Annotated[str, typer.Option(metavar="VEHICLE[=N]")] = "",
    rollback: Annotated[str, typer.Option(metavar="VEHICLE")] = "",
    json: JsonTarget = None,
) -> None:
    """Show parameters with intervals, gate state and reason, findings and data rates of all vehicles, live.

    Args:
        zenoh: a locator (tcp/host:7447), a config file, or 'local'.
        approve: approve set N, or the newest that waits, and end.
        rollback: take the vehicle's set in force back to the previous one, and end.
    """
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
            from rich.live import Live

            end = time.monotonic() + seconds if seconds > 0.0 else float("inf")
            with Live(table(snapshot(fleet)), console=terminal.console(), auto_refresh=False) as live:
                while time.monotonic() < end:
                    time.sleep(REFRESH)
                    live.update(table(snapshot(fleet)), refresh=True)
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
        state = f"{_plain(status.get('phase', 'unknown'))}: {_plain(status.get('reason', ''))}"
        held = [_plain(f"{force.get('sequence', '-')} {force.get('state', '')}")]
        for label, key in (("reference", "reference"), ("out of date", "outdated")):
            held += [f"{label}: {_plain(force[key])}"] if force.get(key) else []
        values = []
        for p in _listing(force.get("parameters"))[:12]:
            value, sigma = p.get("value"), p.get("sigma")
            if isinstance(value, int | float) and isinstance(sigma, int | float) and value:
                values.append(f"{_plain(p.get('name'))} {value:.4g} +-{196.0 * sigma / abs(value):.1f} %")
        causes = []
        for finding in _listing(kinds.get("diagnosis", {}).get("findings"))[:5]:
            sure = "" if finding.get("confident") else " (?)"
            causes.append(f"{_plain(finding.get('effect'))}{sure}: {_plain(finding.get('evidence'))}")
        rates = []
        for feed, about in list(_mapping(health.get("feeds")).items())[:12]:
            if isinstance(rate := _mapping(about).get("rate"), int | float):
                rates.append(f"{_plain(feed)} {rate:.0f} Hz")
        out.add_row(
            Text(_plain(name), style="green" if kinds["alive"] else "red"),
            Text(state if kinds["alive"] else "gone"),
            *(Text("\n".join(lines)) for lines in (held, values, causes, rates)),
        )
    return out


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _listing(value: Any) -> list[Mapping[str, Any]]:
    return [item for item in value if isinstance(item, Mapping)] if isinstance(value, list) else []


def _plain(value: Any) -> str:
    """Text from elsewhere, without anything a terminal would act on."""
    return plain(str(value), _LONGEST)
