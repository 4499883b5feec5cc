"""`quadid compare-vehicles`: two vehicle files on the same flights."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid.cli import options


def compare_vehicles(
    a: Annotated[str, typer.Argument(metavar="A", help="A shipped vehicle or a YAML file.")],
    b: Annotated[str, typer.Argument(metavar="B", help="The other one.")],
    on: Annotated[list[str], typer.Option("--on", metavar="LOG", help="A flight to predict; repeatable.")],
    horizons: Annotated[
        str,
        typer.Option("--horizons", metavar="H,H,...", help="Samples after the start of each run, or times, as 0.1s."),
    ] = "1,10,50",
    rate: options.OwnRate = None,
    seed: options.Seed = 0,
    preset: options.Preset = "auto",
    unchecked: options.Unchecked = False,
    report: options.ReportFile = None,
    json: options.JsonTarget = None,
    out: options.OutFolder = Path(),
) -> None:
    """Which of two vehicle files predicts the same flights better, by how much, and how they differ."""
    from quadid.app import compare_vehicles as work
    from quadid.app.logs import load_vehicle
    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    terminal.check_file(report, "--report")
    one, two = load_vehicle(a), load_vehicle(b)
    logs = options.reader(one, rate, None, None, preset, unchecked, None)(on)
    done = work.compare_vehicles(one, two, logs, horizons=horizons, rate=rate, seed=seed)
    terminal.conclude(done, json, report)
