"""Fleet report: parameters over time, drift, outliers, common findings, unusable logs."""

import json
import math
import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from quadid.app.health import change_words, has_changed
from quadid.app.outcome import LIBRARY, Reported, provenance
from quadid.chi_square import Z95
from quadid.report.page import axis, figure, level, number, rows_of, section, trace
from quadid.report.page import unit as unit_text
from quadid.report.tables import Cell, TextTable, heads
from quadid.report.tables import number as plain_number
from quadid.report.verdict import ROUGH, Level, Verdict, percent
from quadid.types import Json, JsonDict
from quadid.vehicle import Vehicle

# --- What many flights say together: parameters of every vehicle over time, drift, outliers, findings they share


Row = dict[str, Any]
FEWEST_FOR_DRIFT = 5
"""Flights on different days or hours that a drift takes at least."""
FEWEST_FOR_OUTLIERS = 5
FALSE_ALARM = 0.01
"""Chance that any drift at all is reported of a fleet without one."""
FAR = 4.5
"""Robust standard deviations from the vehicle's own median that make an outlier."""
DAY = 86_400.0


def summarise(
    logs: Sequence[Json], parameters: Sequence[Json], findings: Sequence[Json], copies: Sequence[tuple[str, str]] = ()
) -> dict[str, Any]:
    """Sums up a fleet.

    Args:
        logs: rows with name, unit, status, reason, started [s since 1970], dated_by, mse_initial, mse_fitted, verdict.
        parameters: rows with log, parameter, unit, value, low, high (95 % interval), status.
        findings: rows with log, effect, confident, parameter, value.
        copies: files that are not counted because they hold the bytes of a log, each with that log's name.

    Returns:
        ``counts`` by status, ``rough`` (logs that the simulation misses much of), ``units`` (each with its parameters:
        median, spread, flights), ``drifts``, ``outliers``, ``common`` (findings by number of flights), ``reasons``
        (failures and copies by reason), ``copies``.
    """
    from scipy import stats

    by_name = {log["name"]: log for log in logs}
    units: dict[str, JsonDict] = {
        unit: {"unit": unit, "logs": 0, "done": 0, "parameters": []} for unit in sorted({log["unit"] for log in logs})
    }
    for log in logs:
        units[log["unit"]]["logs"] += 1
        units[log["unit"]]["done"] += log["status"] == "done"
    # Identified values by vehicle and parameter, in the order of time.
    series: dict[tuple[str, str], list[Json]] = defaultdict(list)
    for row in parameters:
        known = row["status"] == "identified" and row["low"] is not None and row["high"] is not None
        if known and row["value"] and math.isfinite(row["high"] - row["low"]) and row["log"] in by_name:
            log = by_name[row["log"]]
            series[log["unit"], row["parameter"]].append({**row, "started": log["started"]})
    tests = sum(len({r["started"] for r in rows}) >= FEWEST_FOR_DRIFT for rows in series.values())
    drifts, outliers = list[JsonDict](), list[JsonDict]()
    for (unit, name), rows in sorted(series.items()):
        rows.sort(key=lambda r: r["started"])
        t, value, low, high = np.array([[r[key] for key in ("started", "value", "low", "high")] for r in rows]).T
        middle = float(np.median(value))
        spread = 1.4826 * float(np.median(np.abs(value - middle)))
        of, days = rows[0]["unit"], float(np.ptp(t)) / DAY
        relative = {"median": middle, "spread": spread / abs(middle) if middle else math.nan}
        units[unit]["parameters"].append({"parameter": name, "unit": of, "flights": len(rows), **relative})
        # Rises or falls with time by Kendall's tau; how fast, by Theil and Sen's slope.
        if len(set(t)) >= FEWEST_FOR_DRIFT:
            p_value = float(stats.kendalltau(t, value / middle).pvalue) * tests
            if p_value < FALSE_ALARM:
                slope = stats.theilslopes(value / middle, t / DAY)
                per_day, *ci95 = map(float, (slope.slope, slope.low_slope, slope.high_slope))
                moved = {"change": per_day * days, "days": days, "per_day": per_day, "ci95": ci95}
                drifts.append({"unit": unit, "parameter": name, **moved, "p_value": p_value, "flights": len(rows)})
        # Far from the vehicle's median, measured by its spread and the flight's own interval.
        scale = np.hypot(spread, (high - low) / (2.0 * Z95))
        distance = np.divide(value - middle, scale, out=np.zeros(len(rows)), where=scale > 0.0)
        for row, far in zip(rows, distance.tolist(), strict=True):
            if len(rows) >= FEWEST_FOR_OUTLIERS and abs(far) > FAR:
                there = {"value": row["value"], "median": middle, "unit_of_value": of, "deviations": far}
                outliers.append({"log": row["log"], "unit": unit, "parameter": name, **there})
    return {
        "counts": dict(Counter(log["status"] for log in logs)),
        "rough": sum(log["mse_fitted"] is not None and not log["mse_fitted"] <= ROUGH for log in logs),
        "units": list(units.values()),
        "drifts": sorted(drifts, key=lambda d: -abs(d["change"])),
        "outliers": sorted(outliers, key=lambda o: -abs(o["deviations"])),
        "common": _common(by_name, findings),
        "reasons": _reasons(logs, copies),
        "copies": [{"log": log, "of": of} for log, of in copies],
    }


