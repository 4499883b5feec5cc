"""`quadid diagnose`: what the simulation gets wrong, why, and what the better model gains."""

from __future__ import annotations

from pathlib import Path

from quadid.app.logs import GRID, load_vehicle
from quadid.cli import options
from quadid.cli.explaining import explained


def diagnose(
    logs: options.Logs,
    vehicle: options.VehicleName,
    validate: options.Validate = None,
    seed: options.Seed = 1,
    report: options.ReportFile = None,
    series: options.SeriesFolder = None,
    rate: options.Rate = GRID,
    start: options.Start = None,
    stop: options.Stop = None,
    preset: options.Preset = "auto",
    unchecked: options.Unchecked = False,
    columns: options.Columns = None,
    json: options.JsonTarget = None,
    out: options.OutFolder = Path(),
) -> None:
    """Name what the simulation gets wrong, extend the model by it, and measure the gain on data the fit did not see."""
    from quadid.app import diagnose as work
    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    terminal.check_file(report, "--report")
    if series is not None:
        terminal.out_folder(series)
    described = load_vehicle(vehicle)
    read = options.reader(described, rate, start, stop, preset, unchecked, columns)
    folder = terminal.out_folder(out)
    with explained(report, f"Diagnosis of {described.name}", [*logs, *(validate or [])], described, preset):
        train, held = read(logs), read(validate or [])
        with terminal.progress() as advance:
            done = work.diagnose(train, held, seed=seed, advance=advance)
    files = {"vehicle": free_path(folder / done.file_name, vehicle)}
    terminal.conclude(done, json, report, files, series)


def free_path(path: Path, given: str) -> Path:
    """The path, or another where that would overwrite the vehicle file that was read."""
    if path.exists() and Path(given).exists() and path.samefile(given):
        return path.with_suffix(".new.yaml")
    return path
