"""What many flights say together: parameters of every vehicle over time, drift, outliers, findings they share."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from quadid.chi_square import Z95
from quadid.types import Json
from quadid_report.verdict import ROUGH

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
    by_name = {log["name"]: log for log in logs}
    series = _series(by_name, parameters)
    return {
        "counts": dict(Counter(log["status"] for log in logs)),
        "rough": sum(log["mse_fitted"] is not None and not log["mse_fitted"] <= ROUGH for log in logs),
        "units": _units(logs, series),
        "drifts": _drifts(series),
        "outliers": _outliers(series),
        "common": _common(by_name, findings),
        "reasons": [*_reasons(logs), *_copied(copies)],
        "copies": [{"log": log, "of": of} for log, of in copies],
    }


def _series(by_name: Mapping[str, Json], parameters: Sequence[Json]) -> dict[tuple[str, str], list[Json]]:
    """Identified values by vehicle and parameter, in the order of time."""
    out: dict[tuple[str, str], list[Json]] = defaultdict(list)
    for row in parameters:
        log = by_name.get(row["log"])
        known = row["status"] == "identified" and row["low"] is not None and row["high"] is not None
        if log is not None and known and row["value"] and math.isfinite(row["high"] - row["low"]):
            out[log["unit"], row["parameter"]].append({**row, "started": log["started"]})
    for rows in out.values():
        rows.sort(key=lambda r: r["started"])
    return dict(sorted(out.items()))


def _units(logs: Sequence[Json], series: Mapping[tuple[str, str], list[Json]]) -> list[dict[str, Any]]:
    out = []
    for unit in sorted({log["unit"] for log in logs}):
        mine = [log for log in logs if log["unit"] == unit]
        rows = [
            {"parameter": name, "unit": values[0]["unit"], "flights": len(values), **_centre(values)}
            for (owner, name), values in series.items()
            if owner == unit
        ]
        done = sum(log["status"] == "done" for log in mine)
        out.append({"unit": unit, "logs": len(mine), "done": done, "parameters": rows})
    return out


def _centre(rows: Sequence[Json]) -> dict[str, float]:
    values = np.array([r["value"] for r in rows])
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return {"median": middle, "spread": spread / abs(middle) if middle else math.nan}


def _drifts(series: Mapping[tuple[str, str], list[Json]]) -> list[dict[str, Any]]:
    """Parameters that rise or fall with time: Kendall's tau decides, Theil and Sen's slope says how fast."""
    fit_for = {
        key: rows for key, rows in series.items()
        if len(rows) >= FEWEST_FOR_DRIFT and len({r["started"] for r in rows}) >= FEWEST_FOR_DRIFT
    }  # fmt: skip
    out = []
    for (unit, name), rows in fit_for.items():
        t = np.array([r["started"] for r in rows]) / DAY
        relative = np.array([r["value"] for r in rows]) / float(np.median([r["value"] for r in rows]))
        p_value = float(stats.kendalltau(t, relative).pvalue) * len(fit_for)
        if p_value < FALSE_ALARM:
            slope = stats.theilslopes(relative, t)
            change = float(slope.slope) * float(np.ptp(t))
            out.append({
                "unit": unit, "parameter": name, "change": change, "days": float(np.ptp(t)),
                "per_day": float(slope.slope), "ci95": [float(slope.low_slope), float(slope.high_slope)],
                "p_value": p_value, "flights": len(rows),
            })  # fmt: skip
    return sorted(out, key=lambda d: -abs(d["change"]))


def _outliers(series: Mapping[tuple[str, str], list[Json]]) -> list[dict[str, Any]]:
    """Flights far from the vehicle's median, measured by the vehicle's spread and the flight's own interval."""
    out = []
    for (unit, name), rows in series.items():
        if len(rows) < FEWEST_FOR_OUTLIERS:
            continue
        centre = _centre(rows)
        for row in rows:
            own = (row["high"] - row["low"]) / (2.0 * Z95)
            scale = math.hypot(centre["spread"] * abs(centre["median"]), own)
            distance = (row["value"] - centre["median"]) / scale if scale > 0.0 else 0.0
            if abs(distance) > FAR:
                out.append({
                    "log": row["log"], "unit": unit, "parameter": name, "value": row["value"],
                    "median": centre["median"], "unit_of_value": row["unit"], "deviations": distance,
                })  # fmt: skip
    return sorted(out, key=lambda o: -abs(o["deviations"]))


def _common(by_name: Mapping[str, Json], findings: Sequence[Json]) -> list[dict[str, Any]]:
    diagnosed: Counter[str] = Counter(log["unit"] for log in by_name.values() if log["verdict"] is not None)
    seen: dict[tuple[str, str], dict[str, Json]] = defaultdict(dict)
    for row in findings:
        log = by_name.get(row["log"])
        if log is not None and row["confident"]:
            seen[log["unit"], row["effect"]].setdefault(row["log"], row)
    out = [
        {
            "unit": unit, "effect": effect, "flights": len(rows), "of": diagnosed[unit],
            "parameter": (first := next(iter(rows.values())))["parameter"], "unit_of_value": first["unit"],
            "median": float(np.median([r["value"] for r in rows.values()])),
            "lowest": min(r["value"] for r in rows.values()), "highest": max(r["value"] for r in rows.values()),
        }
        for (unit, effect), rows in seen.items()
    ]  # fmt: skip
    return sorted(out, key=lambda c: (-c["flights"], c["unit"], c["effect"]))


def _reasons(logs: Sequence[Json]) -> list[dict[str, Any]]:
    """Logs without a result by what kept them from one, most frequent first."""
    grouped: dict[tuple[str, str], list[str]] = defaultdict(list)
    for log in logs:
        if log["status"] != "done":
            reason = log["reason"].replace(f"{log['name'].rsplit('/', 1)[-1]}: ", "")
            grouped[log["status"], reason].append(log["name"])
    ordered = sorted(grouped.items(), key=lambda item: (-len(item[1]), item[0]))
    return [{"status": s, "reason": r, "logs": len(names), "names": names} for (s, r), names in ordered]


def _copied(copies: Sequence[tuple[str, str]]) -> list[dict[str, Any]]:
    """Copies in the form of logs without a result."""
    grouped: dict[str, list[str]] = defaultdict(list)
    for log, of in copies:
        grouped[of].append(log)
    return [
        {"status": "copy", "reason": f"the bytes of {of}, which is counted once", "logs": len(names), "names": names}
        for of, names in sorted(grouped.items())
    ]
