"""Options of commands, declared once: how the parameters of library functions are typed on the command line.

A command is a function of the library (`quadid.cli.commands`).  A parameter annotated with an option of typer is typed
as it is; `Typed` says how to type one to which a caller of the library gives something else; any other parameter is for
callers only.  An option without help has that of the function's docstring.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from typer.models import ParameterInfo

from quadid.app.logs import GRID, Given, parse_columns
from quadid.errors import ParameterError
from quadid.vehicle import Vehicle


class Typed(NamedTuple):
    """A parameter that is typed in another form than a caller of the library gives it.

    Attributes:
        default: on the command line; None for that of the function, `...` where it must be typed.
        opened: names of logs, opened with the log options of the command before the function is called.
    """

    kind: Any
    option: ParameterInfo
    default: Any = None
    read: Callable[[Any], Any] = lambda typed: typed
    opened: bool = False


def shipped_names(incomplete: str) -> list[str]:
    """Shipped vehicles that begin so, for the shell's completion; files it completes itself."""
    return [name for name in Vehicle.shipped_texts() if name.startswith(incomplete)]


# --- Logs and vehicles


_LOGS = typer.Argument(
    metavar="LOG",
    help="Flight logs: MCAP, .tlog, DataFlash, ULog, CSV, format auto-detected. LOG@76:216 uses seconds 76 to 216.",
)
Logs = Annotated[Given, Typed(list[str], _LOGS, ..., opened=True)]
LogNames = Annotated[Given, Typed(list[str], _LOGS, ...)]
"""Logs that the function opens itself."""
Validate = Annotated[
    Given,
    Typed(
        list[str] | None,
        typer.Option("--validate", metavar="LOG", help="A log that is scored but not fitted; repeatable."),
        opened=True,
    ),
]


def _vehicle(about: str = ".") -> Any:
    text = f"A shipped name (pelican, ...) or a YAML file{about}"
    return typer.Option("--vehicle", metavar="V", help=text, autocompletion=shipped_names)


VEHICLE = _vehicle()
VehicleName = Annotated[str, VEHICLE]
Described = str | Path | Vehicle
"""A shipped name, a YAML file or the vehicle itself."""
OfVehicle = Annotated[Described | None, Typed(str, VEHICLE, ..., Vehicle.named)]
"""The vehicle of the logs: a caller of the library may have it in a loaded log."""


def vehicle_if(about: str) -> Typed:
    """A vehicle that need not be given; its help ends with `about`."""
    return Typed(str | None, _vehicle(about), read=Vehicle.named)


# --- How a log is read


Rate = Annotated[
    float, typer.Option("--rate", metavar="HZ", help="Resample logs to this rate; default 50 Hz.", show_default=False)
]
OwnRate = Annotated[
    float | None, typer.Option("--rate", metavar="HZ", help="Resample logs to this rate; default the log's own.")
]
Start = Annotated[
    float | None,
    typer.Option("--start", metavar="S", help="Use every log from this many seconds after its first IMU sample."),
]
Stop = Annotated[
    float | None,
    typer.Option("--stop", metavar="S", help="Use every log up to this many seconds after its first IMU sample."),
]
Preset = Annotated[
    str,
    typer.Option(
        "--preset", metavar="NAME", help="Topic names of ROS logs: auto, canonical, mavros, px4, ardupilot, rotors."
    ),
]
Unchecked = Annotated[bool, typer.Option("--unchecked", help="Use logs even when their units or frames look wrong.")]
_COLUMNS = typer.Option(
    "--columns", metavar="NAME=C", help="Names of the columns of a CSV, as gyro_x=p,gyro_y=q; repeatable."
)
Columns = Annotated[list[str] | None, _COLUMNS]
NamedColumns = Annotated[Mapping[str, str] | None, Typed(list[str] | None, _COLUMNS, read=parse_columns)]
READING: dict[str, tuple[Any, Any]] = {
    "rate": (Rate, GRID),
    "start": (Start, None),
    "stop": (Stop, None),
    "preset": (Preset, "auto"),
    "unchecked": (Unchecked, False),
    "columns": (Columns, None),
}
"""Options of a command whose logs are opened for it, with defaults; arguments of `quadid.load`."""

# --- Fitted parameters, beside or instead of those of the vehicle file


