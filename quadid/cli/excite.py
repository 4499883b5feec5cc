"""`quadid excite`: which manoeuvre to fly next, and what it would gain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from quadid.app.logs import GRID, load_vehicle
from quadid.cli.options import (
    Columns,
    JsonTarget,
    OutFolder,
    Preset,
    Rate,
    ReportFile,
    Seed,
    Unchecked,
    VehicleName,
    reader,
)  # fmt: skip


def excite(
    logs: Annotated[list[str] | None, typer.Argument(metavar="LOG", help="Flights so far, if any.")] = None,
    vehicle: VehicleName = "pelican",
    seconds: Annotated[float, typer.Option("--seconds", metavar="S", help="Length of the manoeuvre.")] = 60.0,
    tilt: Annotated[float, typer.Option("--tilt", metavar="DEG", help="Largest tilt.")] = 25.0,
    rate_limit: Annotated[float, typer.Option("--rate-limit", metavar="DEG/S", help="Largest body rate.")] = 150.0,
    height: Annotated[
        str, typer.Option("--height", metavar="M:M", help="Lowest and highest height above take-off.")
    ] = "10:40",
    battery: Annotated[float, typer.Option("--battery", metavar="%", help="What must remain of the battery.")] = 40.0,
    forms: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            metavar="NAME",
            help="Also write what flies it: ardupilot-lua, ardupilot-sid, px4, sticks; repeatable.",
        ),
    ] = None,
    seed: Seed = 1,
    rate: Rate = GRID,
    preset: Preset = "auto",
    columns: Columns = None,
    unchecked: Unchecked = False,
    report: ReportFile = None,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Propose the manoeuvre that shrinks the intervals most, within limits; write it, and what flies it."""
    from quadid.app.excite import check_forms, check_limits, parse_height, propose
    from quadid.cli import terminal

    heights = parse_height(height)
    check_limits(seconds, tilt, rate_limit, heights, battery)
    check_forms(forms or ())
    terminal.check_file(json, "--json")
    terminal.check_file(report, "--report")
    described = load_vehicle(vehicle)
    folder = terminal.out_folder(out)
    opened = reader(described, rate, None, None, preset, unchecked, columns)(logs or [])
    with terminal.progress() as advance:
        done = propose(
            opened, vehicle=described, seconds=seconds, tilt=tilt, rate_limit=rate_limit, height=heights,
            battery=battery, seed=seed, advance=advance,
        )  # fmt: skip
    result = done.result
    first, *others = done.save(folder, forms or ())
    result["manoeuvre_file"], result["files"] = str(first), [str(path) for path in others]
    if report is not None:
        from quadid.report.fit_pages import excite_html

        result["report"] = str(terminal.write_text(report, excite_html(result, done.proposal.flight.window)))
    terminal.write_json(result, json)
    show(result, quiet=json == "-")
    terminal.warn([text for log in opened for text in log.warnings])


def show(result: Mapping[str, Any], quiet: bool) -> None:
    """Prints the result for people."""
    from quadid.cli import terminal
    from quadid.experiment import BLOCK
    from quadid.report.fit_pages import gain_table, grouped

    console = terminal.console(quiet)
    terminal.print_tables(console, [gain_table(result)])
    console.print(f"Manoeuvre: movements of {BLOCK:g} s, amplitudes rms")
    for name, times, amplitudes in grouped(result["movements"]):
        console.print(f"  {times} × {name}: {amplitudes}")
    peak = result["peak"]
    room, e = result["room"], result["envelope"]
    console.print(
        f"In simulation it reaches {peak['tilt_deg']:.0f} degrees and {peak['rate_deg_s']:.0f} deg/s, and needs "
        f"{room['sideways_m']:.0f} m to each side, {room['up_m']:.1f} m upwards and {room['down_m']:.1f} m downwards."
    )
    console.print(
        f"Envelope: {e['lowest_m']:g} to {e['highest_m']:g} m above take-off, {e['radius_m']:g} m around the start, "
        f"{e['abort_tilt_deg']:.0f} degrees of tilt, {e['battery_percent']:g} % of the battery left."
    )
    gain = f"{result['gain']:.3g} times narrower"
    console.print(f"The manoeuvre makes the interval of {result['worst']}, the least certain parameter, {gain}.")
    console.print(f"Manoeuvre: {result['manoeuvre_file']}", soft_wrap=True)
    for path in result["files"]:
        console.print(f"To fly it: {path}", soft_wrap=True)
    if "report" in result:
        console.print(f"Report: {result['report']}", soft_wrap=True)
