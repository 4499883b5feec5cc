"""What a report says beside the result: the quality of the logs and where everything came from."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid.errors import QuadidError

if TYPE_CHECKING:
    from quadid.identify.fit import Fit
    from quadid.identify.result import ScoredSet
    from quadid.inspection import Inspection
    from quadid.vehicle import Vehicle
    from quadid.window import Recording
    from quadid_cli.diagnose import Diagnosed
    from quadid_cli.loading import Log

_LIBRARIES = ("numpy", "numba", "scipy", "plotly")


def identify_html(
    result: Mapping[str, Any],
    fit: Fit,
    sets: Sequence[ScoredSet],
    logs: Sequence[Log],
    truth: Mapping[str, float] | None = None,
) -> str:
    """The HTML report of an identification."""
    from quadid.report.identify_page import identify_page
    from quadid.report.page import render

    rows = provenance(logs) + [
        {"name": "seed", "value": str(result["seed"])},
        {
            "name": "search",
            "value": f"{result['optimizer']}, {fit.evaluations} simulations of the data; {fit.outcome.value}",
        },
        {"name": "vehicle file", "value": result["vehicle_file"]},
    ]
    page = identify_page(result, sets, fit.noise, [quality(log) for log in logs], rows, truth)
    page["excitation"] = told(fit, [log for log, s in zip(logs, sets, strict=True) if s.role == "train"])
    return render(page)


def told(fit: Fit, logs: Sequence[Log]) -> dict[str, Any]:
    """What the fitted logs can tell about each parameter, from `LONGEST` s of them at most."""
    from quadid.identify.excitation import excitation
    from quadid.report.excitation_part import excitation_part
    from quadid_cli.loading import LONGEST, beginning

    windows, seconds = beginning((w for log in logs for w in log.windows), LONGEST)
    return excitation_part(excitation(windows, fit.vehicle, fit.theta, fit.noise), seconds)


@contextmanager
def explained(
    report: Path | None, what: str, texts: Sequence[str], vehicle: Vehicle, preset: str
) -> Iterator[None]:  # fmt: skip
    """When the block fails for want of good data, the report says why and shows the data; the error goes on.

    Args:
        report: file to write; None for none.
        what: what was asked for, for the title.
        texts: logs as given on the command line.
        vehicle: its description.
        preset: topic names of ROS logs.
    """
    try:
        yield
    except QuadidError as error:
        if report is not None:
            from quadid_cli.output import write_text
            from quadid_cli.terminal import warn

            file = write_text(report, failure_html(error, what, texts, vehicle, preset))
            warn([f"no answer; why, and the data as they are: {file}"])
        raise


def failure_html(error: QuadidError, what: str, texts: Sequence[str], vehicle: Vehicle, preset: str) -> str:
    """The HTML report of an attempt that failed."""
    from quadid_replay import open_log

    from quadid.inspection import inspect
    from quadid.report.failure_page import failure_page
    from quadid.report.page import render
    from quadid_cli.loading import parse_cut

    rows = provenance([])
    read: list[tuple[Recording, Inspection | None]] = []
    for text in texts:
        try:
            recording = open_log(parse_cut(text).path, preset)
        except (QuadidError, OSError) as unreadable:
            rows.append({"name": text, "value": f"cannot be read: {unreadable}"})
            continue
        rows.append({"name": text, "value": f"sha256 {recording.sha256 or 'unknown'}"})
        try:
            read.append((recording, inspect(recording, vehicle)))
        except QuadidError as unclear:
            rows.append({"name": f"{text}, inspection", "value": str(unclear)})
            read.append((recording, None))
    return render(failure_page(what, error.found, error.fix, read, rows, error.allowed))


def diagnose_html(done: Diagnosed, vehicle: str, seed: int) -> str:
    """The HTML report of a diagnosis."""
    from quadid.report.diagnose_page import diagnose_page
    from quadid.report.page import render

    rows = provenance(done.logs) + [
        {"name": "seed", "value": str(seed)},
        {"name": "vehicle file", "value": done.result["vehicle_file"]},
    ]
    logs = [quality(log) for log in done.logs]
    warnings = done.result["warnings"]
    return render(diagnose_page(done.result, vehicle, done.sets, done.noise, logs, rows, warnings, done.maps()))


def quality(log: Log) -> dict[str, Any]:
    """What one log offered and what of it was used."""
    from quadid.resample import sample_period

    grid = log.grid
    summary = [
        f"{grid.seconds_used:.1f} of {grid.seconds_log:.1f} s used, on a {grid.rate:.4g} Hz grid",
        f"{grid.gaps} gap{'s' * (grid.gaps != 1)}" if grid.gaps else "no gaps",
        f"rotor signal {grid.rotor_source} at {grid.rotor_rate:.3g} Hz",
        "all channels low-passed alike for the grid" if grid.filtered else "no filtering",
    ]
    channels = [
        {
            "name": c.name,
            "rate": 1.0 / sample_period(c.t) if len(c.t) > 1 else None,
            "samples": len(c.t),
            "source": c.source,
            "faults": ", ".join(f"{n} {why.replace('_', ' ')}" for why, n in c.faults.items()),
        }
        for c in log.recording.channels.values()
    ]
    return {"name": log.recording.name, "format": log.recording.format, "summary": summary, "channels": channels}


def provenance(logs: Sequence[Log]) -> list[dict[str, str]]:
    """Files with hashes, versions, command line and time."""
    from quadid import __version__

    rows = [{"name": "command", "value": shlex.join(["quadid", *sys.argv[1:]])}]
    rows.append({"name": "made", "value": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M:%S UTC")})
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    rows.append(
        {
            "name": "versions",
            "value": f"quadid {__version__}, Python {platform.python_version()}, " + ", ".join(versions),
        }
    )
    for log in logs:
        rows.append({"name": log.recording.name, "value": f"{log.path}  sha256 {log.recording.sha256 or 'unknown'}"})
    return rows
