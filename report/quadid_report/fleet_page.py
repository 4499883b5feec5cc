"""The report of a fleet: verdict, parameters over time, drift, outliers, common findings, what was not usable."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from quadid.health.changes import HEALTHY_SCORE
from quadid.types import Json
from quadid_report.fleet_tables import MOST_ROWS, date, every_log, summary_sections
from quadid_report.health_page import change_words, has_changed
from quadid_report.parts import axis, figure, level, rows_of, section, trace
from quadid_report.verdict import ROUGH, Level, Verdict, percent

MOST_UNITS = 12
"""Vehicles in one figure."""
MOST_POINTS = 20_000
"""Flights that all figures together show; of more, every n-th."""


def fleet_page(
    summary: Json, logs: Sequence[Json], parameters: Sequence[Json], provenance: Sequence[Json],
    title: str, health: Sequence[Json] = (),
) -> dict[str, Any]:  # fmt: skip
    """Builds the page from `quadid_report.fleet_summary.summarise` and the rows it was made from.

    `health` holds the rows of `quadid_workflow.fleet_health.health_trend`.
    """
    return {
        "title": title,
        "subtitle": f"{len(logs)} logs of {len(summary['units'])} vehicle{'s' * (len(summary['units']) != 1)}",
        "verdict": asdict(fleet_verdict(summary, health)),
        "sections": [s for s in (
            _health(health, logs), _over_time(logs, parameters), *summary_sections(summary), every_log(logs),
        ) if s is not None],
        "provenance": provenance,
    }  # fmt: skip


def fleet_verdict(summary: Json, health: Sequence[Json] = ()) -> Verdict:
    """How many logs gave an answer, which vehicles have changed by their last flight, and what needs attention."""
    counts = summary["counts"]
    total, done = sum(counts.values()), counts.get("done", 0)
    last = {row["unit"]: row for row in health if not row["baseline"]}  # in the order of time
    changed = [row for row in last.values() if has_changed(row)]
    rough = summary["rough"]
    fit = done - rough
    level: Level = "good" if fit == total and not changed else "fair" if fit >= 0.5 * total else "poor"
    gave = f"{done} of {total} logs gave parameters."
    headline = f"{len(changed)} of {len(last)} vehicles have changed." if changed else gave
    words = (
        ("refused", "cannot support a fit"),
        ("unreadable", "cannot be read or used"),
        ("failed", "stopped this program"),
    )
    details = [f"{row['unit']} has changed: {_what_changed(row)}." for row in changed[:3]]
    details += [gave] if changed else []
    details += [f"{counts[key]} {text}." for key, text in words if counts.get(key)]
    if copies := len(summary["copies"]):
        told = "log is a copy of another and is" if copies == 1 else "logs are copies of others and are"
        details.append(f"{copies} {told} not counted.")
    if rough:
        what = "answer misses much of its flight" if rough == 1 else "answers miss much of their flights"
        details.append(f"{rough} {what} (error above {ROUGH:g} noise variances): not to be used.")
    details += [
        f"{d['unit']}: {d['parameter']} {'rose' if d['change'] > 0 else 'fell'} by {percent(abs(d['change']))} "
        f"in {d['days']:.3g} days."
        for d in summary["drifts"][:3]
    ]
    steps = ["`quadid fleet --diagnose` names what the simulation gets wrong."] if rough else []
    if changed:
        today = shlex.quote(changed[0]["log"])
        steps.append(f"To see how certain this is: `quadid health {today} --baseline …` (the vehicle's first flights).")
    if summary["drifts"]:
        steps.append("A parameter that drifts: look for wear of propellers and motors, or a changed payload.")
    if summary["outliers"]:
        log = summary["outliers"][0]["log"]
        steps.append(f"Look at the largest outlier: `quadid diagnose {log}`.")
    if counts.get("refused") or counts.get("unreadable"):
        steps.append("`quadid inspect LOG` names what an unusable log lacks and how to log it.")
    if counts.get("failed"):
        steps.append("Please report failures of this program; the last table names the logs.")
    if not steps:
        steps.append("Nothing to do. The tables are in SQLite and Parquet for questions of your own.")
    return Verdict(level, headline, tuple(details), tuple(steps))


def _when(logs: Sequence[Json]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Where each log lies on an axis of time, and that axis.

    Dates of files are mostly those of a copy: then flights are counted, in the order of their dates and names.
    """
    if all(log["dated_by"] == "log" for log in logs):
        return {log["name"]: date(log["started"]) for log in logs}, {"type": "date"}
    count: Counter[str] = Counter()
    places = {}
    readable = (log for log in logs if log["status"] != "unreadable")
    for log in sorted(readable, key=lambda log: (log["started"], log["name"])):
        count[log["unit"]] += 1
        places[log["name"]] = count[log["unit"]]
    whole = {"tickformat": "d", "dtick": 1} if max(count.values(), default=0) <= 12 else {"tickformat": "d"}
    return places, {**axis("flight"), **whole}


