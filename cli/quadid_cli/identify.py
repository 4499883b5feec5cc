"""`quadid identify`: fits the parameters of a vehicle to flight logs, and scores the fit on them and on others."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.errors import NotIdentifiableError
from quadid.sanitise import LONGEST_LINE, plain
from quadid_cli.options import (
    JsonTarget,
    Logs,
    OutFolder,
    Preset,
    Rate,
    ReportFile,
    Seed,
    Start,
    Stop,
    Unchecked,
    Validate,
    VehicleName,
)
from quadid_cli.searching import OPTIMIZERS, check_optimizer, search

if TYPE_CHECKING:
    from quadid.identify.controller_gains import Autopilot
    from quadid.identify.fit import Fit
    from quadid.identify.result import ScoredSet
    from quadid.vehicle import Vehicle
    from quadid_cli.loading import Log
    from quadid_cli.terminal import Advance

GRID = 50.0
"""Rate of the grid unless asked otherwise [Hz], as in the paper."""


@dataclass(frozen=True)
class Identified:
    """Everything that one identification produced.

    Attributes:
        result: of the form ``quadid.identify/1``.
        fit: the fit itself.
        sets: scored logs, for pictures.
        logs: as loaded, training logs first.
    """

    result: dict[str, Any]
    fit: Fit
    sets: list[ScoredSet]
    logs: list[Log]


def identify(
    logs: Logs,
    vehicle: VehicleName,
    validate: Validate = None,
    optimizer: Annotated[
        str, typer.Option("--optimizer", metavar="NAME", help="How to search: " + ", ".join(OPTIMIZERS) + ".")
    ] = OPTIMIZERS[0],
    seed: Seed = 1,
    report: ReportFile = None,
    rate: Rate = None,
    start: Start = None,
    stop: Stop = None,
    preset: Preset = "auto",
    unchecked: Unchecked = False,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Fit b, d, J_xx, J_yy, J_zz and J_r to flight logs; say how well each is known and how well they predict."""
    from quadid_cli import loading, output, terminal
    from quadid_cli.reporting import explained

    check_optimizer(optimizer)
    output.check_file(json, "--json")
    output.check_file(report, "--report")
    described = loading.load_vehicle(vehicle)
    target = fitted_path(output.out_folder(out), described, vehicle)
    hertz = GRID if rate is None else rate
    with explained(report, f"Identification of {described.name}", [*logs, *(validate or [])], described, preset):
        train = loading.load_logs(logs, described, hertz, start, stop, preset, unchecked)
        held = loading.load_logs(validate or [], described, hertz, start, stop, preset, unchecked)
        with terminal.progress() as advance:
            done = run(described, train, held, optimizer, seed, target, advance)
    if report is not None:
        done.result["report"] = str(report.absolute())
        write_report(report, done)
    output.write_json(done.result, json)
    show(done.result, quiet=json == "-")
    terminal.warn(done.result["warnings"])
    check_answer(done.fit)


def fitted_path(folder: Path, vehicle: Vehicle, given: str) -> Path:
    """Where the fitted vehicle file goes; raises OutputError when that would overwrite the file it was made from."""
    from quadid_cli.output import OutputError

    path = folder / f"{file_name(vehicle.name)}.fitted.yaml"
    if path.exists() and Path(given).exists() and path.samefile(given):
        raise OutputError(f"the result would overwrite {given}", "another folder", "give --out, or rename the vehicle")
    return path


def file_name(name: str) -> str:
    """A vehicle's name as part of a file name: letters, digits and ``-_+.`` only."""
    return "".join(c if c.isalnum() or c in "-_+." else "_" for c in name).lstrip(".")[:100] or "vehicle"