def _common(by_name: Mapping[str, Json], findings: Sequence[Json]) -> list[JsonDict]:
    """Confident findings of each vehicle by the number of flights that show them."""
    diagnosed = Counter(log["unit"] for log in by_name.values() if log["verdict"] is not None)
    seen: dict[tuple[str, str], dict[str, Json]] = defaultdict(dict)
    for row in findings:
        if row["confident"] and (log := by_name.get(row["log"])) is not None:
            seen[log["unit"], row["effect"]].setdefault(row["log"], row)  # the first number of it
    out = []
    for (unit, effect), rows in seen.items():
        first, values = next(iter(rows.values())), [r["value"] for r in rows.values()]
        sizes = {"median": float(np.median(values)), "lowest": min(values), "highest": max(values)}
        number = {"parameter": first["parameter"], "unit_of_value": first["unit"], **sizes}
        out.append({"unit": unit, "effect": effect, "flights": len(rows), "of": diagnosed[unit], **number})
    return sorted(out, key=lambda c: (-c["flights"], c["unit"], c["effect"]))


def _reasons(logs: Sequence[Json], copies: Sequence[tuple[str, str]]) -> list[dict[str, Any]]:
    """Logs without a result by what kept them from one, most frequent first; then copies in the same form."""
    lost, copied = defaultdict[tuple[str, str], list[str]](list), defaultdict[tuple[str, str], list[str]](list)
    for log in logs:
        if log["status"] != "done":
            reason = log["reason"].replace(f"{log['name'].rsplit('/', 1)[-1]}: ", "")
            lost[log["status"], reason].append(log["name"])
    for name, of in sorted(copies, key=lambda pair: pair[1]):
        copied["copy", f"the bytes of {of}, which is counted once"].append(name)
    ordered = [*sorted(lost.items(), key=lambda item: (-len(item[1]), item[0])), *copied.items()]
    return [{"status": s, "reason": r, "logs": len(names), "names": names} for (s, r), names in ordered]


# --- Health of every vehicle of a fleet over its flights: each flight against the vehicle's first ones


BASELINE = 5
"""The first flights of a vehicle are its baseline, so many where there are more."""
FEWEST = 3
"""Baseline flights that a trend takes at least."""
_JUDGED = ("score", "verdict", "baseline_lacking", "unfamiliar", "p_value", "changes")


