"""`quadid diagnose`: what the simulation gets wrong, why, and what the better model gains."""

from __future__ import annotations

from pathlib import Path

from quadid.workflow.loading import GRID
from quadid_cli.options import (
    Columns,
    JsonTarget,
    Logs,
    OutFolder,
    Preset,
    Rate,
    ReportFile,
    Seed,
    SeriesKinds,
    Start,
    Stop,
    Unchecked,
    Validate,
    VehicleName,
)


def diagnose(
    logs: Logs,
    vehicle: VehicleName,
    validate: Validate = None,
    seed: Seed = 1,
    report: ReportFile = None,
    series: SeriesKinds = None,
    rate: Rate = None,
    start: Start = None,
    stop: Stop = None,
    preset: Preset = "auto",
    unchecked: Unchecked = False,
    columns: Columns = None,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Name what the simulation gets wrong, extend the model by it, and measure the gain on data the fit did not see."""
    from quadid.workflow import diagnose as work
    from quadid.workflow.loading import load_logs, load_vehicle, parse_columns
    from quadid.workflow.series import check_kinds
    from quadid_cli import output, tables, terminal
    from quadid_cli.explaining import explained

    check_kinds(series or ())
    output.check_file(json, "--json")
    output.check_file(report, "--report")
    described = load_vehicle(vehicle)
    folder = output.out_folder(out)
    hertz = GRID if rate is None else rate
    with explained(report, f"Diagnosis of {described.name}", [*logs, *(validate or [])], described, preset):
        train = load_logs(logs, described, hertz, start, stop, preset, unchecked, parse_columns(columns or []))
        held = load_logs(validate or [], described, hertz, start, stop, preset, unchecked, parse_columns(columns or []))
        with terminal.progress() as advance:
            done = work.diagnose(train, held, seed=seed, advance=advance)
    target = free_path(folder / done.file_name, vehicle)
    done.result["vehicle_file"] = str(output.write_text(target, done.vehicle.to_yaml()))
    if done.prediction is not None:
        predicts = free_path(folder / done.prediction_file_name, vehicle)
        done.result["prediction_file"] = str(output.write_text(predicts, done.prediction.to_yaml()))
    if report is not None:
        done.result["report"] = str(done.report(report, output.command_line()))
    if series:
        done.result["series"] = [str(path) for path in done.save_series(folder, series)]
    output.write_json(done.result, json)
    tables.print_outcome(terminal.console(quiet=json == "-"), done)


def free_path(path: Path, given: str) -> Path:
    """The path, or another where that would overwrite the vehicle file that was read."""
    if path.exists() and Path(given).exists() and path.samefile(given):
        return path.with_suffix(".new.yaml")
    return path
