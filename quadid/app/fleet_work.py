"""Fleet: the work on one log, and the health of every vehicle over its flights."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from quadid.app.logs import Log, LogPart, check_conventions, on_grid, open_recording, parse_part, require_gyro
from quadid.data.window import Recording
from quadid.errors import LogError, NotIdentifiableError, QuadidError
from quadid.sanitise import one_line
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.condition import FlightTrim

# --- What is done to one log of a fleet, wherever a worker runs: plain data in, plain data out, never an exception


Row = dict[str, Any]
EARLIEST = 946_684_800.0
"""Times before the year 2000 are seconds since boot, not dates [s]."""


@dataclass(frozen=True)
class Job:
    """One log to identify.

    Attributes:
        path: absolute, with a span if wanted; every worker must see it there.
        name: relative to the folder of the fleet.
        unit: which vehicle of the fleet it belongs to.
        size, modified: of the file [bytes], [ns]; with `key` they decide whether a stored result is still good.
        key: hash of everything else that decides the result.
        rate: of the grid [Hz]; seed: of the search; diagnose: name what the simulation gets wrong too.
    """

    path: str
    name: str
    unit: str
    vehicle: str
    size: int
    modified: int
    key: str
    rate: float
    seed: int
    diagnose: bool


def identify_one(job: Job) -> Row:
    """Identifies one log.

    Returns:
        ``status`` ``done``, ``refused`` (the data cannot support an answer), ``unreadable`` or ``failed`` (a defect
        of this program), ``reason``, and what was found; nothing is raised, so that no log can stop the others.
    """
    begin = time.perf_counter()
    row = blank(job)
    try:
        cut = parse_part(job.path)
        vehicle, recording = _opened(job, cut)
        checked = check_conventions(recording, vehicle, cut)
        row |= _seen(cut.of(recording), vehicle, checked.doubts)
        require_gyro(recording)
        log = on_grid(cut.path, recording, vehicle, job.rate, cut, checked)
        row |= {"seconds": log.grid.seconds_used, "warnings": list(dict.fromkeys([*row["warnings"], *log.warnings]))}
        row |= {"status": "done", "reason": "", **_identified(job, log)}
    except NotIdentifiableError as error:
        row |= {"status": "refused", "reason": _line(error)}
    except (QuadidError, OSError) as error:
        status = "refused" if row["trims"] else "unreadable"  # what shows its trim has been read
        row |= {"status": status, "reason": _line(error)}
    except Exception as error:  # noqa: BLE001 - one log's defect is reported in its row and must not stop the rest
        row |= {"status": "failed", "reason": f"{type(error).__name__}: {_line(error)}"}
    return {**row, "took": time.perf_counter() - begin, "worker": os.getpid()}


def blank(job: Job) -> Row:
    """The row of a log of which nothing is known yet but its file."""
    return {
        "name": job.name, "unit": job.unit, "size": job.size, "modified": job.modified, "key": job.key,
        "sha256": None, "started": 1e-9 * job.modified, "dated_by": "file", "format": None, "seconds": None,
        "mse_initial": None, "mse_fitted": None, "verdict": None, "parameters": [], "findings": [], "trims": [],
        "warnings": [],
    }  # fmt: skip


def _opened(job: Job, cut: LogPart) -> tuple[Vehicle, Recording]:

    vehicle = Vehicle.from_yaml(job.vehicle, job.unit)
    if cut.path.stat().st_size == 0:
        raise LogError("empty file", fix="check that the logger finished writing, then copy it again")
    return vehicle, open_recording(cut.path, columns=vehicle.columns)


def _seen(recording: Recording, vehicle: Vehicle, doubts: Sequence[str]) -> Row:
    """Facts of a flight, whether or not anything can be fitted to it; its trim where it flew steadily."""
    from quadid.condition.trim import flight_to_dict, flight_trim

    row: Row = {
        "vehicle": vehicle.name,
        "sha256": recording.sha256,
        "format": recording.format,
        "warnings": [f"{recording.name}: {text}" for text in (*recording.warnings, *doubts)],
        **_when(recording),
    }
    try:
        trim = flight_trim(recording, vehicle)
    except NotIdentifiableError as error:
        return row | {"warnings": [*row["warnings"], f"no trim: {error.found}"]}
    return row | {"trims": [{"trim": json.dumps(flight_to_dict(trim))}]}


def _identified(job: Job, log: Log) -> Row:
    from quadid.app.identify import identify

    result = identify(log, seed=job.seed).result
    error = result["sets"][0]["mse"]
    row: Row = {
        "mse_initial": error["initial"],
        "mse_fitted": error["fitted"],
        "parameters": [
            {"parameter": p["name"], "unit": p["unit"], "value": p["value"], "low": p["ci95"][0], "high": p["ci95"][1],
             "status": p["status"]}
            for p in result["parameters"]
        ],
    }  # fmt: skip
    return row | (_diagnosed(job, log) if job.diagnose else {})


def _when(recording: Recording) -> Row:
    """Date of the flight, where the log has one."""
    first, _ = recording.span
    return {"started": first, "dated_by": "log"} if first > EARLIEST else {}


def _diagnosed(job: Job, log: Log) -> Row:
    from quadid.app.diagnose import diagnose

    done = diagnose(log, seed=job.seed)
    kept = ("effect", "confident", "parameter", "unit", "value", "low", "high", "mse_before", "mse_after")
    return {"verdict": done.result["verdict"], "findings": [{k: row[k] for k in kept} for row in done.records()]}


def _line(error: Exception) -> str:
    return one_line(str(error), 500)


# --- Health of every vehicle of a fleet over its flights: each flight against the vehicle's first ones


HealthRow = Mapping[str, Any]

BASELINE = 5
"""The first flights of a vehicle are its baseline, so many where there are more."""
FEWEST = 3
"""Baseline flights that a trend takes at least."""


def health_trend(
    logs: Sequence[HealthRow], trims: Sequence[HealthRow], vehicles: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Compares each flight of a vehicle with its first flights.

    Args:
        logs: rows with name, unit, started [s since 1970].
        trims: rows with log and trim (JSON).
        vehicles: text of the vehicle file by unit.

    Returns:
        A row a flight, in the order of time: unit, log, started, baseline (whether it is part of it), and, for the
        others, score, verdict, baseline_lacking, unfamiliar, p_value and changes as in ``quadid.health/1``; none for
        vehicles with too few flights.
    """
    from quadid.condition.trim import flight_from_dict

    flown = {row["log"]: flight_from_dict(json.loads(row["trim"])) for row in trims}
    by_unit: dict[str, list[HealthRow]] = {}
    for log in sorted(logs, key=lambda row: (float(row["started"]), row["name"])):
        if log["name"] in flown and log["unit"] in vehicles:
            by_unit.setdefault(log["unit"], []).append(log)
    out = []
    for unit, mine in sorted(by_unit.items()):
        count = min(BASELINE, len(mine) - 1)
        if count >= FEWEST:
            out += _trend(Vehicle.from_yaml(vehicles[unit], unit), unit, mine, flown, count)
    return out


def _trend(
    vehicle: Vehicle, unit: str, logs: Sequence[HealthRow], flown: Mapping[str, FlightTrim], count: int
) -> list[dict[str, Any]]:
    from quadid.condition.changes import assess

    baseline = [flown[log["name"]] for log in logs[:count]]
    rows: list[dict[str, Any]] = []
    for k, log in enumerate(logs):
        row = {"unit": unit, "log": log["name"], "started": log["started"], "baseline": k < count}
        if k >= count:
            found = assess([flown[log["name"]]], baseline, vehicle).to_dict()
            row |= {
                key: found[key] for key in ("score", "verdict", "baseline_lacking", "unfamiliar", "p_value", "changes")
            }
        rows.append(row)
    return rows
