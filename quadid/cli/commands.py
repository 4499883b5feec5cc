"""The commands: a table, and how a function of the library becomes one.

Options are the parameters of the function (`quadid.app.options`), how its logs are read, and where its `Outcome` goes.
Its docstring is the help of the command, and what it says of a parameter that of the option, where the option has none.
Nothing that a command needs is imported before it is called.
"""

from __future__ import annotations

import copy
import importlib
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from typer.main import get_command
from typer.models import OptionInfo, ParameterInfo

if TYPE_CHECKING:
    from quadid.app.logs import Log
    from quadid.app.outcome import Advance, Outcome
    from quadid.vehicle import Vehicle

READING = ("rate", "start", "stop", "preset", "unchecked", "columns")
"""Every option of `quadid.app.options.READING`."""
FOLDER = "Folder for written files."


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        function: ``module:name``: one of the library, or of the command line, which may also print and write by itself.
        reading: options of how its logs are read.
        check: ``module:name`` of what refuses wrong arguments before any log is read.
        simulates: whether it needs the kernels of a fit once it has a vehicle.
        out: help of ``--out``; files that are not written without it have one of their own; none has no such option.
    """

    short: str
    examples: tuple[str, ...]
    function: str
    reading: tuple[str, ...] = ()
    check: str = ""
    out: str = FOLDER
    simulates: bool = False


COMMANDS = {
    "demo": Command(
        "Fly, identify and diagnose a simulated Pelican; write a report.",
        ("quadid demo --quick --out demo-out",),
        "quadid.cli.demo:demo",
    ),
    "simulate": Command(
        "Fly the closed-loop vehicle and log it, to a file or live.",
        (
            "quadid simulate flight.mcap --seconds 120 --seed 3",
            "quadid simulate late.csv --effect motor_lag:tau=0.04",
            "quadid simulate udpout:127.0.0.1:14550 --seconds 60",
        ),
        "quadid.cli.simulate:simulate",
        check="quadid.cli.simulate:check_target",
        out="",
    ),
    "init": Command(
        "Write a vehicle file to fill in, or fill it in from a log.",
        ("quadid init mine", "quadid init mine --from flight.bin --mass 1.9"),
        "quadid.app.init:init",
    ),
    "vehicles": Command(
        "List the vehicles that come with quadid.", ("quadid vehicles",), "quadid.app.init:vehicles", out=""
    ),
    "inspect": Command(
        "Check a log against physics, and list what it lacks.",
        ("quadid inspect flight.bin", "quadid inspect flight.ulg@76:216 --vehicle mine.yaml --json -"),
        "quadid.app.inspect:inspect",
        out="Also write the inspection as JSON into this folder.",
        simulates=True,
    ),
    "identify": Command(
        "Identify the parameters of a vehicle from its flight logs.",
        (
            "quadid identify flight.mcap --validate other.mcap --vehicle pelican --report report.html",
            "quadid identify a.bin b.bin@30:90 --vehicle mine.yaml --json result.json",
            "quadid identify a.bin --vehicle mine.yaml --effect motor_lag:tau=0.03 --free motor_lag.tau --fix J_r",
        ),
        "quadid.app.identify:identify",
        READING,
        "quadid.app.identify:check_optimizer",
        simulates=True,
    ),
    "score": Command(
        "Measure how well a vehicle file predicts logs.",
        ("quadid score other.mcap --vehicle pelican.fitted.yaml --horizons 1,10,50",),
        "quadid.app.score:score",
        READING[1:],
        simulates=True,
    ),
    "compare": Command(
        "Run all optimisers and subspace methods on the same data.",
        ("quadid compare flight.mcap --validate other.mcap --vehicle pelican",),
        "quadid_evaluation.paper.compare:compare",
        READING,
        "quadid_evaluation.paper.compare:check_names",
        simulates=True,
    ),
    "diagnose": Command(
        "Find what the simulation gets wrong, why, and the gain of correcting it.",
        ("quadid diagnose flight.mcap --validate other.mcap --vehicle pelican --report diagnosis.html",),
        "quadid.app.diagnose:diagnose",
        READING,
        simulates=True,
    ),
    "health": Command(
        "Find what changed in the vehicle since the baseline flights.",
        ("quadid health today.usd --baseline a.usd --baseline b.usd --vehicle crazyflie --report health.html",),
        "quadid.app.health:health",
    ),
    "excite": Command(
        "Propose the manoeuvre to fly next, and predict its gain.",
        ("quadid excite flight.mcap --vehicle pelican",),
        "quadid.app.excite:propose",
        ("rate", "preset", "columns", "unchecked"),
        "quadid.app.excite:check_limits",
        simulates=True,
    ),
    "reproduce": Command(
        "Reproduce the paper's tables and figures.",
        ("quadid reproduce --out reproduce-out",),
        "quadid.cli.demo:reproduce",
    ),
    "replay": Command(
        "Show what the online service would have published for a log.",
        ("quadid replay flight.mcap --vehicle pelican --speed max --out result.mcap",),
        "quadid.cli.replay:replay",
        out="",
    ),
    "serve": Command(
        "Run the online service on a MAVLink link; no ROS needed.",
        ("quadid serve --vehicle mine.yaml --mavlink udpin:0.0.0.0:14540",),
        "quadid.cli.serve:serve",
    ),
    "worker": Command(
        "Fit on this machine for services elsewhere, over Zenoh.",
        ("quadid worker --connect tcp/192.168.1.5:7447",),
        "quadid.cli.serve:worker",
    ),
    "watch": Command(
        "Watch one or many vehicles live in the terminal.",
        ("quadid watch", "quadid watch --zenoh tcp/192.168.1.5:7447"),
        "quadid.cli.serve:watch",
    ),
    "history": Command(
        "List stored parameter sets: what, when, from which data, by whom.",
        ("quadid history --vehicle mine.yaml --events 20",),
        "quadid.cli.history:history",
        out="",
    ),
    "export": Command(
        "Write the parameters for another program.",
        (
            "quadid export --vehicle pelican.fitted.yaml --format px4 --out params",
            "quadid export --vehicle pelican --history h.sqlite --format ardupilot",
            "quadid export --list",
        ),
        "quadid.cli.export:export",
    ),
    "compare-vehicles": Command(
        "Compare two vehicle files on the same flights.",
        ("quadid compare-vehicles old.yaml new.yaml --on flight.mcap --report compared.html",),
        "quadid.app.score:compare_vehicles",
        ("preset", "unchecked"),
        simulates=True,
    ),
    "gains": Command(
        "Propose rate and attitude gains from the identified vehicle.",
        (
            "quadid gains --vehicle mine.yaml --format px4 --report gains.html",
            "quadid gains --vehicle mine.yaml --format ardupilot --from flight.bin --bandwidth 5",
        ),
        "quadid.app.gains:gains",
        out="Write the proposed parameters as a file into it.",
    ),
    "fleet": Command(
        "Identify a folder of logs in parallel.",
        (
            "quadid fleet logs --vehicle pelican --workers 4 --out fleet-out",
            "quadid fleet logs --scheduler tcp://10.0.0.1:8786 --diagnose",
        ),
        "quadid.app.fleet:fleet",
        out="",
        simulates=True,
    ),
    "warmup": Command(
        "Compile everything now, so that the first fit need not.", ("quadid warmup",), "quadid.cli.warmup:warmup"
    ),
}
"""Every command, in the order of `quadid --help`."""


def load(name: str) -> Any:
    """Imports one command, ready to run."""
    command = COMMANDS[name]
    function = as_command(command, _imported(command.function))
    alone = typer.Typer(rich_markup_mode=None, add_completion=False)
    # A backspace character alone on a line keeps click from joining the lines.
    examples = "\n".join(("\b", "Examples:", *(f"  {line}" for line in command.examples)))
    alone.command(name, epilog=examples)(function)
    return get_command(alone)


def _imported(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


# --- A function of the library as a command


def documented(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """Description of a function and of each of its parameters, from its docstring, without marks of code."""
    about, *sections = re.split(r"\n(?=(?:Args|Returns|Raises):\n)", (inspect.getdoc(function) or "").replace("`", ""))
    entries = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", sections[0] if sections else "", re.MULTILINE)
    return about, {name: " ".join(text.split()) for name, text in entries}


def with_help(option: ParameterInfo, text: str, kind: Any) -> ParameterInfo:
    """The option with its own help, else with this text about it."""
    if option.help or not text:
        return option
    option = copy.copy(option)
    several = isinstance(option, OptionInfo) and "list" in str(kind)
    option.help = f"{text[0].upper()}{text[1:].rstrip('.')}{'; repeatable' * several}."
    return option


def as_command(command: Command, function: Callable[..., Any]) -> Callable[..., None]:
    """The function with the parameters of its command, which prints and writes its outcome, if it returns one."""
    from quadid.app import options
    from quadid.app.kernels import FIT, prepare
    from quadid.app.logs import check_folder, file_name, parse_part, write_text
    from quadid.app.outcome import Fitted, Reported, UnansweredError
    from quadid.cli import terminal
    from quadid.errors import QuadidError
    from quadid.vehicle import Vehicle

    signature, (about, words) = inspect.signature(function, eval_str=True), documented(function)
    outcome: type[Outcome] | None = signature.return_annotation
    typed: dict[str, options.Typed] = {}
    shown: dict[str, tuple[Any, Any]] = {}
    for name, parameter in signature.parameters.items():
        for option in get_args(parameter.annotation)[1:]:
            if isinstance(option, ParameterInfo):
                default = ... if parameter.default is parameter.empty else parameter.default
                option = options.Typed(get_args(parameter.annotation)[0], option, default)
            if isinstance(option, options.Typed):
                typed[name] = option
                described = with_help(option.option, words.get(name, ""), option.kind)
                shown[name] = Annotated[option.kind, described], option.default
    shown |= {name: options.READING[name] for name in command.reading}
    page_name = None
    if outcome is not None:
        page_name = outcome.page_name if issubclass(outcome, Reported) else None
        shown |= {"report": (options.ReportFile, None)} if page_name == "" else {}
        shown |= {"series": (options.SeriesFolder, None)} if issubclass(outcome, Fitted) else {}
        shown |= {"json": (options.JsonTarget, None)}
    if outcome is not None and command.out:
        asked = Annotated[Path | None, typer.Option("--out", metavar="DIR", help=command.out)]
        shown |= {"out": (options.OutFolder, Path()) if command.out == FOLDER else (asked, None)}

    def run(**given: Any) -> None:
        if outcome is None:
            function(**given)
            return
        if page_name:
            check_folder(given["out"], "--out")
            given["report"] = given["out"] / page_name
        # Places to write to are looked at before any work.
        logged = [given[n] for n in typed if typed[n].option.metavar == "LOG" and given[n]]
        texts = [text for one in logged for text in ([one] if isinstance(one, str) else one)]
        json, report, series, out = (given.get(name) for name in ("json", "report", "series", "out"))
        terminal.check_file(json, "--json")
        folder = check_folder(out, "--out") if command.out and out is not None else None
        names = [file_name(parse_part(text).path.name) for text in texts]
        if series is not None and issubclass(outcome, Fitted):
            check_folder(series, "--series", *(name + end for name in names for end in outcome.over_time))
        terminal.check_file(report, "--report")

        # What was not typed is as the function has it.
        told = {name: how.read(given[name]) for name, how in typed.items() if given[name] not in (None, [])}
        if command.check:
            check = _imported(command.check)
            asked = inspect.signature(check).parameters
            check(**{name: told.get(name, p.default) for name, p in signature.parameters.items() if name in asked})
        vehicle = next((value for value in told.values() if isinstance(value, Vehicle)), None)
        names += [file_name(vehicle.name)] if vehicle is not None else []
        if folder is not None:
            check_folder(folder, "--out", *(name + end for name in names for end in outcome.endings))
        logs = [name for name in typed if typed[name].opened and name in told]
        how = {name: given[name] for name in ("rate", *command.reading) if name in given}

        done: Outcome | None = None
        unanswered: UnansweredError | None = None
        try:
            with terminal.progress() as advance:
                if vehicle is not None:
                    told |= {name: opened(told[name], vehicle, advance, **how) for name in logs}
                if command.simulates and (vehicle is not None or "advance" in signature.parameters):
                    prepare(FIT, advance)
                advance(function.__name__.replace("_", " "), 0.0)
                try:
                    done = function(**told, **({"advance": advance} if "advance" in signature.parameters else {}))
                except UnansweredError as error:
                    done, unanswered = error.outcome, error
                # Its files, which its JSON names; a vehicle file that was read is not overwritten.
                advance("writing", 1.0)
                files = [] if folder is None else done.write(folder, given.get("vehicle"))
                if report is not None and isinstance(done, Reported):
                    done.result["report"] = str(report.absolute())
                    files.append(("Report", done.report(report, terminal.command_line())))
                if series is not None and isinstance(done, Fitted):
                    written = done.save_series(series)
                    done.result["series"] = [str(path) for path in written]
                    files += [("Over time", path) for path in written]
        except QuadidError as error:
            # The report of an attempt that failed says why, and shows the data.
            if done is None and report is not None and vehicle is not None and outcome.title:
                from quadid.app.failure import failure_html

                what, preset = f"{outcome.title} of {vehicle.name}", given.get("preset", "auto")
                text = failure_html(error, what, texts, vehicle, preset, terminal.command_line())
                terminal.warn([f"no answer; why, and the data as they are: {write_text(report, text)}"])
            raise
        terminal.show(done, json, files)
        if (failure := unanswered or done.failure) is not None:
            raise failure

    parameters = [
        inspect.Parameter(
            n,
            inspect.Parameter.KEYWORD_ONLY,
            annotation=told,
            default=inspect.Parameter.empty if default is ... else default,
        )
        for n, (told, default) in shown.items()
    ]
    run.__doc__ = about
    run.__dict__["__signature__"] = inspect.Signature(parameters)
    run.__annotations__ = {name: told for name, (told, _) in shown.items()}
    return run


def opened(
    texts: Sequence[str], vehicle: Vehicle, advance: Advance, columns: Sequence[str] | None = None, **how: Any
) -> list[Log]:
    """Logs read, checked and on the grid; `how` as `quadid.load` takes it."""
    from quadid.app import logs

    out, named = [], logs.parse_columns(columns or [])
    for k, text in enumerate(texts):
        advance(f"reading {Path(text).name}", k / len(texts))
        out.append(logs.load(text, vehicle, columns=named, **how))
    return out
