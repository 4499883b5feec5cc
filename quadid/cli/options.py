"""Options that several commands share, so that they are called and described the same everywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from quadid.app.logs import Log
    from quadid.vehicle import Vehicle

Logs = Annotated[
    list[str],
    typer.Argument(
        metavar="LOG",
        help="Flight logs: MCAP, .tlog, DataFlash, ULog, CSV, format auto-detected. LOG@76:216 uses seconds 76 to 216.",
    ),
]


def shipped_names(incomplete: str) -> list[str]:
    """Shipped vehicles that begin so, for the shell's completion; files it completes itself."""

    names = (Path(entry.name) for entry in files("quadid").joinpath("vehicles").iterdir())
    return sorted(n.stem for n in names if n.suffix == ".yaml" and n.stem.startswith(incomplete))


VehicleName = Annotated[
    str,
    typer.Option(
        "--vehicle", metavar="V", help="A shipped name (pelican, ...) or a YAML file.", autocompletion=shipped_names
    ),
]
Validate = Annotated[
    list[str] | None,
    typer.Option("--validate", metavar="LOG", help="A log that is scored but not fitted; repeatable."),
]
JsonTarget = Annotated[
    str | None,
    typer.Option(
        "--json", metavar="FILE", help="Write the result as JSON; '-' for stdout, which then carries nothing else."
    ),
]
OutFolder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for written files.")]
Rate = Annotated[
    float, typer.Option("--rate", metavar="HZ", help="Rate of the uniform grid; default 50 Hz.", show_default=False)
]
OwnRate = Annotated[
    float | None, typer.Option("--rate", metavar="HZ", help="Rate of the uniform grid; default the log's own.")
]
Start = Annotated[
    float | None,
    typer.Option("--start", metavar="S", help="Use every log from this many seconds after its first IMU sample."),
]
Stop = Annotated[
    float | None,
    typer.Option("--stop", metavar="S", help="Use every log up to this many seconds after its first IMU sample."),
]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of all random numbers.")]
Preset = Annotated[
    str,
    typer.Option(
        "--preset", metavar="NAME", help="Topic names of ROS logs: auto, canonical, mavros, px4, ardupilot, rotors."
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option("--columns", metavar="NAME=C", help="What a CSV calls a column, as gyro_x=p,gyro_y=q; repeatable."),
]
Unchecked = Annotated[bool, typer.Option("--unchecked", help="Use logs even when their units or frames look wrong.")]
SeriesFolder = Annotated[
    Path | None,
    typer.Option(
        "--series",
        metavar="DIR",
        help="Write measured, simulated, innovations and what is missing over time into this folder, as CSV and MCAP.",
    ),
]
ReportFile = Annotated[
    Path | None, typer.Option("--report", metavar="F.html", help="Write a self-contained HTML report.")
]


def reader(
    vehicle: Vehicle, rate: float | None, start: float | None, stop: float | None, preset: str, unchecked: bool,
    columns: Sequence[str] | None,
) -> Callable[[Sequence[str]], list[Log]]:  # fmt: skip
    """What reads the logs of a command whose options these are; see `quadid.app.logs.load`."""
    from quadid.app.logs import load, parse_columns
    from quadid.cli import terminal

    named = parse_columns(columns or [])

    def read(logs: Sequence[str]) -> list[Log]:
        with terminal.progress(compiled=()) as advance:
            out = []
            for k, text in enumerate(logs):
                advance(f"reading {Path(text).name}", k / len(logs))
                out.append(
                    load(
                        text, vehicle, rate=rate, start=start, stop=stop, preset=preset, unchecked=unchecked,
                        columns=named,
                    )
                )  # fmt: skip
            return out

    return read
