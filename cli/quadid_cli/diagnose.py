"""`quadid diagnose`: what the simulation gets wrong, why, and what the better model gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid_cli.identify import GRID, file_name, vehicle_header
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

if TYPE_CHECKING:
    from quadid.diagnose.pipeline import Workings
    from quadid.identify.noise_model import NoiseModel
    from quadid.identify.result import ScoredSet
    from quadid.report.residual_maps import ResidualMap
    from quadid.vehicle import Vehicle
    from quadid_cli.loading import Log
    from quadid_cli.terminal import Advance


@dataclass(frozen=True)
class Diagnosed:
    """Everything that one diagnosis produced.

    Attributes:
        result: of the form ``quadid.diagnose/1``.
        sets: logs scored without and with the findings.
        noise: estimated sensor noise.
        logs: as loaded, diagnosed ones first.
        vehicle: nominal vehicle.
        workings: everything that led to the result.
    """

    result: dict[str, Any]
    sets: list[ScoredSet]
    noise: NoiseModel
    logs: list[Log]
    vehicle: Vehicle
    workings: Workings

    def maps(self) -> dict[str, ResidualMap]:
        """What every cause looks like in the residual of the diagnosed logs, by name of the effect."""
        from quadid.report.residual_maps import residual_map

        count = sum(s.role == "train" for s in self.sets)
        windows = [w for log in self.logs[:count] for w in log.windows]
        model = self.workings.search.model
        drawn = {
            c.effect: residual_map(windows, self.vehicle, model.theta, c.effect, c.names, self.noise)
            for c in model.causes
        }
        return {effect: one for effect, one in drawn.items() if one is not None}


def diagnose(
    logs: Logs,
    vehicle: VehicleName,
    validate: Validate = None,
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
    """Name what the simulation gets wrong, extend the model by it, and measure the gain on data the fit did not see."""
    from quadid_cli import loading, output, terminal
    from quadid_cli.reporting import explained

    output.check_file(json, "--json")
    output.check_file(report, "--report")
    described = loading.load_vehicle(vehicle)
    folder = output.out_folder(out)
    hertz = GRID if rate is None else rate
    with explained(report, f"Diagnosis of {described.name}", [*logs, *(validate or [])], described, preset):
        train = loading.load_logs(logs, described, hertz, start, stop, preset, unchecked)
        held = loading.load_logs(validate or [], described, hertz, start, stop, preset, unchecked)
        with terminal.progress() as advance:
            done = run(described, train, held, seed, folder, vehicle, advance)
    if report is not None:
        from quadid_cli.reporting import diagnose_html

        done.result["report"] = str(output.write_text(report, diagnose_html(done, described.name, seed)))
    output.write_json(done.result, json)
    show(done.result, quiet=json == "-")
    terminal.warn(done.result["warnings"])


def run(
    vehicle: Vehicle, train: Sequence[Log], held: Sequence[Log], seed: int, folder: Path, given: str, advance: Advance
) -> Diagnosed:
    """Diagnoses, scores without and with the findings, and writes the extended vehicle file.

    Args:
        vehicle: nominal vehicle.
        train: logs to diagnose.
        held: logs to measure the gain on.
        seed: of all random numbers.
        folder: for the vehicle file.
        given: name of the vehicle file that was read, which is never overwritten.
        advance: told how far it is.
    """
    from quadid.diagnose import diagnose as diagnose_windows
    from quadid_cli.output import write_text
    from quadid_cli.searching import check_length

    windows, unseen = ([w for log in part for w in log.windows] for part in (train, held))
    check_length(windows)
    found, workings = diagnose_windows(windows, vehicle, unseen, seed, advance)
    target = extended_path(folder, found.vehicle_name, bool(found.findings), given)
    result = found.to_dict(str(write_text(target, vehicle_header(train) + found.vehicle_yaml)))
    result["warnings"] = [*result.get("warnings", []), *(text for log in (*train, *held) for text in log.warnings)]
    sets = [
        scored(log, role, vehicle, workings) for role, part in (("train", train), ("validate", held)) for log in part
    ]
    return Diagnosed(result, sets, workings.decisive.noise, [*train, *held], vehicle, workings)


def extended_path(folder: Path, name: str, extended: bool, given: str) -> Path:
    """Where the vehicle file goes: ``pelican+motor_lag.yaml``, or ``pelican.fitted.yaml`` without findings."""
    path = folder / f"{file_name(name)}{'' if extended else '.fitted'}.yaml"
    if path.exists() and Path(given).exists() and path.samefile(given):
        return path.with_suffix(".new.yaml")
    return path


def scored(log: Log, role: str, vehicle: Vehicle, workings: Workings) -> ScoredSet:
    """Scores the model without and with the findings on one log."""
    from quadid.identify.result import ScoredSet
    from quadid.identify.score import mse_score

    models = workings.search.nominal.theta, workings.search.model.theta
    before, after = (mse_score(log.windows, vehicle, theta, workings.decisive.noise) for theta in models)
    return ScoredSet(log.recording.name, role, before, after)


def show(result: Mapping[str, Any], quiet: bool) -> None:
    """Prints the verdict and the findings for people."""
    from quadid.report.diagnose_page import diagnose_verdict
    from quadid_cli import tables, terminal

    console = terminal.console(quiet)
    if result["findings"]:
        tables.print_findings(console, result["findings"])
    tables.print_verdict(console, diagnose_verdict(result))
    for key, label in (("vehicle_file", "Vehicle file"), ("report", "Report")):
        if result.get(key):
            console.print(f"{label}: {result[key]}", soft_wrap=True)
