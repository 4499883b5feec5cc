"""What every report holds: the quality of the logs and where everything came from; and the page of a failure."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadid.errors import QuadidError
from quadid_workflow.files import write_text
from quadid_workflow.loading import LONGEST, open_recording
from quadid_workflow.log_parts import parse_part
from quadid_workflow.outcome import Outcome

if TYPE_CHECKING:
    from quadid.identify.fit import Fit
    from quadid.identify.result import ScoredSet
    from quadid.inspection import Inspection
    from quadid.vehicle import Vehicle
    from quadid.window import Recording
    from quadid_workflow.loading import Log
    from quadid_workflow.missing import MissingForces

LIBRARY = "a call of the library"
"""Stands for the command line where there is none."""
_LIBRARIES = ("numpy", "numba", "scipy", "plotly")


class Reported(Outcome):
    """A result that has an HTML report."""

    @abstractmethod
    def page(self, command: str = LIBRARY) -> str:
        """The report as HTML; `command` is the command line that led to it, if one did."""

    def report(self, path: str | Path, command: str = LIBRARY) -> Path:
        """Writes the HTML report, as `page`."""
        return write_text(path, self.page(command))


class Fitted(Reported):
    """A result from logs that were fitted and scored.

    Attributes:
        sets: scored logs, for pictures.
        logs: the same ones as loaded, training logs first.
        forces: what the models miss on them; None where no gyro or accelerometer shows it.
    """

    sets: list[ScoredSet]
    logs: list[Log]
    forces: MissingForces | None

    @property
    def train(self) -> list[Log]:
        """The logs that were fitted."""
        return [log for log, s in zip(self.logs, self.sets, strict=True) if s.role == "train"]

    def save_series(self, folder: str | Path = ".", kinds: Sequence[str] = ("mcap",)) -> list[Path]:
        """Writes measured and simulated outputs of every log as mcap or csv, and what is missing as csv."""
        from quadid_workflow.series import save_series

        missing = [] if self.forces is None else self.forces.save(folder)
        return [*save_series(self.sets, self.logs, folder, kinds), *missing]


def known(vehicle: Vehicle) -> str:
    """Mass and geometry that the result rests on."""
    return f"mass {vehicle.mass:g} kg, {len(vehicle.rotors)} rotors {vehicle.arm:.3g} m from the centre"


def told(fit: Fit, logs: Sequence[Log]) -> dict[str, Any]:
    """What the fitted logs can tell about each parameter, from `LONGEST` s of them at most."""
    from quadid_report.excitation_part import excitation_part

    from quadid.identify.excitation import excitation
    from quadid.window import beginning

    windows, seconds = beginning((w for log in logs for w in log.windows), LONGEST)
    return excitation_part(excitation(windows, fit.vehicle, fit.theta, fit.noise), seconds)


def failure_html(
    error: QuadidError, what: str, texts: Sequence[str], vehicle: Vehicle, preset: str, command: str = LIBRARY
) -> str:
    """The HTML report of an attempt that failed."""
    from quadid_report.failure_page import failure_page
    from quadid_report.page import render

    from quadid.inspection import inspect

    rows = provenance([], command)
    read: list[tuple[Recording, Inspection | None]] = []
    for text in texts:
        try:
            recording = open_recording(parse_part(text).path, preset)
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


def quality(log: Log) -> dict[str, Any]:
    """What one log offered and what of it was used."""
    from quadid_report.page import number
    from quadid_report.parts import measures

    from quadid.resample import sample_period

    grid = log.grid
    summary = [
        f"{grid.seconds_used:.1f} of {grid.seconds_log:.1f} s used, on a {grid.rate:.4g} Hz grid",
        f"{grid.gaps} gap{'s' * (grid.gaps != 1)}" if grid.gaps else "no gaps",
        f"rotor signal {grid.rotor_source} at {grid.rotor_rate:.3g} Hz",
        "all channels low-passed alike for the grid" if grid.filtered else "no filtering",
    ]
    rows = [
        (
            c.name, f"{number(1.0 / sample_period(c.t) if len(c.t) > 1 else None, 3)} Hz", str(len(c.t)), c.source,
            ", ".join(f"{n} {why.replace('_', ' ')}" for why, n in c.faults.items()) or "none",
        )
        for c in log.recording.channels.values()
    ]  # fmt: skip
    channels = measures(("Channel", "Rate", "Samples", "Source", "Dropped"), rows, (1, 2))
    return {"name": log.recording.name, "format": log.recording.format, "summary": summary, "channels": channels}


def provenance(logs: Sequence[Log], command: str = LIBRARY) -> list[dict[str, str]]:
    """Files with hashes, versions, command line and time."""
    from quadid import __version__

    versions = [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    rows = [
        ("command", command),
        ("made", f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M:%S UTC}"),
        ("versions", ", ".join([f"quadid {__version__}", f"Python {platform.python_version()}", *versions])),
        *((log.name, f"{log.path}  sha256 {log.recording.sha256 or 'unknown'}") for log in logs),
    ]
    return [{"name": name, "value": value} for name, value in rows]