def health_trend(logs: Sequence[Json], trims: Sequence[Json], vehicles: Mapping[str, str]) -> list[Row]:
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
    from quadid.condition.changes import assess
    from quadid.condition.trim import flight_from_dict

    flown = {row["log"]: flight_from_dict(json.loads(row["trim"])) for row in trims}
    by_unit: dict[str, list[Json]] = {}
    for log in sorted(logs, key=lambda row: (float(row["started"]), row["name"])):
        if log["name"] in flown and log["unit"] in vehicles:
            by_unit.setdefault(log["unit"], []).append(log)
    out: list[Row] = []
    for unit, mine in sorted(by_unit.items()):
        count = min(BASELINE, len(mine) - 1)
        if count < FEWEST:
            continue
        vehicle, healthy = Vehicle.from_yaml(vehicles[unit], unit), [flown[log["name"]] for log in mine[:count]]
        for k, log in enumerate(mine):
            row = {"unit": unit, "log": log["name"], "started": log["started"], "baseline": k < count}
            if k >= count:
                found = assess([flown[log["name"]]], healthy, vehicle).to_dict()
                row |= {key: found[key] for key in _JUDGED}
            out.append(row)
    return out


# --- Tables of the report of a fleet: a row a thing, folded where they are long, so that a phone shows them too


MOST_ROWS = 200
"""Rows of one section; the database has all."""
FOLDED = 8
"""Tables of more rows are folded."""


def date(seconds: float) -> str:
    """A time [s since 1970] as ``2026-11-25 15:05:00``."""
    return str(np.datetime_as_string(np.datetime64(round(seconds), "s"))).replace("T", " ")


_COLUMNS: dict[str, tuple[str, str, str, dict[str, Callable[[Json], str]]]] = {
    "drifts": (
        "drift",
        "Drift",
        "Kendall's rank test, corrected for the number of tests; slope after Theil and Sen.",
        {
            "Vehicle": lambda d: d["unit"],
            "Parameter": lambda d: d["parameter"],
            "Change": lambda d: f"{100 * d['change']:+.2g} % in {d['days']:.3g} days".replace("-", "−"),
            "Rate, 95 % interval": lambda d: f"{' … '.join(number(100 * end, 2) for end in d['ci95'])} % a day",
            "Chance without drift": lambda d: number(d["p_value"], 2),
            "Flights": lambda d: str(d["flights"]),
        },
    ),
    "outliers": (
        "outliers",
        "Outliers",
        "In robust standard deviations of the vehicle.",
        {
            "Log": lambda o: o["log"],
            "Parameter": lambda o: o["parameter"],
            "Value": lambda o: f"{number(o['value'])} {unit_text(o['unit_of_value'])}",
            "Median of the vehicle": lambda o: number(o["median"]),
            "Deviations": lambda o: number(o["deviations"], 2),
        },
    ),
    "common": (
        "common",
        "What the simulation gets wrong, flight after flight",
        "",
        {
            "Vehicle": lambda c: c["unit"],
            "Finding": lambda c: c["effect"].replace("_", " "),
            "Flights": lambda c: f"{c['flights']} of {c['of']}",
            "Median": lambda c: f"{c['parameter']} = {number(c['median'])} {c['unit_of_value']}".rstrip(),
            "Range": lambda c: f"{number(c['lowest'])} … {number(c['highest'])}",
        },
    ),
    "reasons": (
        "unusable",
        "Logs without an answer",
        "",
        {
            "Outcome": lambda r: r["status"],
            "Reason": lambda r: r["reason"],
            "Logs": lambda r: str(r["logs"]),
            "Which": lambda r: ", ".join(r["names"][:5]) + (" …" if r["logs"] > 5 else ""),
        },
    ),
}
"""Section of each kind of entry of a summary: identifier, title, sentence, and its columns."""


