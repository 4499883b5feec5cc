"""What is done to one log of a fleet, wherever a worker runs: plain data in, plain data out, never an exception."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid.errors import LogError, NotIdentifiableError, QuadidError
from quadid.sanitise import one_line
from quadid.workflow.loading import Log, load

Row = dict[str, Any]
EARLIEST = 946_684_800.0
"""Times before the year 2000 are seconds since boot, not dates [s]."""


@dataclass(frozen=True)
class Job:
    """One log to identify.

    Attributes:
        path: absolute; every worker must see it there.
        name: relative to the folder of the fleet.
        unit: which vehicle of the fleet it belongs to.
        vehicle: text of its vehicle file.
        size, modified: of the file [bytes], [ns]; with `key` they tell whether a stored result is still good.
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
        log = _opened(job)
        row |= _seen(log)
        row |= {"status": "done", "reason": "", **_identified(job, log)}
    except NotIdentifiableError as error:
        row |= {"status": "refused", "reason": _line(error)}
    except (QuadidError, OSError) as error:
        row |= {"status": "unreadable", "reason": _line(error)}
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


def _opened(job: Job) -> Log:
    from quadid.vehicle import Vehicle

    vehicle = Vehicle.from_yaml(job.vehicle, job.unit)
    if Path(job.path).stat().st_size == 0:
        raise LogError("empty file", fix="check that the logger finished writing, then copy it again")
    return load(job.path, vehicle, rate=job.rate)


def _seen(log: Log) -> Row:
    """What a flight shows whether or not its parameters can be identified; its trim where it flew steadily."""
    from quadid.health.stored import flight_to_dict
    from quadid.health.trims import flight_trim

    row: Row = {
        "vehicle": log.vehicle.name,
        "sha256": log.recording.sha256,
        "format": log.recording.format,
        "seconds": log.grid.seconds_used,
        "warnings": log.warnings,
        **_when(log),
    }
    try:
        trim = flight_trim(log.recording, log.vehicle)
    except NotIdentifiableError as error:
        return row | {"warnings": [*log.warnings, f"no trim: {error.found}"]}
    return row | {"trims": [{"trim": json.dumps(flight_to_dict(trim))}]}


def _identified(job: Job, log: Log) -> Row:
    from quadid.workflow.identify import identify

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


def _when(log: Log) -> Row:
    """Date of the flight, where the log's clock knows dates."""
    first = min((float(c.t[0]) for c in log.recording.channels.values() if len(c.t)), default=0.0)
    return {"started": first, "dated_by": "log"} if first > EARLIEST else {}


def _diagnosed(job: Job, log: Log) -> Row:
    from quadid.workflow.diagnose import diagnose

    done = diagnose(log, seed=job.seed)
    kept = ("effect", "confident", "parameter", "unit", "value", "low", "high", "mse_before", "mse_after")
    return {"verdict": done.result["verdict"], "findings": [{k: row[k] for k in kept} for row in done.records()]}


def _line(error: Exception) -> str:
    return one_line(str(error), 500)
