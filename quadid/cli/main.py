"""The `quadid` command: finds the asked-for command, runs it, and turns errors into one line and an exit code.

Commands are imported only when they are called: ``quadid foo`` imports `quadid.cli.foo` and calls its function ``foo``,
a plain function with typer annotations (see `quadid.cli.options` for the options that all share).
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

COMMANDS: dict[str, str] = {
    "demo": "Fly, identify and diagnose a simulated Pelican; write a report.",
    "simulate": "Fly the closed-loop vehicle and log it, to a file or live.",
    "init": "A vehicle file to fill in, or filled in from a log.",
    "vehicles": "The vehicles that ship.",
    "inspect": "What a log holds, whether it can be true, and what is missing.",
    "identify": "Identify the parameters of a vehicle from its flight logs.",
    "score": "Open-loop prediction error of a vehicle file on logs.",
    "compare": "All optimisers and subspace methods on the same data.",
    "diagnose": "What the simulation gets wrong, why, and the gain of correcting it.",
    "health": "What changed in the vehicle since the baseline flights.",
    "excite": "Which manoeuvre to fly next, and what it would gain.",
    "reproduce": "The paper's tables and figures.",
    "replay": "Drive the online session from a log.",
    "serve": "The online service on a MAVLink link, no ROS needed.",
    "worker": "Fit on this machine for services elsewhere, over Zenoh.",
    "watch": "Live terminal view of one or many vehicles.",
    "history": "Stored parameter sets: what, when, from which data, by whom.",
    "export": "The parameters for another program.",
    "compare-vehicles": "Two vehicle files on the same flights.",
    "gains": "Rate and attitude gains from the identified vehicle.",
    "fleet": "Identify a folder of logs in parallel.",
    "warmup": "Compile now what the first fit would compile.",
}
"""Every command with its one-line help, in the order of `quadid --help`."""


EXAMPLES: dict[str, tuple[str, ...]] = {
    "demo": ("quadid demo --quick --out demo-out",),
    "simulate": (
        "quadid simulate flight.mcap --seconds 120 --seed 3",
        "quadid simulate late.csv --effect motor_lag:tau=0.04",
        "quadid simulate udpout:127.0.0.1:14550 --seconds 60",
    ),
    "init": ("quadid init mine", "quadid init mine --from flight.bin --mass 1.9"),
    "vehicles": ("quadid vehicles",),
    "inspect": ("quadid inspect flight.bin", "quadid inspect flight.ulg@76:216 --vehicle mine.yaml --json -"),
    "identify": (
        "quadid identify flight.mcap --validate other.mcap --vehicle pelican --report report.html",
        "quadid identify a.bin b.bin@30:90 --vehicle mine.yaml --json result.json",
    ),
    "score": ("quadid score other.mcap --vehicle pelican.fitted.yaml --horizons 1,10,50",),
    "compare": ("quadid compare flight.mcap --validate other.mcap --vehicle pelican",),
    "diagnose": ("quadid diagnose flight.mcap --validate other.mcap --vehicle pelican --report diagnosis.html",),
    "health": ("quadid health today.usd --baseline a.usd --baseline b.usd --vehicle crazyflie --report health.html",),
    "excite": ("quadid excite flight.mcap --vehicle pelican",),
    "reproduce": ("quadid reproduce --out reproduce-out",),
    "replay": ("quadid replay flight.mcap --vehicle pelican --speed max --out result.mcap",),
    "serve": ("quadid serve --vehicle mine.yaml --mavlink udpin:0.0.0.0:14540",),
    "worker": ("quadid worker --connect tcp/192.168.1.5:7447",),
    "watch": ("quadid watch", "quadid watch --zenoh tcp/192.168.1.5:7447"),
    "history": ("quadid history --vehicle mine.yaml --events 20",),
    "export": (
        "quadid export --vehicle pelican.fitted.yaml --format px4 --out params",
        "quadid export --vehicle pelican --history h.sqlite --format ardupilot",
        "quadid export --list",
    ),
    "compare-vehicles": ("quadid compare-vehicles old.yaml new.yaml --on flight.mcap --report compared.html",),
    "gains": (
        "quadid gains --vehicle mine.yaml --format px4 --report gains.html",
        "quadid gains --vehicle mine.yaml --format ardupilot --from flight.bin --bandwidth 5",
    ),
    "fleet": (
        "quadid fleet logs --vehicle pelican --workers 4 --out fleet-out",
        "quadid fleet logs --scheduler tcp://10.0.0.1:8786 --diagnose",
    ),
    "warmup": ("quadid warmup",),
}
"""Calls that each command's help ends with."""


def _available() -> dict[str, str]:
    """Commands whose module is installed."""
    return {n: text for n, text in COMMANDS.items() if importlib.util.find_spec(_module(n)) is not None}


def _module(name: str) -> str:
    """Where a command is: ``quadid foo-bar`` is `quadid.cli.foo_bar.foo_bar`."""
    return f"quadid.cli.{name.replace('-', '_')}"


class LazyGroup(TyperGroup):
    """Lists every command from a table, and imports one only to run it."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for name, text in _available().items():
            self.commands[name] = TyperCommand(name, help=text, short_help=text, rich_markup_mode=None)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Finds the command asked for, imported and complete."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, None if command is None else load(str(command.name)), rest


def load(name: str) -> Any:
    """Imports one command, ready to run."""
    module = importlib.import_module(_module(name))
    function = getattr(module, name.replace("-", "_"))
    alone = typer.Typer(rich_markup_mode=None, add_completion=False)
    # A backspace character alone on a line keeps click from joining the lines.
    examples = "\n".join(("\b", "Examples:", *(f"  {line}" for line in EXAMPLES[name])))
    alone.command(name, help=None if function.__doc__ else COMMANDS[name], epilog=examples)(function)
    return get_command(alone)


def _version(wanted: bool) -> None:
    if wanted:
        from quadid.version import __version__

        typer.echo(f"quadid {__version__}")
        raise typer.Exit


app = typer.Typer(name="quadid", cls=LazyGroup, rich_markup_mode=None)


@app.callback(
    epilog="All quantities SI; world NED, body FRD. Exit codes: 0 done, 2 bad input, 3 the data cannot answer."
)
def _quadid(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Identifies the parameters of a multirotor simulation from flight data, and names what it still gets wrong."""


BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""What decides how many threads numpy's linear algebra takes.  Ours is of small matrices, and the simulation uses every
core itself: more threads than one only wait for each other, on a busy machine for most of the time."""


def app_main() -> int:
    """Runs the command line; returns the exit code: 0 done, 2 bad input, 3 the data cannot support an answer."""
    if sys.stderr is None:  # closed by the shell: what is written to it goes nowhere
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - it stays open to the end
    if sys.stdout is None:
        print("quadid: stdout is closed; fix: send it to a file, or to /dev/null", file=sys.stderr)
        return 2
    try:
        importlib.import_module("quadid")  # refuses a folder that would run foreign code
    except ImportError as error:
        print(f"quadid: {error}", file=sys.stderr)
        return 2
    for name in BLAS_THREADS:
        os.environ.setdefault(name, "1")
    try:
        result = get_command(app).main(sys.argv[1:] or ["--help"], prog_name="quadid", standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our pipe left; nothing more can be said there, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (KeyboardInterrupt, typer.Abort):
        print("quadid: stopped", file=sys.stderr)
        return 130
    except Exception as error:
        from quadid.cli.terminal import explain

        reason = explain(error)
        if reason is None:
            raise
        print(f"quadid: {reason.line}", file=sys.stderr)
        return reason.exit_code
    return result if isinstance(result, int) else 0
