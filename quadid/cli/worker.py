"""`quadid worker`: fits on this machine for services elsewhere, over Zenoh."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from quadid.app.options import JsonTarget
from quadid.sanitise import plain


def worker(
    connect: Annotated[
        str, typer.Option("--connect", metavar="WHERE", help="A locator (tcp/host:7447), a config file, or 'local'.")
    ],
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="End after this long; 0: never.")] = 0.0,
    json: JsonTarget = None,
) -> None:
    """Fit windows on this machine for vehicles' services; they fit on board whenever this one is gone."""
    from quadid_node.process import StopSignal

    stop = StopSignal()
    from quadid_node.ground import work

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
