"""Results of the library: tables, data frame, JSON, and the parts every report has."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import platform
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from markupsafe import Markup
from quadid_replay import write_compared
from quadid_replay.columns import from_euler

from quadid.app.logs import LONGEST, Log, free_name, write_text, written_whole
from quadid.app.missing import Beside, MissingForces, recorded
from quadid.app.over_time import OverTime, imported
from quadid.chi_square import Z95
from quadid.data.window import CHANNEL_NAMES, beginning, sample_period
from quadid.errors import LogError, NotIdentifiableError
from quadid.jsonable import jsonable
from quadid.report.page import measures, number, part, quiet, render
from quadid.report.tables import Cell, TextTable
from quadid.report.verdict import Verdict
from quadid.types import Json, JsonDict
from quadid.vehicle import Vehicle
from quadid.version import __version__

if TYPE_CHECKING:
    import pandas as pd

    from quadid.identification.fit import Fit
    from quadid.identification.result import ScoredSet

# --- How long work reports how far it is


Advance = Callable[[str, float], None]
"""Called with the name of a stage and the share of it done, 0..1."""


def silent(stage: str, share: float) -> None:
    """Takes no notice."""


# --- What every result of the library offers: tables as text and HTML, a data frame, JSON


class Outcome(ABC):
    """A result that prints as its command prints it.

    Attributes:
        title: what was asked for, for the page of a failure; empty where there is none.
        endings: of files that it writes under the names of its vehicle and logs, `*` for what is not known before.
        rows: entry of `result` that is the main table.
        columns: of a main table that may have no row; else they are those of its rows.
        result: plain data of the command's JSON, without the files that only the command writes.
    """

    title: ClassVar[str] = ""
    endings: ClassVar[tuple[str, ...]] = ()
    rows: ClassVar[str] = ""
    columns: ClassVar[tuple[str, ...]] = ()
    result: dict[str, Any]

    def tables(self) -> list[TextTable]:
        """The tables that the command prints, in order."""
        return []

    @property
    def verdict(self) -> Verdict | None:
        """Meaning of the result and the next step; None where the numbers speak alone."""
        return None

    @property
    def opening(self) -> list[Cell]:
        """Lines above the tables."""
        return []

    @property
    def sentences(self) -> list[Cell]:
        """Sentences below the tables."""
        return []

    @property
    def warnings(self) -> list[str]:
        """Remarks for the user, from logs and from the work itself."""
        return list(self.result.get("warnings", ()))

    @property
    def failure(self) -> Exception | None:
        """Error with which the command ends once it has shown this; None where it is what was asked for."""
        return None

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """Writes the files of the command and names them in `result`.

        Args:
            kept: vehicle file that was read, which is not overwritten.

        Returns:
            What each file is, and its absolute path.
        """
        return []

    def text(self, width: int = 100) -> str:
        """Tables, verdict and warnings, for a page of `width` columns."""
        parts = ["\n".join(cell.text for cell in self.opening), *(table.text(width) for table in self.tables())]
        parts.append("\n".join(cell.text for cell in self.sentences))
        parts += ["\n".join(self.verdict.lines())] if self.verdict is not None else []
        return "\n\n".join(filter(None, [*parts, *(f"warning: {warning}" for warning in self.warnings)]))

    def __repr__(self) -> str:
        return self.text()

    def _repr_html_(self) -> str:
        verdict = [] if self.verdict is None else self.verdict.lines()
        parts = [f"<p><b>{escape(cell.text)}</b></p>" for cell in self.opening]
        parts += [table.html() for table in self.tables()]
        parts += [f"<p>{escape(cell.text)}</p>" for cell in self.sentences]
        parts += [f"<p><b>{escape(line)}</b></p>" for line in verdict[:1]]
        below = [*verdict[1:], *(f"warning: {warning}" for warning in self.warnings)]
        return "".join([*parts, *(f"<p>{escape(line)}</p>" for line in below)])

    def to_json(self, path: str | Path | None = None) -> str:
        """The result as JSON text; with `path` also written there."""
        text = json_text(self.result)
        if path is not None:
            write_text(path, text)
        return text

    def to_frame(self) -> pd.DataFrame:
        """The main table with plain numbers as a pandas data frame, whose rows are found by their names, if any."""
        pandas = imported("pandas")
        frame = pandas.DataFrame(self.records(), columns=self.columns or None)
        if "name" in frame:
            frame.index = pandas.Index(frame["name"].to_numpy())
        return frame

    def records(self) -> list[dict[str, Any]]:
        """Rows of the main table with plain numbers."""
        return [dict(row) for row in self.result.get(self.rows, ())]


class UnansweredError(NotIdentifiableError):
    """The data say nothing about any parameter; `outcome` holds what there is, which is the initial guess."""

    def __init__(self, outcome: Outcome) -> None:
        self.outcome = outcome
        super().__init__(
            "the data reveal no parameter",
            "a flight that moves in roll, pitch, yaw and height",
            "fly what `quadid excite` proposes; results were written, but they are the initial guess",
        )


NUMBER_COLUMNS = ("name", "effect", "confident", "parameter", "unit", "value", "sigma", "low", "high")
"""Columns of a table with one row a number of a finding."""


def number_rows(found: Sequence[Json], columns: Sequence[str]) -> list[dict[str, Any]]:
    """Each number of each finding with these columns: `NUMBER_COLUMNS`, and entries of the finding or its gain."""
    out = []
    for one in found:
        for p in one["parameters"]:
            low, high = p["ci95"] or (None, None)
            sigma = None if low is None or high is None else (high - low) / (2.0 * Z95)
            number = {"unit": p["unit"], "value": p["value"], "sigma": sigma, "low": low, "high": high}
            name = {"name": f"{one['effect']}.{p['name']}", "parameter": p["name"]}
            row = {**one, **one.get("gain", {}), **name, **number}
            out.append({column: row[column] for column in columns})
    return out


def with_ends(entry: Json) -> dict[str, Any]:
    """An entry of a result with the two ends of its interval as columns of a table."""
    low, high = entry["ci95"]
    return {**{k: v for k, v in entry.items() if k != "ci95"}, "low": low, "high": high}


def json_text(result: Any) -> str:
    """A result as JSON for people and programs; numbers that JSON has no word for become null."""
    text = json.dumps(jsonable(result), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    if text.isascii():
        return text
    # JSON's escape of what does not print: a terminal acts on some characters, and no file holds a surrogate.
    return re.sub(r"[^\x20-\x7e\n]", lambda m: m[0] if m[0].isprintable() else json.dumps(m[0])[1:-1], text)


# --- Simulated against measured outputs of scored logs as files, for PlotJuggler, Foxglove and programs of one's own


_CHANNELS = {"gyro": 0, "attitude": 3, "accel": 6, "velocity": 9, "position": 12}
"""First of the three columns of each channel in a `quadid.identification.result.Series`."""
YAW = 5
"""Its column of the yaw, which is unwrapped."""


# --- What every report holds: the quality of the logs and where everything came from; and the page of a failure


LIBRARY = "a call of the library"
"""Stands for the command line where there is none."""
_LIBRARIES = ("numpy", "numba", "scipy", "plotly")


class Reported(Outcome):
    """A result that has an HTML report.

    Attributes:
        page_name: of the report that the command always writes into its folder; empty where `--report` names it.
    """

    page_name: ClassVar[str] = ""

    @abstractmethod
    def page(self, command: str = LIBRARY) -> str:
        """The report as HTML; `command` is the command line that led to it, if one did."""

    def report(self, path: str | Path, command: str = LIBRARY) -> Path:
        """Writes the HTML report, as `page`."""
        return write_text(path, self.page(command))

    def rendered(self, title: str, subtitle: str, sections: Sequence[Json | None], origin: Sequence[Json]) -> str:
        """A page of the sections that there are below the verdict; `origin` as of `provenance`."""
        return render(
            {
                "title": title,
                "subtitle": subtitle,
                "verdict": None if self.verdict is None else asdict(self.verdict),
                "sections": [s for s in sections if s],
                "warnings": self.warnings,
                "provenance": origin,
            }
        )


@dataclass(frozen=True, repr=False)
class Fitted(Reported):
    """A result from logs that were fitted and scored.

    Attributes:
        over_time: endings of what `save_series` writes.
        sets: scored logs, for pictures.
        logs: the same ones as loaded, training logs first.
        forces: what the models miss on them; None where no gyro or accelerometer shows it.
        beside: what acts beside the values of the vehicle file.
    """

    endings = ("*.yaml",)
    over_time: ClassVar[tuple[str, ...]] = (".*simulated.*", ".*missing.csv")
    result: dict[str, Any]
    sets: list[ScoredSet]
    logs: list[Log]
    forces: MissingForces | None
    beside: Beside | None

    @property
    @abstractmethod
    def vehicle(self) -> Vehicle:
        """The vehicle with what was found; ``vehicle.save("mine.yaml")`` writes it."""

    @property
    @abstractmethod
    def file_name(self) -> str:
        """Name of the vehicle file."""

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """Writes the vehicle file, under another name where it would overwrite the one that was read."""
        path = folder / self.file_name
        if kept is not None and path.exists() and Path(kept).exists() and path.samefile(kept):
            path = path.with_suffix(".new.yaml")
        path = write_text(path, self.vehicle.to_yaml())
        self.result["vehicle_file"] = str(path)
        return [("Vehicle file", path)]

    @property
    def train(self) -> list[Log]:
        """The logs that were fitted."""
        return [log for log, s in zip(self.logs, self.sets, strict=True) if s.role == "train"]

    def used(self, task: str) -> str:
        """Numbers of logs that were fitted, as `task` has it, and held out."""
        fitted = len(self.train)
        held = len(self.logs) - fitted or "none"
        return f"{fitted} log{'s' * (fitted != 1)} {task}, {held} held out for validation"

    def residuals(self, log: int = -1) -> OverTime:
        """Measured and simulated outputs of one log in runs of a second, their difference, and the sensors' sigma.

        Args:
            log: which of the logs, in the order given, training logs first; -1 is the last.
        """
        series = self.sets[log].fitted.series
        left, sigma = series.measured - series.simulated, np.broadcast_to(series.sigma, series.measured.shape)
        if left.shape[1] > YAW:
            left[:, YAW] = np.angle(np.exp(1j * left[:, YAW]))
        values = {"measured": series.measured, "simulated": series.simulated, "residual": left, "sigma": sigma}
        return OverTime(series.t, values, dict.fromkeys(values, ("output", CHANNEL_NAMES[: left.shape[1]])))

    def missing(self, log: int = -1, model: str | None = None) -> OverTime:
        """Missing force [N] and moment [N m] of one log in body axes, and innovations of the filter, with sigma.

        Args:
            log: which of the logs, in the order given, training logs first; -1 is the last.
            model: ``nominal``, or of a diagnosis ``extended``; the last of them by default.

        Raises:
            LogError: a log without gyro or accelerometer, or a model without a finite answer.
            ParameterError: another model.
        """
        if self.forces is None:
            raise LogError("no missing force is known", "logs with gyro and accelerometer, a model that follows them")
        return self.forces.over_time(log, model)

    def save_series(self, folder: str | Path = ".") -> list[Path]:
        """Writes what was measured, simulated and is missing over time, as CSV and MCAP; returns absolute paths.

        ``LOG.simulated.csv`` and ``.mcap`` hold the measurement and both simulations, which start anew every second;
        the MCAP also what is missing and innovations, which are in ``LOG.missing.csv``.

        Raises:
            LogError: a file that cannot be written.
        """
        Path(folder).mkdir(parents=True, exist_ok=True)
        out: list[Path] = []
        for i, (scored, log) in enumerate(zip(self.sets, self.logs, strict=True)):
            t, measured = scored.fitted.series.t, scored.fitted.series.measured
            simulated, before = scored.fitted.series.simulated, scored.initial.series.simulated
            parts = {}
            for name, values in (("measured", measured), ("simulated", simulated), ("before", before)):
                three = {c: values[:, k : k + 3] for c, k in _CHANNELS.items() if k < values.shape[1]}
                three |= {"attitude": from_euler(three["attitude"])} if "attitude" in three else {}
                parts[name] = recorded(log.name, t, three, "simulation")
            epoch = round(1e9 * (log.recording.epoch or 0.0))
            table, bag = (free_name(folder, log.name, f"simulated.{kind}", out) for kind in ("csv", "mcap"))
            with written_whole(table) as path:
                write_compared(path, parts, epoch)
            beside = {} if self.forces is None else self.forces.innovations(i)
            with written_whole(bag) as path:
                write_compared(path, parts | beside, epoch, None if self.forces is None else self.forces.wrenches(i))
            out += [table, bag]
        return [*out, *([] if self.forces is None else self.forces.save(folder))]


def known(vehicle: Vehicle) -> str:
    """Mass and geometry that the result rests on."""
    return f"mass {vehicle.mass:g} kg, {len(vehicle.rotors)} rotors {vehicle.arm:.3g} m from the centre"


def told(fit: Fit, logs: Sequence[Log]) -> dict[str, Any]:
    """Information of the fitted logs about each parameter, from `LONGEST` s of them at most."""
    from quadid.identification.uncertainty import excitation
    from quadid.report.fit_pages import excitation_part

    windows, seconds = beginning((w for log in logs for w in log.windows), LONGEST)
    return excitation_part(excitation(windows, fit.vehicle, fit.theta, fit.noise), seconds)


def quality(log: Log) -> JsonDict:
    """Contents of one log and their use, as part of a page."""
    grid = log.grid
    summary = [
        f"{grid.seconds_used:.1f} of {grid.seconds_log:.1f} s used, on a {grid.rate:.4g} Hz grid",
        f"{grid.gaps} gap{'s' * (grid.gaps != 1)}" if grid.gaps else "no gaps",
        f"rotor signal {grid.rotor_source} at {grid.rotor_rate:.3g} Hz",
        "all channels low-passed alike for the grid" if grid.filtered else "no filtering",
    ]
    rows = [
        (
            c.name,
            f"{number(1.0 / sample_period(c.t) if len(c.t) > 1 else None, 3)} Hz",
            str(len(c.t)),
            c.source,
            ", ".join(f"{n} {why.replace('_', ' ')}" for why, n in c.faults.items()) or "none",
        )
        for c in log.recording.channels.values()
    ]
    channels = measures(("Channel", "Rate", "Samples", "Source", "Dropped"), rows, (1, 2))
    title = Markup("{} {}").format(log.recording.name, quiet(f"({log.recording.format})"))
    return part(title, tables=[channels], lines=[f"{'; '.join(summary)}."])


def provenance(logs: Sequence[Log], command: str = LIBRARY, more: Mapping[str, Any] | None = None) -> list[JsonDict]:
    """Files with hashes, versions, command line and time; then `more` by name."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in _LIBRARIES]
    rows = [
        ("command", command),
        ("made", f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M:%S UTC}"),
        ("versions", ", ".join([f"quadid {__version__}", f"Python {platform.python_version()}", *versions])),
        *((log.name, f"{log.path}  sha256 {log.recording.sha256 or 'unknown'}") for log in logs),
        *(more or {}).items(),
    ]
    return [{"name": name, "value": str(value)} for name, value in rows]