def _counted(time: Json) -> str:
    """A sentence where flights are counted."""
    return "" if time.get("type") == "date" else " Flights are counted in the order of their files' dates."


def _health(rows: Sequence[Json], logs: Sequence[Json]) -> dict[str, Any] | None:
    """Score of every flight over time, and what changed."""
    judged = [row for row in rows if not row["baseline"]]
    if not judged:
        return None
    by_unit: dict[str, list[Json]] = {}
    for row in judged:
        by_unit.setdefault(row["unit"], []).append(row)
    places, time = _when(logs)
    data = []
    for i, (unit, own) in enumerate(sorted(by_unit.items())[:MOST_UNITS]):
        score = np.array([row["score"] for row in own])
        text = [f"{row['log']}: {row['verdict']}" for row in own]
        line = trace(f"unit{i}", unit, None, score, mode="lines+markers", text=text)
        data.append({**line, "x": [places[row["log"]] for row in own]})
    layout = {
        "xaxis": time, "yaxis": axis("healthy spreads", rangemode="tozero"), "hovermode": "closest",
        "showlegend": True, "shapes": [level(HEALTHY_SCORE)],
    }  # fmt: skip
    drawn = figure("fleet-health", "Distance from healthy", data, layout, 280)
    changed = [cells for _, own in sorted(by_unit.items()) if (cells := _changes_of(own))]
    table = rows_of(("Vehicle", "Flights changed", "First", "Last", "Changed"), changed[:MOST_ROWS], kind="compact")
    count = Counter(row["unit"] for row in rows if row["baseline"]).values()
    most = "up to " * (len(set(count)) > 1) + str(max(count))
    intro = (
        f"Each flight against the first {most} of its vehicle, which are assumed healthy. 99 of 100 healthy flights "
        f"are below {HEALTHY_SCORE:.1f}, the line."
        f"{_counted(time)}"
    )
    return section("health", "Health over flights", intro, [drawn], [table] if changed else [])


def _changes_of(own: Sequence[Json]) -> tuple[str, ...]:
    """How many flights of a vehicle have changed, the first and last of them, and what had at the last; or nothing."""
    changed = [row for row in own if has_changed(row)]
    if not changed:
        return ()
    first, last = changed[0], changed[-1]
    return last["unit"], f"{len(changed)} of {len(own)}", first["log"], last["log"], _what_changed(last)


def _what_changed(row: Json) -> str:
    return "; ".join(map(change_words, row["changes"])) or "by nothing that has a name"


def _over_time(logs: Sequence[Json], parameters: Sequence[Json]) -> dict[str, Any] | None:
    started = {log["name"]: (log["started"], log["unit"]) for log in logs if log["status"] == "done"}
    when = _when(logs)
    rows = [p for p in parameters if p["status"] == "identified" and p["log"] in started]
    names = dict.fromkeys(p["parameter"] for p in rows)
    views = [_view(name, [p for p in rows if p["parameter"] == name], started, *when) for name in names]
    if not views:
        return None
    intro = f"Every flight with its 95 % interval; a vehicle is a folder.{_counted(when[1])}"
    drawn = {"id": "fleet-parameters", "title": "Value of each flight", "views": views, "height": 280}
    return section("over-time", "Parameters over time", intro, [drawn])


def _view(
    name: str, rows: Sequence[Json], started: Mapping[str, tuple[float, str]], places: Json, time: Json
) -> dict[str, Any]:
    """One parameter of every vehicle over its flights."""
    mine = sorted(rows, key=lambda p: started[p["log"]][0])
    units = list(dict.fromkeys(started[p["log"]][1] for p in mine))
    data = []
    for i, unit in enumerate(sorted(units)[:MOST_UNITS]):
        own = [p for p in mine if started[p["log"]][1] == unit]
        own = own[:: max(1, math.ceil(len(own) * len(units) * 6 / MOST_POINTS))]
        value = np.array([p["value"] for p in own])
        upper = np.array([_gap(p["high"], p["value"]) for p in own])
        lower = np.array([_gap(p["value"], p["low"]) for p in own])
        bars = {"type": "data", "symmetric": False, "array": upper.tolist(), "arrayminus": lower.tolist()}
        line = trace(f"unit{i}", unit, None, value, mode="markers", error_y=bars, text=[p["log"] for p in own])
        data.append({**line, "x": [places[p["log"]] for p in own]})
    layout = {
        "xaxis": time, "yaxis": axis(f"{name} [{mine[0]['unit']}]"), "hovermode": "closest",
        "showlegend": True,
    }  # fmt: skip
    return {"label": name, "data": data, "layout": layout}


def _gap(high: float | None, low: float | None) -> float:
    return 0.0 if high is None or low is None or not math.isfinite(high - low) else max(high - low, 0.0)