def summary_sections(summary: Json) -> list[JsonDict]:
    """Findings of `summarise`, a section a kind; none for kinds without a row."""
    head, tables = ("Parameter", "Median", "Unit", "Spread", "Flights"), list[JsonDict]()
    for unit in summary["units"][:MOST_ROWS]:
        rows = [
            (p["parameter"], number(p["median"]), unit_text(p["unit"]), percent(p["spread"]), str(p["flights"]))
            for p in unit["parameters"]
        ]
        if rows:
            title = f"{unit['unit']}: {unit['done']} of {unit['logs']} logs gave an answer"
            tables.append({**rows_of(head, rows, title, "compact"), "open": not tables})
    spread = f"Spread between flights: robust standard deviation over the median.{_left_out(summary['units'])}"
    out = [section("vehicles", "Vehicles", spread, tables=tables)] if tables else []
    for kind, (identifier, name, intro, columns) in _COLUMNS.items():
        if found := summary[kind]:
            fold = f"All {len(found)}" if len(found) > FOLDED else ""
            shown = [[text(entry) for text in columns.values()] for entry in found[:MOST_ROWS]]
            table = rows_of(tuple(columns), shown, fold, "compact")
            out.append(section(identifier, name, intro + _left_out(found), tables=[table]))
    return out


def _left_out(rows: Sequence[Any]) -> str:
    return f" The first {MOST_ROWS} of {len(rows)}; the database has all." if len(rows) > MOST_ROWS else ""


def every_log(logs: Sequence[Json]) -> JsonDict:
    """Every log with its error and where its date comes from, folded by vehicle, the worst error first."""
    worst = sorted(logs, key=lambda log: -(log["mse_fitted"] if log["mse_fitted"] is not None else math.inf))
    head, errors = ("Log", "Outcome", "Error", "Date"), ("mse_initial", "mse_fitted")
    tables = []
    for unit, some in groupby(sorted(worst[:MOST_ROWS], key=lambda log: str(log["unit"])), key=lambda log: log["unit"]):
        rows = [
            (
                log["name"],
                log["status"],
                " → ".join(number(log[key], 3) for key in errors) if log[errors[-1]] is not None else "–",
                f"{date(log['started'])[:-3]} ({log['dated_by']})",
            )
            for log in some
        ]
        tables.append(rows_of(head, rows, f"{unit}: {len(rows)} log{'s' * (len(rows) != 1)}", "compact"))
    intro = (
        "Squared errors before and after the fit, relative to what the model expects (1: as large as expected). The "
        "worst come first. Dates are those of the clock in the log or of its file."
    )
    return section("logs", "Every log", intro + _left_out(logs), tables=tables)


# --- The report of a fleet: verdict, parameters over time, drift, outliers, common findings, what was not usable


MOST_UNITS = 12
"""Vehicles in one figure."""
MOST_POINTS = 20_000
"""Flights that all figures together show; of more, every n-th."""