def key_numbers(pairs: str, text: str, form: str = "NAME:KEY=NUMBER,KEY=NUMBER") -> dict[str, float]:
    """Numbers of ``KEY=VALUE,KEY=VALUE``, part of a `text` of this form; raises ParameterError for another."""
    values: dict[str, float] = {}
    for part in filter(None, pairs.split(",")):
        key, _, number = part.partition("=")
        try:
            values[key.strip()] = float(number)
        except ValueError as error:
            raise ParameterError(f"cannot read '{part}' in '{text}'", form) from error
    return values


def _effects(texts: Sequence[str]) -> dict[str, dict[str, float]]:
    """Effects of ``NAME:KEY=VALUE,KEY=VALUE``."""
    return {name: key_numbers(rest, text) for text in texts for name, _, rest in [text.partition(":")]}


def _pairs(form: str) -> Callable[[Sequence[str]], dict[str, tuple[float, float]]]:
    """A reader of two numbers by name, typed in this form."""

    def read(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
        out = {}
        for text in texts:
            name, _, numbers = text.partition("=")
            try:
                first, second = (float(number) for number in numbers.split(":"))
            except ValueError as error:
                raise ParameterError(f"cannot read '{text}'", form) from error
            out[name.strip()] = (first, second)
        return out

    return read


def _several(name: str, form: str, about: str, read: Callable[[Any], Any]) -> Typed:
    return Typed(list[str] | None, typer.Option(name, metavar=form, help=f"{about} Repeatable."), read=read)


Free = Annotated[
    Sequence[str],
    _several("--free", "NAME", "Also fit this number of a known effect, as motor_lag.tau.", lambda typed: typed),
]
Fix = Annotated[
    Sequence[str],
    _several("--fix", "NAME", "Keep this one of the six at the value of the vehicle file.", lambda typed: typed),
]
Bounds = Annotated[
    Mapping[str, tuple[float, float]] | None,
    _several("--bounds", "NAME=LOW:HIGH", "Bounds of one of the six, instead of the file's.", _pairs("NAME=LOW:HIGH")),
]
Priors = Annotated[
    Mapping[str, tuple[float, float]] | None,
    _several(
        "--prior",
        "NAME=VALUE:SIGMA",
        "Prior knowledge of one of the six, instead of the file's.",
        _pairs("NAME=VALUE:SIGMA"),
    ),
]
KnownEffects = Annotated[
    Mapping[str, Mapping[str, float]] | None,
    _several(
        "--effect",
        "NAME:KEY=VALUE,...",
        "A known effect, in addition to the file's or in place of one of them.",
        _effects,
    ),
]

# --- The work, and where its results go


Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of all random numbers.")]
WindowSeconds = Annotated[float, typer.Option("--window", metavar="S", help="Length of flight that one fit uses.")]
Refit = Annotated[float, typer.Option("--refit", metavar="S", help="Time between fits.")]
Diagnose = Annotated[
    float, typer.Option("--diagnose", metavar="S", help="Time between two diagnoses of the last minute; 0: never.")
]
Approval = Annotated[str, typer.Option("--approval", metavar="HOW", help="auto or manual.")]
Gate = Annotated[
    str, typer.Option("--gate", metavar="K=V,...", help="Gate settings, as windows=3,width=0.05; see docs/online.md.")
]


def gate_settings(pairs: str) -> dict[str, float]:
    """Settings that `Gate` lists; raises ParameterError."""
    return key_numbers(pairs, pairs, "NAME=NUMBER,NAME=NUMBER")


Horizons = Annotated[
    str | Sequence[int | str],
    Typed(
        str,
        typer.Option("--horizons", metavar="H,H,...", help="Samples after the start of each run, or times, as 0.1s."),
        "1,10,50",
    ),
]
JsonTarget = Annotated[
    str | None,
    typer.Option(
        "--json", metavar="FILE", help="Write the result as JSON; '-' for stdout, which then carries nothing else."
    ),
]
OUT = typer.Option("--out", metavar="DIR", help="Folder for written files.")
OutFolder = Annotated[Path, OUT]
ReportFile = Annotated[
    Path | None, typer.Option("--report", metavar="F.html", help="Write a self-contained HTML report.")
]
SeriesFolder = Annotated[
    Path | None,
    typer.Option(
        "--series",
        metavar="DIR",
        help="Write what is measured, simulated and missing over time into this folder, as CSV and MCAP.",
    ),
]
