"""Reports of results: the pages, the quality of the logs and where everything came from."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from quadid.errors import QuadidError
from quadid.workflow.loading import LONGEST, open_recording
from quadid.workflow.parts import parse_cut

if TYPE_CHECKING:
    from quadid.identify.fit import Fit
    from quadid.inspection import Inspection
    from quadid.vehicle import Vehicle
    from quadid.window import Recording
    from quadid.workflow.diagnose import Diagnosed
    from quadid.workflow.health import HealthOutcome
    from quadid.workflow.identify import Identified
    from quadid.workflow.loading import Log

LIBRARY = "a call of the library"
"""Stands for the command line where there is none."""
_LIBRARIES = ("numpy", "numba", "scipy", "plotly")


def identify_html(done: Identified, command: str = LIBRARY) -> str:
    """The HTML report of an identification."""
    from quadid.report.figures import MOST_LOGS
    from quadid.report.flight_part import flight_section
    from quadid.report.identify_page import correlation_section, identify_page
    from quadid.report.page import render

    result, fit = done.result, done.fit
    rows = provenance(done.logs, command) + [
        {"name": "seed", "value": str(result["seed"])},
        {
            "name": "search",
            "value": f"{result['optimizer']}, {fit.evaluations} simulations of the data; {fit.outcome.value}",
        },
        {"name": "vehicle file", "value": result["vehicle_file"] or "not written"},
        {"name": "taken as known", "value": known(fit.vehicle)},
    ]
    page = identify_page(result, done.sets, fit.noise, [quality(log) for log in done.logs], rows)
    flights = [flight_section(log.recording, fit.vehicle, i) for i, log in enumerate(done.logs[:MOST_LOGS])]
    page["sections"] = [correlation_section(fit.parameters), *(f for f in flights if f is not None)]
    page["excitation"] = told(fit, [log for log, s in zip(done.logs, done.sets, strict=True) if s.role == "train"])
    return render(page)


def known(vehicle: Vehicle) -> str:
    """Mass and geometry that the result rests on."""
    return f"mass {vehicle.mass:g} kg, {len(vehicle.rotors)} rotors {vehicle.arm:.3g} m from the centre"


def told(fit: Fit, logs: Sequence[Log]) -> dict[str, Any]:
    """What the fitted logs can tell about each parameter, from `LONGEST` s of them at most."""
    from quadid.identify.excitation import excitation
    from quadid.report.excitation_part import excitation_part
    from quadid.window import beginning

    windows, seconds = beginning((w for log in logs for w in log.windows), LONGEST)
    return excitation_part(excitation(windows, fit.vehicle, fit.theta, fit.noise), seconds)


def failure_html(
    error: QuadidError, what: str, texts: Sequence[str], vehicle: Vehicle, preset: str, command: str = LIBRARY
) -> str:
    """The HTML report of an attempt that failed."""
    from quadid.inspection import inspect
    from quadid.report.failure_page import failure_page
    from quadid.report.page import render

    rows = provenance([], command)
    read: list[tuple[Recording, Inspection | None]] = []
    for text in texts:
        try:
            recording = open_recording(parse_cut(text).path, preset)
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


def diagnose_html(done: Diagnosed, command: str = LIBRARY) -> str:
    """The HTML report of a diagnosis."""
    from quadid.report.diagnose_page import diagnose_page
    from quadid.report.page import render

    rows = provenance(done.logs, command) + [
        {"name": "seed", "value": str(done.result["seed"])},
        {"name": "vehicle file", "value": done.result["vehicle_file"] or "not written"},
    ]
    logs = [quality(log) for log in done.logs]
    warnings = done.result["warnings"]
    return render(
        diagnose_page(done.result, done.nominal.name, done.sets, done.noise, logs, rows, warnings, done.maps())
    )


def health_html(done: HealthOutcome, command: str = LIBRARY) -> str:
    """The HTML report of a comparison with healthy flights."""
    import numpy as np

    from quadid.health.comparison import distance
    from quadid.health.trims import AXES
    from quadid.report.airframe_picture import airframe_picture
    from quadid.report.health_page import health_page, trim_figure
    from quadid.report.page import render

    found, healthy = done.found, done.found.healthy
    now = np.mean([flight.shares for flight in found.flights], axis=0)
    marked = done.result["changes"] if found.verdict == "changed" else ()
    picture = airframe_picture(done.vehicle, now.tolist(), healthy.shares.tolist(), marked)
    rows = [
        (role, flight.name, distance(flight.mean - healthy.mean, healthy.predictive(1), healthy.freedom).tolist())
        for role, part in (("measured", found.baseline), ("after", found.flights))
        for flight in part
    ]
    made = provenance([], command) + [
        {"name": recording.name, "value": f"sha256 {recording.sha256 or 'unknown'}"} for recording in done.recordings
    ]
    return render(health_page(done.result, picture, made, [trim_figure(rows, AXES)]))


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


def provenance(logs: Sequence[Log], command: str = LIBRARY) -> list[dict[str, str]]:
    """Files with hashes, versions, command line and time."""
    from quadid import __version__

    rows = [{"name": "command", "value": command}]
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