@dataclass(frozen=True, repr=False)
class Fleet(Reported):
    """A fleet of flights.

    Attributes:
        result: of the form ``quadid.fleet/1``: that of `summarise`, ``health`` of
            `health_trend`, and how much was done.
        logs, parameters: rows that it was made from.
    """

    page_name = "fleet.html"
    result: dict[str, Any]
    logs: Sequence[Json]
    parameters: Sequence[Json]

    @property
    def verdict(self) -> Verdict:
        """Number of logs with an answer, which vehicles have changed by their last flight, and what needs attention."""
        summary, health = self.result, self.result["health"]
        counts = summary["counts"]
        total, done = sum(counts.values()), counts.get("done", 0)
        last = {row["unit"]: row for row in health if not row["baseline"]}  # in the order of time
        changed = [row for row in last.values() if has_changed(row)]
        rough = summary["rough"]
        fit = done - rough
        level: Level = "good" if fit == total and not changed else "fair" if fit >= 0.5 * total else "poor"
        gave = f"{done} of {total} logs gave parameters."
        headline = f"{len(changed)} of {len(last)} vehicles have changed." if changed else gave
        details = [f"{row['unit']} has changed: {_what_changed(row)}." for row in changed[:3]]
        details += [gave] if changed else []
        words = {
            "refused": "cannot support a fit",
            "unreadable": "cannot be read or used",
            "failed": "stopped this program",
        }
        details += [f"{counts[key]} {text}." for key, text in words.items() if counts.get(key)]
        if copies := len(summary["copies"]):
            told = "log is a copy of another and is" if copies == 1 else "logs are copies of others and are"
            details.append(f"{copies} {told} not counted.")
        if rough:
            what = "answer misses much of its flight" if rough == 1 else "answers miss much of their flights"
            details.append(f"{rough} {what} (errors above {ROUGH:g} times what the model expects): not to be used.")
        for d in summary["drifts"][:3]:
            moved = f"{'rose' if d['change'] > 0 else 'fell'} by {percent(abs(d['change']))}"
            details.append(f"{d['unit']}: {d['parameter']} {moved} in {d['days']:.3g} days.")
        steps = ["`quadid fleet --diagnose` names what the simulation gets wrong."] if rough else []
        if changed:
            again = f"`quadid health {shlex.quote(changed[0]['log'])} --baseline …` (the vehicle's first flights)"
            steps.append(f"To see how certain this is: {again}.")
        if summary["drifts"]:
            steps.append("A parameter that drifts: look for wear of propellers and motors, or a changed payload.")
        if summary["outliers"]:
            steps.append(f"Look at the largest outlier: `quadid diagnose {summary['outliers'][0]['log']}`.")
        if counts.get("refused") or counts.get("unreadable"):
            steps.append("`quadid inspect LOG` names what an unusable log lacks and how to log it.")
        if counts.get("failed"):
            steps.append("Please report failures of this program; the last table names the logs.")
        nothing = "Nothing to do. The tables are in SQLite and Parquet for questions of your own."
        return Verdict(level, headline, tuple(details), tuple(steps or [nothing]))

    def tables(self) -> list[TextTable]:
        """Parameters of every vehicle."""
        rows = []
        for unit in self.result["units"]:
            head = (unit["unit"], str(unit["logs"]), str(unit["done"]))
            for p in unit["parameters"]:
                rows.append((*head, p["parameter"], plain_number(p["median"]), p["unit"], f"{100 * p['spread']:.2g} %"))
                head = ("", "", "")
            if not unit["parameters"]:
                rows.append((*head, "", "", "", ""))
        columns = heads("vehicle | logs >1 | answers >2 | parameter | median > | unit | spread >")
        return [TextTable("Vehicles", columns, tuple(rows))]

    @property
    def sentences(self) -> list[Cell]:
        """Reasons that kept logs from an answer, and how much was done."""
        told = [f"{r['logs']} {r['status']}: {r['reason']}" for r in self.result["reasons"][:10]]
        done = f"{self.result['worked']} of {self.result['logs']} logs worked on in {self.result['seconds']:.1f} s"
        return [Cell(text) for text in (*told, done)]

    def records(self) -> list[dict[str, Any]]:
        """One row a log."""
        return [dict(row) for row in self.logs]

    def write(self, folder: Path, kept: str | None = None) -> list[tuple[str, Path]]:
        """The files that the run has written."""
        return [("Written", Path(file)) for file in self.result["files"]]

    def sections(self) -> list[JsonDict]:
        """Health and parameters over time, what was summed up, every log."""
        health, parameters = _health(self.result["health"], self.logs), _over_time(self.logs, self.parameters)
        found = (health, parameters, *summary_sections(self.result), every_log(self.logs))
        return [one for one in found if one is not None]

    def page(self, command: str = LIBRARY) -> str:
        """The page."""
        units = len(self.result["units"])
        subtitle = f"{len(self.logs)} logs of {units} vehicle{'s' * (units != 1)}"
        return self.rendered("Report of a fleet", subtitle, self.sections(), provenance([], command))