def run(
    vehicle: Vehicle, train: Sequence[Log], held: Sequence[Log], optimizer: str, seed: int, target: Path,
    advance: Advance,
) -> Identified:  # fmt: skip
    """Fits, scores, and writes the fitted vehicle file.

    Args:
        vehicle: initial guess and known effects.
        train: logs to fit.
        held: logs to score only.
        optimizer: one of `searching.OPTIMIZERS`.
        seed: of all random numbers.
        target: the vehicle file to write.
        advance: told how far the fit is.
    """
    from quadid.identify.controller_gains import find_autopilot
    from quadid.identify.result import bound_by_file, fitted_vehicle, identify_result, mask_unidentifiable
    from quadid_cli.output import write_text

    begin = time.perf_counter()
    fit = search(optimizer, [w for log in train for w in log.windows], vehicle, seed, advance)
    fit = bound_by_file(mask_unidentifiable(fit, out_of_reach(train)))
    seconds = time.perf_counter() - begin
    autopilot = find_autopilot([w for log in train for w in log.windows], vehicle)
    sets = [scored(log, role, fit, autopilot) for role, part in (("train", train), ("validate", held)) for log in part]
    text = vehicle_header(train) + fitted_vehicle(fit).to_yaml()
    warnings = [text for log in (*train, *held) for text in log.warnings]
    result = identify_result(fit, optimizer, seed, seconds, sets, str(write_text(target, text)), warnings)
    return Identified(result, fit, sets, [*train, *held])


def out_of_reach(logs: Sequence[Log]) -> dict[str, str]:
    """Parameters that no log can tell, because a channel is missing or too slow, each with the reason."""
    from quadid.inspection.outlook import parameter_outlook
    from quadid.inspection.timing import channel_facts

    outlooks = [parameter_outlook(channel_facts(log.recording)) for log in logs]
    each = [{o.parameter: o.reason for o in outlook if not o.possible} for outlook in outlooks]
    return {name: each[0][name] for name in each[0] if all(name in one for one in each)} if each else {}


def scored(log: Log, role: str, fit: Fit, autopilot: Autopilot | None) -> ScoredSet:
    """Scores the initial guess and the fit on one log; as the paper does, too, where the stabiliser is known."""
    from quadid.identify.paper_objective import paper_score
    from quadid.identify.result import ScoredSet
    from quadid.identify.score import mse_score
    from quadid.model.layout import Layout

    initial = Layout(fit.vehicle).initial(fit.vehicle)
    before, after = (mse_score(log.windows, fit.vehicle, theta, fit.noise) for theta in (initial, fit.theta))
    flown = [paper_score(log.windows, fit.vehicle, theta, autopilot) for theta in (initial, fit.theta)]
    paper = None if flown[0] is None or flown[1] is None else (flown[0].mse, flown[1].mse)
    return ScoredSet(log.recording.name, role, before, after, paper)


def vehicle_header(logs: Sequence[Log]) -> str:
    """Comment lines that say what a fitted vehicle file was made from."""
    from quadid import __version__

    lines = [f"Fitted by quadid {__version__}; `initial` is the fitted value, `sigma` its standard deviation. From:"]
    lines += [f"  {log.recording.name}  sha256 {log.recording.sha256 or 'unknown'}" for log in logs]
    return "".join(f"# {plain(line, LONGEST_LINE)}\n" for line in lines)


def show(result: Mapping[str, Any], quiet: bool) -> None:
    """Prints the result for people."""
    from quadid.report.verdict import identify_verdict
    from quadid_cli import tables, terminal

    console = terminal.console(quiet)
    tables.print_parameters(console, result["parameters"])
    tables.print_sets(console, result["sets"])
    tables.print_verdict(console, identify_verdict(result))
    for key, label in (("vehicle_file", "Vehicle file"), ("report", "Report")):
        if key in result:
            console.print(f"{label}: {result[key]}", soft_wrap=True)


def check_answer(fit: Fit) -> None:
    """Raises NotIdentifiableError when the data say nothing about any parameter."""
    from quadid.identify.result import answered

    if not answered(fit.parameters):
        raise NotIdentifiableError(
            "the data say nothing about any parameter",
            "a flight that moves in roll, pitch, yaw and height",
            "fly what `quadid excite` proposes; results were written, but they are the initial guess",
        )


def write_report(path: Path, done: Identified) -> None:
    """Writes the HTML report."""
    from quadid_cli.output import write_text
    from quadid_cli.reporting import identify_html

    write_text(path, identify_html(done.result, done.fit, done.sets, done.logs))
