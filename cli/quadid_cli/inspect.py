"""`quadid inspect`: what a log holds, whether it can be true, what it allows, and how to log what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.sanitise import LONGEST_LINE
from quadid.sanitise import plain as clean
from quadid_cli.options import JsonTarget, Preset, Start, Stop

if TYPE_CHECKING:
    from rich.console import Console

    from quadid.inspection import Inspection
    from quadid.vehicle import Vehicle
    from quadid.window import Recording

_COLOURS = {"ok": "green", "warning": "yellow", "error": "red", "unknown": "dim"}


def inspect(
    log: Annotated[
        str,
        typer.Argument(
            metavar="LOG",
            help="A flight log: ROS 2 MCAP, .tlog, DataFlash, ULog, CSV, told by content. LOG@76:216: a span.",
        ),
    ],
    vehicle: Annotated[
        str | None,
        typer.Option("--vehicle", metavar="V", help="A shipped name or a YAML file: checks motors and excitation too."),
    ] = None,
    json: JsonTarget = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Also write the inspection as JSON into this folder.")
    ] = None,
    start: Start = None,
    stop: Stop = None,
    preset: Preset = "auto",
) -> None:
    """What a log holds: channels, rates, gaps, faults, units and frames, excitation, what is missing."""
    from quadid_replay import open_log

    from quadid.inspection import inspect as inspect_recording
    from quadid_cli.loading import load_vehicle, parse_cut
    from quadid_cli.output import check_file, json_text, out_folder, write_json, write_text
    from quadid_cli.terminal import console

    check_file(json, "--json")
    folder = None if out is None else out_folder(out)
    described = None if vehicle is None else load_vehicle(vehicle)
    cut = parse_cut(log, start, stop)
    recording = _part(open_log(cut.path, preset), cut.start, cut.stop)
    rows = () if described is None else _excitation(recording, described)
    inspection = inspect_recording(recording, described, rows)
    result = {**inspection.to_dict(), "log": str(cut.path.resolve()), "files": []}
    if folder is not None:
        target = folder / f"{cut.path.name}.inspect.json"
        result["files"] = [str(target)]
        write_text(target, json_text(result))
    write_json(result, json)
    _print(console(quiet=json == "-", markup=True), inspection)


def _part(recording: Recording, start: float | None, stop: float | None) -> Recording:
    """Cuts all channels to seconds after the first IMU sample."""
    from dataclasses import replace

    from quadid.errors import LogError
    from quadid_cli.loading import first_imu_time

    if start is None and stop is None:
        return recording
    zero = first_imu_time(recording)
    low = -float("inf") if start is None else zero + start
    high = float("inf") if stop is None else zero + stop
    channels = {}
    for name, channel in recording.channels.items():
        inside = (channel.t >= low) & (channel.t <= high)
        if inside.any():
            channels[name] = replace(channel, t=channel.t[inside], values=channel.values[inside])
    if not channels:
        raise LogError(f"{recording.name}: nothing between {start} and {stop} s", "a span inside the log")
    return replace(recording, channels=channels, breaks=tuple(b for b in recording.breaks if low <= b <= high))


def _excitation(recording: Recording, vehicle: Vehicle) -> tuple[dict[str, Any], ...]:
    """Expected relative standard deviation per parameter, from up to `LONGEST` s of flight; none when refused."""
    from quadid.errors import QuadidError
    from quadid.grid import to_windows
    from quadid.identify.excitation import excitation
    from quadid.parameters import NOMINAL_UNITS
    from quadid_cli.loading import LONGEST, beginning

    try:
        windows, _ = beginning(to_windows(recording, vehicle), LONGEST)
        found = excitation(windows, vehicle)
    except QuadidError:
        return ()  # the inspection itself says what is missing or too slow
    return tuple(
        {
            "name": name,
            "unit": NOMINAL_UNITS[name],
            "relative_sigma": float(bound),
            "relative_sigma_alone": float(alone),
        }
        for name, bound, alone in zip(found.names, found.bound, found.alone, strict=True)
    )


def _plain(text: str) -> str:
    """Text of a log for the terminal: no control characters, no markup."""
    from rich.markup import escape

    return escape(clean(text, LONGEST_LINE))


def _print(console: Console, inspection: Inspection) -> None:
    flying = ", ".join(f"{a:.1f}-{b:.1f}" for a, b in inspection.flying) or "none found"
    console.print(
        f"[bold]{_plain(inspection.name)}[/bold]: {inspection.format}, {inspection.seconds:.1f} s, "
        f"flying from-to (s): {flying}"
    )
    for warning in inspection.warnings:
        console.print(f"[yellow]note[/yellow] {_plain(warning)}")
    console.print(_channel_table(inspection))
    console.print(_check_table(inspection))
    console.print(_parameter_table(inspection))
    for missing in inspection.missing:
        console.print(
            f"[yellow]missing[/yellow] {missing.channel}: {_plain(missing.why)}. To get it: {_plain(missing.how)}"
        )
    verdict = "usable for identification" if inspection.usable else "not usable for identification as it is"
    console.print(f"[bold]{verdict}[/bold]")


def _channel_table(inspection: Inspection) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title="channels", title_justify="left", box=SIMPLE_HEAD, padding=(0, 0), pad_edge=False)
    table.add_column("channel", no_wrap=True)
    table.add_column("source", overflow="fold")
    for name in ("rate (Hz)", "samples", "from-to (s)", "gaps", "gap (s)", "dropped"):
        table.add_column(name, justify="right", no_wrap=True)
    for f in inspection.channels:
        table.add_row(
            f.name, _plain(f.source), f"{f.rate:.4g}", str(f.count), f"{f.first:.1f}-{f.last:.1f}", str(f.gaps),
            f"{f.longest_gap:.3g}" if f.gaps else "", str(sum(f.dropped.values()) or ""),
        )  # fmt: skip
    return table


def _check_table(inspection: Inspection) -> Any:
    from rich.table import Table

    table = Table(title="checks", title_justify="left")
    table.add_column("verdict")
    for name in ("check", "finding", "what to do"):
        table.add_column(name, overflow="fold")
    for check in inspection.checks:
        verdict = check.verdict.value
        coloured = f"[{_COLOURS[verdict]}]{verdict}[/{_COLOURS[verdict]}]"
        table.add_row(coloured, check.name.replace("_", " "), _plain(check.message), _plain(check.fix))
    return table


def _parameter_table(inspection: Inspection) -> Any:
    from rich.table import Table

    table = Table(title="what can be identified", title_justify="left")
    for name in ("parameter", "possible", "why"):
        table.add_column(name, overflow="fold")
    expected = {str(row["name"]): float(row["relative_sigma"]) for row in inspection.excitation}
    if expected:
        table.add_column("expected 1-sigma (%)", justify="right")
    for outlook in inspection.parameters:
        cells = [outlook.parameter, "yes" if outlook.possible else "no", _plain(outlook.reason)]
        if expected:
            sigma = expected.get(outlook.parameter, float("nan"))
            cells.append(f"{100.0 * sigma:.2g}" if sigma < 10.0 else "unknown from this flight")
        table.add_row(*cells)
    return table
