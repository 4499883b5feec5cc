"""`quadid serve`: the online service on a MAVLink link, no ROS needed."""

from __future__ import annotations

import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.app import options

if TYPE_CHECKING:
    from quadid_node.mavlink_link import MavlinkLink
    from quadid_node.messages import Output, ServiceHealth
    from quadid_node.service import Service
    from rich.console import Console

SAY_EVERY = 10.0
"""Time between two lines about how things are [s]."""


def serve(
    vehicle: options.VehicleName,
    mavlink: Annotated[
        str,
        typer.Option("--mavlink", metavar="URL", help="Link: udpin:0.0.0.0:14540, tcp:HOST:PORT, /dev/ttyACM0,921600."),
    ],
    system: Annotated[
        int, typer.Option("--system", metavar="N", help="System id of the vehicle; 0: the first autopilot heard.")
    ] = 0,
    key: Annotated[
        Path | None, typer.Option("--key", metavar="FILE", help="Signing key: unsigned frames are then refused.")
    ] = None,
    zenoh: Annotated[
        str | None,
        typer.Option("--zenoh", metavar="WHERE", help="Publish on Zenoh too: a locator, a config file, or 'local'."),
    ] = None,
    ground: Annotated[
        str | None,
        typer.Option("--worker", metavar="WHERE", help="Let a 'quadid worker' fit that is found there on Zenoh."),
    ] = None,
    name: Annotated[
        str, typer.Option("--id", metavar="NAME", help="Name of this vehicle; default the vehicle's.")
    ] = "",
    approval: options.Approval = "auto",
    window: options.WindowSeconds = 10.0,
    refit: options.Refit = 1.0,
    diagnose: options.Diagnose = 60.0,
    gate: options.Gate = "",
    file: Annotated[
        Path | None,
        typer.Option("--history", metavar="FILE", help="History file; default QUADID_HISTORY, else the user's."),
    ] = None,
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="End after this long; 0: never.")] = 0.0,
    seed: options.Seed = 0,
    json: options.JsonTarget = None,
) -> None:
    """Identify a flying vehicle over MAVLink; publish parameters, findings and health as component 191."""
    from quadid_node.process import StopSignal

    stop = StopSignal()
    from quadid_node.ground import fit_worker
    from quadid_node.history import Store, default_path
    from quadid_node.mavlink_link import MavlinkLink, Outlet, run
    from quadid_node.mavlink_wire import memory_path, read_key
    from quadid_node.service import Service
    from quadid_node.settings import session_settings
    from quadid_node.zenoh import ZenohLink

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
        rates = ", ".join(f"{n} {r:.0f}" for n, r in sorted(traffic.rates.items()) if r > 0.5) or "nothing"
        if traffic.denied:
            rates += f" | refused by the autopilot: {', '.join(traffic.denied)}"
        if traffic.refused:
            rates += f" | {traffic.refused} frames refused"
        if traffic.behind:
            rates += (
                f" | signed with our key, but {traffic.behind:.0f} s behind this clock: set the time of the vehicle"
            )
        rates += "".join(f" | {problem}" for problem in traffic.problems)
        status = health.status
        rates += f" | {status.backlog:.1f} s behind the data, {status.skipped} fits left out" * (status.backlog > 1.0)
        self._console.print(
            f"{status.phase.value}: {status.reason} | Hz: {rates} | fit process {health.worker}", soft_wrap=True
        )

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
