"""`quadid score`: open-loop prediction error of a vehicle file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from quadid_cli.options import JsonTarget, Logs, OutFolder, OwnRate, Preset, Start, Stop, Unchecked, VehicleName


def score(
    logs: Logs,
    vehicle: VehicleName,
    horizons: Annotated[
        str, typer.Option("--horizons", metavar="H,H,...", help="Samples after the start of each run.")
    ] = "1,10,50",
    rate: OwnRate = None,
    start: Start = None,
    stop: Stop = None,
    preset: Preset = "auto",
    unchecked: Unchecked = False,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Open-loop prediction error after h samples: every sample starts one run from the measured state."""
    from quadid.identify.prediction import horizon_scores
    from quadid.identify.result import score_result
    from quadid.model.layout import Layout
    from quadid_cli import loading, output, tables, terminal

    output.check_file(json, "--json")
    wanted = parse_horizons(horizons)
    described = loading.load_vehicle(vehicle)
    opened = loading.load_logs(logs, described, rate, start, stop, preset, unchecked)
    theta = Layout(described).initial(described)
    pooled, each = horizon_scores([log.windows for log in opened], described, theta, wanted)
    files = [(log.recording.name, log.grid.gaps, one) for log, one in zip(opened, each, strict=True)]
    result = score_result(described.name, pooled, files)
    output.write_json(result, json)
    tables.print_horizons(terminal.console(quiet=json == "-"), result)
    terminal.warn([text for log in opened for text in log.warnings])


def parse_horizons(text: str) -> list[int]:
    """Reads ``1,10,50``; raises ParameterError for anything but whole numbers."""
    from quadid.errors import ParameterError

    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ParameterError(
            f"--horizons {text}", "whole numbers of samples", "for example --horizons 1,10,50"
        ) from error