def _when(logs: Sequence[Json]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Place of each log on an axis of time, and that axis.

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


def _health(rows: Sequence[Json], logs: Sequence[Json]) -> JsonDict | None:
    """Score of every flight over time, and what changed."""
    from quadid.condition.changes import HEALTHY_SCORE

    by_unit: dict[str, list[Json]] = defaultdict(list)
    for row in rows:
        if not row["baseline"]:
            by_unit[row["unit"]].append(row)
    if not by_unit:
        return None
    places, time = _when(logs)
    data, changed = [], []
    for i, (unit, own) in enumerate(sorted(by_unit.items())):
        if i < MOST_UNITS:
            score, text = np.array([row["score"] for row in own]), [f"{row['log']}: {row['verdict']}" for row in own]
            line = trace(f"unit{i}", unit, None, score, mode="lines+markers", text=text)
            data.append({**line, "x": [places[row["log"]] for row in own]})
        if some := [row for row in own if has_changed(row)]:
            count, last = f"{len(some)} of {len(own)}", some[-1]
            changed.append((unit, count, some[0]["log"], last["log"], _what_changed(last)))
    scores, shapes = axis("healthy spreads", rangemode="tozero"), [level(HEALTHY_SCORE)]
    layout = {"xaxis": time, "yaxis": scores, "hovermode": "closest", "showlegend": True, "shapes": shapes}
    drawn = figure("fleet-health", "Distance from healthy", data, layout, 280)
    table = rows_of(("Vehicle", "Flights changed", "First", "Last", "Changed"), changed[:MOST_ROWS], kind="compact")
    counts = Counter(row["unit"] for row in rows if row["baseline"]).values()
    most = "up to " * (len(set(counts)) > 1) + str(max(counts))
    intro = (
        f"Each flight against the first {most} of its vehicle, which are assumed healthy. 99 of 100 healthy flights "
        f"are below {HEALTHY_SCORE:.1f}, the line.{_counted(time)}"
    )
    return section("health", "Health over flights", intro, [drawn], [table] if changed else [])


def _what_changed(row: Json) -> str:
    return "; ".join(map(change_words, row["changes"])) or "by nothing that has a name"


def _over_time(logs: Sequence[Json], parameters: Sequence[Json]) -> JsonDict | None:
    """Every parameter of every vehicle over its flights, a view each."""
    started = {log["name"]: (log["started"], log["unit"]) for log in logs if log["status"] == "done"}
    places, time = _when(logs)
    by_name: dict[str, dict[str, list[Json]]] = {}
    for p in parameters:
        if p["status"] == "identified" and p["log"] in started:
            by_name.setdefault(p["parameter"], {}).setdefault(started[p["log"]][1], []).append(p)
    views = []
    for name, by_unit in by_name.items():
        data, of = [], next(iter(by_unit.values()))[0]["unit"]
        for i, (unit, flown) in enumerate(sorted(by_unit.items())[:MOST_UNITS]):
            own = sorted(flown, key=lambda p: started[p["log"]][0])
            own = own[:: max(1, math.ceil(len(own) * len(by_unit) * 6 / MOST_POINTS))]
            value = np.array([p["value"] for p in own])
            ends = ([_gap(p["high"], p["value"]) for p in own], [_gap(p["value"], p["low"]) for p in own])
            bars = {"type": "data", "symmetric": False, **dict(zip(("array", "arrayminus"), ends, strict=True))}
            line = trace(f"unit{i}", unit, None, value, mode="markers", error_y=bars, text=[p["log"] for p in own])
            data.append({**line, "x": [places[p["log"]] for p in own]})
        layout = {"xaxis": time, "yaxis": axis(f"{name} [{of}]"), "hovermode": "closest", "showlegend": True}
        views.append({"label": name, "data": data, "layout": layout})
    if not views:
        return None
    intro = f"Every flight with its 95 % interval; a vehicle is a folder.{_counted(time)}"
    drawn = {"id": "fleet-parameters", "title": "Value of each flight", "views": views, "height": 280}
    return section("over-time", "Parameters over time", intro, [drawn])


def _gap(high: float | None, low: float | None) -> float:
    return 0.0 if high is None or low is None or not math.isfinite(high - low) else max(high - low, 0.0)
